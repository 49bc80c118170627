"""RL627: progress counts a new goal."""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from rlctl.checking.drawn_goals import Numbers, Source
from rlctl.checking.experiments.expressions import NotedEpisodes, judges_expressions
from rlctl.checking.experiments.goals import judges_goals
from rlctl.checking.goal_draws import GoalDraws
from rlctl.checking.goal_episodes import HELD_STEPS, PLACED_STEPS, GoalEpisode, GoalTrials
from rlctl.checking.records import FIRST_SEED, ChildMessage, Skipped
from rlctl.checking.rule import Rule, RuleFinding, Severity

RULE = Rule(
    "RL627",
    "progress counts a new goal",
    Severity.WARNING,
    meaning="""
        The reward pays progress, the distance before minus the distance now, and where a goal is reached and the next
        one is drawn, the distance before is still that to the old goal. The first step towards the new goal is paid as
        if the robot had been carried away by the whole way between both: the more goals it reaches, the more it loses.
        The check put the goal at the robot, so that the environment went on to the next one; or it let the condition in
        the source be true under which the next goal comes, and the difference to the value before then jumped, in that
        step or in the next one.
    """,
    fix="Compute the distance to the new goal where the goal changes, and keep that as the distance before.",
)

EPISODES, MOST_EPISODES = 3, 10  # in which the next goal came, that are needed and that are tried
LEAST_WAY = 0.1  # part of the goals' range: what is farther is another goal
CALM = 5.0  # times as large as the changes of later rewards
SAME = 0.3  # relative difference of what is lost per way
POSES, MOST_POSES, UNLIKE = 6, 16, 0.1  # episodes with poses, and what no price per way and per angle explains
VARIED = 1.2  # the longest of the ways is so many times the shortest


class _Switch(NamedTuple):
    """A step after the goal has changed."""

    way: float  # to the new goal
    turn: float  # and the angle to it, where a goal is a pose [rad]
    jump: float  # of the reward against the steps that follow
    noise: float  # how far these differ


@judges_expressions(RULE, decides=False)
def _find_jumps(noted: NotedEpisodes) -> Iterator[RuleFinding]:
    for one in noted.share(GoalDraws).find_jumps():
        difference = one.difference
        when = f"in which {one.key} changes" if one.at_once else f"after {one.key} has changed"
        message = f"in the step {when}, {difference.whole.text} is up to {one.jump:.3g}, and at most"
        message += f" {one.usual:.3g} in nearly all other steps: {difference.key} is not computed again for the"
        message += f" new {one.key}, which comes if {one.test}; tried in {one.episodes} episodes"
        evidence = {"element": one.key, "value": one.jump, "expected": one.usual}
        yield RuleFinding(RULE, message, evidence, where=difference.whole.where)


@judges_goals(RULE)
def _find_counted_goals(trials: GoalTrials) -> Iterator[ChildMessage]:
    shown = next(iter([*trials.drawn.copies, *trials.drawn.turned]))
    episode = GoalEpisode(trials, FIRST_SEED, "zero", PLACED_STEPS)
    if episode.has_ended:
        yield Skipped(RULE.id, "episodes are too short, or begin with a success", applies=False)
        return
    known = trials.at_goal.source
    for source in trials.list_sources(episode) if known is None else [known]:
        switches: list[_Switch] = []
        fewest, most = (POSES, MOST_POSES) if trials.drawn.place.is_pose else (EPISODES, MOST_EPISODES)
        for seed in range(FIRST_SEED, FIRST_SEED + most):
            switch = _play(trials, source, shown, seed)
            switches += [] if switch is None else [switch]
            if (not switches and seed > FIRST_SEED) or _are_enough(switches, fewest):
                break
        if _are_enough(switches, fewest):
            yield from _judge(trials, switches)
            return
    yield Skipped(RULE.id, "no other goal followed when one was reached", applies=False)


def _are_enough(switches: Sequence[_Switch], fewest: int) -> bool:
    """Say whether there are several, with ways so different that a bonus is none of them."""
    ways = [switch.way for switch in switches]
    return len(ways) >= fewest and max(ways) > VARIED * min(ways)


def _play(trials: GoalTrials, source: Source, shown: Source, seed: int) -> _Switch | None:
    """Put the goal at a place by a source; return what the next steps pay if another goal follows."""
    episode = GoalEpisode(trials, seed, "zero", PLACED_STEPS, together=False)
    if episode.has_ended or not np.array_equal(trials.drawn.place.read(trials.instance.env), episode.goal):
        return None  # it has gone on to another goal already
    is_absolute = np.allclose(_read(episode, shown), episode.goal, atol=1e-4)
    for _ in range(1 + (HELD_STEPS if source[1] else 0)):  # a place by itself may be anything: it is not held
        place = episode.read(source)
        # From where the observation has the way to the goal: the robot, or what carries it.
        begin = np.zeros(place.size) if is_absolute else episode.read(shown)
        episode.step(place)
        seen = _read(episode, shown) / trials.drawn.read_scale(shown[0])
        off = float(np.linalg.norm(seen - place)) if is_absolute else float(np.linalg.norm(seen))
        # The way from what has to be at the goal is 0 there.
        expected = 0.0 if is_absolute or source == shown else float(np.linalg.norm(place - begin))
        is_another = episode.has_moved_on or abs(off - expected) > LEAST_WAY * float(np.linalg.norm(trials.range))
        if episode.has_ended or is_another:
            break
    if episode.has_ended or not is_another:
        return None
    way = episode.measure_distance(source) if source[1] and not is_absolute else off
    if way < LEAST_WAY * float(np.linalg.norm(trials.range)):
        return None
    turn = 0.0
    if trials.drawn.place.is_pose:
        *along, turn = _read(episode, shown).tolist()
        way = float(np.linalg.norm(along))
    rewards = np.array([step.reward for step in episode.play([None] * 4)])
    if len(rewards) < 4 or not np.isfinite(rewards).all():
        return None
    return _Switch(way, abs(turn), float(rewards[0] - np.median(rewards[1:])), float(np.ptp(rewards[1:])))


def _read(episode: GoalEpisode, shown: Source) -> Numbers:
    return episode.observed[shown[0] : shown[0] + episode.goal.size]


def _judge(trials: GoalTrials, switches: Sequence[_Switch]) -> Iterator[RuleFinding]:
    ways, turns, jumps, noise = (np.array(column) for column in zip(*switches, strict=True))
    is_clear = bool((jumps < -CALM * np.maximum(noise, 1e-6)).all())
    if not is_clear:
        return
    columns = np.column_stack([ways, turns] if trials.drawn.place.is_pose else [ways])
    lost = np.linalg.lstsq(columns, -jumps, rcond=None)[0]
    if trials.drawn.place.is_pose:
        is_lost = bool((lost >= 0).all() and np.abs(columns @ lost + jumps).max() < UNLIKE * np.abs(jumps).max())
    else:
        is_lost = np.ptp(-jumps / ways) < SAME * (-jumps / ways).mean()
    if is_lost:
        name, loss = trials.drawn.name, float((-jumps / ways).mean() if len(lost) == 1 else lost[0])
        message = (
            f"the step after {name} was reached pays {-jumps[0]:.3g} less than the following ones, and the next goal"
        )
        message += f" is {ways[0]:.3g} away: {loss:.3g} per way"
        message += f" and {lost[1]:.3g} per rad" if len(lost) > 1 else ""
        message += f" in {len(switches)} episodes, as if the robot had moved"
        evidence = {"element": name, "seed": FIRST_SEED, "value": float(jumps[0]), "expected": 0.0}
        yield RuleFinding(RULE, message, evidence)
