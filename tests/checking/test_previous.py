"""RL620, RL626, RL627, RL628, RL637, RL638, RL641: values that the source keeps from step to step."""

import pytest

from rlctl.checking.experiments.expressions import note_expressions
from rlctl.checking.instance import Budget, Context
from rlctl.checking.progress import read_clock
from rlctl.checking.records import Fact
from rlctl.checking.rule import RuleFinding
from rlctl.environments.spec import EnvSpec
from tests.checking.judging import FOLDER, case, check_case, mark_slow

FILE = "broken_previous.py"
PAIRS = {
    "RL620BoatSmoothTooEarly": "BoatSmooth",
    "RL620BoatNormedTooEarly": "BoatNormed",
    "RL627BoatOnCourseOldBuoy": "BoatOnCourse",
    "RL627BoatInTimeOldBuoy": "BoatInTime",
    "RL627BoatInTimeBuoyFirst": "BoatInTime",
    "RL627BoatsMaskOldGoal": "BoatsMask",
    "RL627BoatsWhereOldGoal": "BoatsWhere",
    "RL628BoatPaddlesInEachStep": "BoatPaddles",
    "RL628BoatPaddlesAtOnceInEachStep": "BoatPaddlesAtOnce",
    "RL637BoatAheadFromTheStart": "BoatAhead",
    "RL626BoatFromBothEnds": "BoatFromItsBow",
    "RL638BoatOnCommandShowsTheFirst": "BoatOnCommand",
    "RL638BoatKeepsItsFirstWay": "BoatShowsItsWay",
    "RL641BoatStaysNowAndThen": "BoatStays",
    "RL641BoatStaysMaskedNowAndThen": "BoatStaysMasked",
}
CASES = [
    case(f"{FILE}:{name}", (name[:5], "warning"), twin=f"{FILE}:{twin}", slow=True) for name, twin in PAIRS.items()
]


@pytest.mark.parametrize("case", mark_slow(CASES), ids=lambda case: case.broken)
def test_finds_the_mistake_and_only_that(case):
    check_case(case)


def read_source(name):
    """Return the rules that find something in the expressions of a class, with the lines."""
    context = Context(EnvSpec(f"{FOLDER / FILE}:{name}"))
    context.budget = Budget(read_clock() + 100)
    messages = list(note_expressions.run(context))
    facts = [one for message in messages if isinstance(message, Fact) for one in message.value]
    found = [one for one in [*messages, *facts] if isinstance(one, RuleFinding)]
    return {one.rule: one.where for one in found}


@pytest.mark.slow
@pytest.mark.parametrize("name", PAIRS)
def test_reads_the_source(name):
    found = read_source(name)
    assert [*found] == [name[:5]]
    file, line = found[name[:5]]
    assert file.endswith(FILE)
    assert line > 1
    assert not read_source(PAIRS[name])


def test_the_rest_of_a_course_goes_on_without_a_jump():
    assert not read_source("BoatRestOfCourse")
