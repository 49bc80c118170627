"""Rewards that rise with a distance, pay little for success, count with a sign, or compare a command with a number that
cannot meet it, or always does."""

import pytest

from rlctl.checking.command_sizes import SizeReader
from rlctl.checking.paid_distances import RiseReader
from rlctl.checking.paid_goals import GoalReader
from rlctl.checking.paid_successes import SuccessReader
from rlctl.checking.signed_costs import SignedCostReader
from tests.checking.judging import case, check_case, mark_slow, notes_of

FILE = "broken_amounts.py"


def broken(name, twin):
    return case(f"{FILE}:{name}", (name[:5], "warning"), twin=f"{FILE}:{twin}", slow=True)


CASES = [
    broken("RL622PuckFlees", "Puck"),
    broken("RL605PuckHolds", "PuckEnds"),
    broken("RL630PuckLeans", "PuckIsLevel"),
    broken("RL633PuckOnlySpeeds", "PuckFollows"),
    broken("RL632PuckIsAlwaysRight", "PuckIsTolerant"),
]


@pytest.mark.parametrize("case", mark_slow(CASES), ids=lambda case: case.broken)
def test_finds_the_mistake_and_only_that(case):
    check_case(case)


def judge(name, find):
    with notes_of(f"{FILE}:{name}") as notes:
        return find(notes)


def find_rises(notes):
    return [*GoalReader(notes).find_wrong_signs(), *RiseReader(notes).find_rises()]


def find_low_successes(notes):
    low = SuccessReader(notes).find()
    return [] if low is None else [low]


def find_signed(notes):
    return list(SignedCostReader(notes).find())


def find_one_sided(notes):
    return list(SizeReader(notes).find_one_sided())


def find_sizes_only(notes):
    return list(SizeReader(notes).find_sizes_only())


def find_always_met(notes):
    return list(SizeReader(notes).find_always_met())


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "twin", "find"),
    [
        ("RL622PuckFlees", "Puck", find_rises),
        ("PuckShuns", "PuckReaches", find_rises),
        ("PuckTurnsBack", "PuckHurries", find_rises),
        ("PuckSquaresUp", "PuckSquares", find_rises),
        ("RL605PuckHolds", "PuckEnds", find_low_successes),
        ("PuckReturnsLittle", "PuckReturns", find_low_successes),
        ("RL630PuckLeans", "PuckIsLevel", find_signed),
        ("PuckTurnsLeft", "PuckIsStraight", find_signed),
        ("PuckWearsOneSide", "PuckWearsBothSides", find_signed),
        ("RL633PuckOnlySpeeds", "PuckFollows", find_one_sided),
        ("PuckIsAsFast", "PuckIsAsFastThatWay", find_sizes_only),
        ("PuckTurnsEitherWay", "PuckTurnsAsTold", find_one_sided),
        ("RL632PuckIsAlwaysRight", "PuckIsTolerant", find_always_met),
        ("PuckHasWideKernels", "PuckHasKernels", find_always_met),
    ],
)
def test_the_mistake_is_found_in_each_form(name, twin, find):
    assert judge(name, find)
    assert not judge(twin, find)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["PuckOrbits", "PuckIsShaped", "PuckBacksUp"])
def test_what_looks_like_a_mistake_is_none(name):
    assert not judge(name, lambda notes: [*find_rises(notes), *find_signed(notes), *find_low_successes(notes)])
