"""Ten mistakes of rewards on two robots are named with the term that pays; their sound twins stay silent."""

import dataclasses

import pytest

from rlctl.checking.audit import child
from rlctl.checking.audit.competitors import WANTED as WANTED_PLAYS
from rlctl.checking.audit.competitors import list_competitors
from rlctl.checking.audit.ranking import Ranking, rank
from rlctl.checking.instance import Context
from rlctl.checking.records import CallFailure, Fact
from rlctl.engine import MUJOCO
from rlctl.environments.spec import EnvSpec
from tests.checking.audit import mistakes

FILE = mistakes.__file__


@dataclasses.dataclass(frozen=True)
class Case:
    """A mistake, its sound twin, and who earns too much by which term."""

    broken: str
    twin: str
    competitor: str
    term: str


CASES = [
    Case("PaidForLiving", "PaidForFollowing", "standing still", "alive"),
    Case("CostsMoreThanItPays", "PaysMoreThanItCosts", "falling at once", "torque"),
    Case("WideKernel", "NarrowKernel", "standing still", "tracking"),
    Case("UnsignedProgress", "SignedProgress", "the reversed command", "unsigned_progress"),
    Case("PaidForSteps", "PaidForStepsThatMove", "stepping in place", "air_time"),
    Case("ClearanceOfStillFeet", "ClearanceCosts", "standing still", "clearance"),
    Case("UprightReversed", "Upright", "lying on its back", "upside_down"),
    Case("EndsAtTheGoal", "StaysAtTheGoal", "hovering beside the goal", "near"),
    Case("PaidForMovement", "PaidForApproach", "saturating", "movement"),
    Case("ActionsCostTooMuch", "ActionsCostLittle", "doing nothing", "action"),
]
QUICK = (CASES[0], CASES[7])
WANTED = ("following the command", "reaching the goal")


def play(name: str, only: tuple[str, ...] = (), **parameters: object) -> Ranking:
    """Return the ranking after one round, of all competitors or of some."""
    context = Context(EnvSpec(f"{FILE}:{name}", parameters))
    competitors = [one for one in list_competitors() if not only or one.name in only]
    messages = list(child.play_rounds(context, competitors, 0, rounds=1))
    context.instance.close()
    facts = [message for message in messages if isinstance(message, Fact)]
    assert len(facts) == len(messages), messages
    return rank([fact.value for fact in facts], has_success=True)


@pytest.mark.slow_except(first=1)
@pytest.mark.pybullet
@pytest.mark.parametrize("case", QUICK, ids=lambda case: case.broken)
def test_names_who_earns_too_much_and_the_term(case):
    ranking = play(case.broken, (*WANTED, case.competitor), episode_s=0.6)
    assert [(one.competitor, one.term) for one in ranking.beaten] == [(case.competitor, case.term)]


@pytest.mark.slow_except(first=1)
@pytest.mark.pybullet
@pytest.mark.parametrize("case", QUICK, ids=lambda case: case.twin)
def test_is_silent_for_a_sound_reward(case):
    ranking = play(case.twin, (*WANTED, case.competitor), episode_s=0.6)
    assert ranking.wanted in WANTED
    assert not ranking.beaten


@pytest.mark.pybullet
def test_a_competitor_that_the_task_cannot_play_leaves_the_others():
    context = Context(EnvSpec(f"{FILE}:RaisesAtFullAction", {"episode_s": 0.3}))
    competitors = [one for one in list_competitors() if one.name in ("saturating", "doing nothing", "drifting")]
    messages = list(child.play_rounds(context, competitors, 0, rounds=1))
    context.instance.close()
    assert [m.value.competitor for m in messages if isinstance(m, Fact)] == ["doing nothing", "drifting"]
    (failure,) = [m for m in messages if isinstance(m, CallFailure)]
    assert failure.phase == "saturating"
    assert "too much" in failure.error


@pytest.mark.slow
@pytest.mark.pybullet
@pytest.mark.parametrize("case", CASES, ids=lambda case: case.broken)
def test_names_the_mistake_among_all_competitors(case):
    first = play(case.broken).beaten[0]
    assert (first.competitor, first.term) == (case.competitor, case.term)


@pytest.mark.slow
@pytest.mark.pybullet
@pytest.mark.parametrize("case", CASES, ids=lambda case: case.twin)
def test_no_competitor_beats_a_sound_twin(case):
    ranking = play(case.twin)
    assert ranking.wanted
    assert not ranking.beaten


@pytest.mark.slow
@pytest.mark.parametrize("name", ["PaidForLiving", "PaidForFollowing"])
def test_judges_alike_in_mujoco(name):
    context = Context(dataclasses.replace(EnvSpec(f"{FILE}:{name}"), sim=MUJOCO))
    facts = [m.value for m in child.play_rounds(context, list_competitors(), 0, rounds=1) if isinstance(m, Fact)]
    ranking = rank(facts, has_success=True)
    assert ranking.wanted == "following the command"
    assert [one.term for one in ranking.beaten[:1]] == (["alive"] if name == "PaidForLiving" else [])


def test_two_processes_begin_at_both_ends_of_the_list():
    even, odd = (child.order(list_competitors(), number) for number in (0, 1))
    first = len(WANTED_PLAYS)
    assert {*even[:first]} == {*odd[:first]} == {*WANTED_PLAYS}
    assert even[first:] == odd[: first - 1 : -1]
