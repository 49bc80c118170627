"""RL643, RL633: kernels of another quantity than their name says, and lengths of velocities that are called a part."""

import pytest

from tests.checking.judging import case, check_case, found_in_source, mark_slow

PAIRS = {
    "broken_kernels.py:CartNearByTurning": ("RL643", "Cart"),
    "broken_kernels.py:RL643CartAlignedByDistance": ("RL643", "CartOfTerms"),
    "broken_kernels.py:CartSwapsTheWidth": ("RL643", "CartShapesItsWidth"),
    "broken_kernels.py:CartSwapsItInTerms": ("RL643", "CartOfTerms"),
    "broken_ahead.py:HovercraftAnyWay": ("RL633", "Hovercraft"),
    "broken_ahead.py:HovercraftOffTheStreet": ("RL633", "HovercraftOnTheStreet"),
    "broken_ahead.py:HovercraftOfLengths": ("RL633", "HovercraftOfTerms"),
}
CASES = [
    case(
        "broken_kernels.py:RL643CartAlignedByDistance",
        ("RL643", "warning"),
        twin="broken_kernels.py:CartOfTerms",
        slow=True,
    )
]


@pytest.mark.parametrize("case", mark_slow(CASES), ids=lambda case: case.broken)
def test_finds_the_mistake_and_only_that(case):
    check_case(case)


@pytest.mark.slow
@pytest.mark.parametrize("name", PAIRS)
def test_finds_what_is_paid_in_place_of_what_is_meant(name):
    rule, twin = PAIRS[name]
    assert rule in found_in_source(name)
    assert not found_in_source(f"{name.partition(':')[0]}:{twin}")


@pytest.mark.slow
@pytest.mark.parametrize("name", ["HovercraftIsFast", "Tricycle"])
def test_lengths_that_are_meant(name):
    assert not found_in_source(f"broken_ahead.py:{name}")
