"""RL620, RL626, RL627, RL628, RL637, RL638, RL641: values that the source keeps from step to step."""

import pytest

from rlctl.checking.previous_values import KeptDifferences
from tests.checking.judging import case, check_case, found_in_source, mark_slow, notes_of

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


@pytest.mark.slow
@pytest.mark.parametrize("name", PAIRS)
def test_reads_the_source(name):
    found = found_in_source(f"{FILE}:{name}")
    assert [*found] == [name[:5]]
    file, line = found[name[:5]].where
    assert file.endswith(FILE)
    assert line > 1
    assert not found_in_source(f"{FILE}:{PAIRS[name]}")


def test_the_rest_of_a_course_goes_on_without_a_jump():
    assert not found_in_source(f"{FILE}:BoatRestOfCourse")


def test_a_target_of_a_motor_in_the_same_step_is_no_new_goal():
    with notes_of(f"{FILE}:BoatStrides") as notes:
        kept = notes.share(KeptDifferences)
        in_step = [one for one in notes.definitions.assigned["last_error"] if one.function.name == "step"]
        assert in_step
        assert not any(map(kept.comes_with_goal, in_step))
