"""RL618, as the source shows it."""

import pytest

from tests.checking.judging import case, check_case, found_in_source, mark_slow

FILE = "broken_unwrapped.py"
PAIRS = {"RL618BoatPointsTheLongWay": "BoatPoints", "RL618ValveTurnsTheLongWay": "Valve"}
CASES = [case(f"{FILE}:{name}", ("RL618", "warning"), twin=f"{FILE}:{twin}", slow=True) for name, twin in PAIRS.items()]


@pytest.mark.parametrize("case", mark_slow(CASES), ids=lambda case: case.broken)
def test_finds_the_mistake_and_only_that(case):
    check_case(case)


@pytest.mark.slow
@pytest.mark.parametrize("name", PAIRS)
def test_a_turn_more_changes_the_reward(name):
    assert [*found_in_source(f"{FILE}:{name}")] == ["RL618"]
    assert not found_in_source(f"{FILE}:{PAIRS[name]}")


@pytest.mark.slow
def test_angles_between_stops_are_no_directions():
    assert not found_in_source(f"{FILE}:ValveHasStops")
