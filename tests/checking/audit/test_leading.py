"""Of environments whose bodies nobody may move, the goal comes to the robot, or it stands where that is commanded."""

import numpy as np
import pytest

from rlctl.checking.audit import child, leading
from rlctl.checking.audit.competitors import Plays, list_competitors
from rlctl.checking.audit.ranking import rank
from rlctl.checking.drawn_goals import TURNED
from rlctl.checking.instance import Budget, Context
from rlctl.checking.progress import read_clock
from rlctl.checking.records import FIRST_SEED, Fact
from rlctl.checking.rule import NotJudged
from rlctl.environments.spec import EnvSpec
from tests.checking.judging import FOLDER

pytest.importorskip("mujoco")
MET, HOVERING, STANDING = "being met by the goal", "hovering beside the goal", "standing as commanded"
STILL = "doing nothing"
TURNING = "broken_progress.py:PuckSeeks"


def begin(name):
    context = Context(EnvSpec(str(FOLDER / name)))
    context.budget = Budget(read_clock() + 100.0)
    return context


def play(name, *only):
    """Return the episodes of some competitors, and who earns most."""
    context = begin(name)
    competitors = [one for one in list_competitors() if one.name in only]
    messages = list(child.play_rounds(context, competitors, 0, rounds=1))
    context.instance.close()
    assert all(isinstance(message, Fact) for message in messages), messages
    episodes = {message.value.competitor: message.value for message in messages}
    return episodes, rank(list(episodes.values()), any(one.success is not None for one in episodes.values()))


def test_the_goal_comes_to_a_robot_that_does_nothing():
    episodes, ranking = play("broken_paid.py:Docker", MET, HOVERING, STILL)
    assert episodes[MET].success
    assert 10 < episodes[MET].steps < leading.APPROACH  # it comes by and by: progress is paid
    assert not episodes[HOVERING].success
    assert episodes[STILL].reward < episodes[HOVERING].reward < episodes[MET].reward
    assert (ranking.wanted, ranking.beaten) == (MET, [])


def test_goals_are_played_that_are_far_away():
    context = begin("broken_paid.py:Docker")
    plays = Plays(context)
    goals = plays.lead.trials.drawn.goals
    away = {seed: np.linalg.norm(goals[seed]) for seed in range(FIRST_SEED, FIRST_SEED + 12)}  # from where it begins
    assert {*plays.seeds} == {*sorted(away, key=away.get)[-4:]}
    context.instance.close()


def test_where_some_episodes_have_no_goal_others_play(monkeypatch):
    def list_seeds(lead, count):
        raise NotJudged("not every episode has the goal")

    monkeypatch.setattr(leading.Lead, "list_seeds", list_seeds)
    episodes, _ = play("broken_paid.py:Docker", STILL)
    assert episodes[STILL].seed == FIRST_SEED


def test_who_waits_beside_the_goal_earns_more_than_one_who_is_there():
    _, ranking = play("broken_paid.py:RL605DockerWaits", MET, HOVERING)
    assert [(one.competitor, one.wanted) for one in ranking.beaten] == [(HOVERING, MET)]


def test_a_goal_that_is_observed_in_the_robots_frame_comes_to_it():
    context = begin(TURNING)
    lead = leading.find_lead(context)
    assert lead.source[1] == TURNED
    context.instance.close()
    episodes, _ = play(TURNING, MET, STILL)
    assert episodes[MET].success
    assert not episodes[STILL].success


def test_a_robot_stands_where_that_is_commanded():
    episodes, _ = play("broken_commands.py:PuckIsSent", STANDING, MET, STILL)
    assert episodes.keys() == {STANDING, STILL}
    assert episodes[STANDING].reward == pytest.approx(0.0, abs=0.1)
    assert episodes[STILL].reward < -5


@pytest.mark.parametrize("task", ["CartPole-v1", "reach"])
def test_what_has_no_goal_and_what_is_a_task_are_left_alone(task):
    context = Context(EnvSpec(task))
    context.budget = Budget(read_clock() + 100.0)
    competitors = [one for one in list_competitors() if one.name in (MET, STANDING)]
    assert list(child.play_rounds(context, competitors, 0, rounds=1)) == []
    context.instance.close()
