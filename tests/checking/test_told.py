"""RL620, RL621, RL630: terms in dictionaries of `info` that are not called `reward_terms`."""

import pytest

from tests.checking.judging import case, check_case, mark_slow

pytest.importorskip("mujoco")


def broken(name, twin):
    file = "broken_told.py"
    return case(f"{file}:{name}", (name[:5], "warning"), twin=f"{file}:{twin}", pybullet=True, slow=True)


ROBOTS = ("Rover", "Arm", "Reacher")
ENDS = {"RL620": "Forgets", "RL621": "PaidForTime", "RL630": "TellsSigns"}
CASES = [broken(f"{rule}{robot}{end}", f"{robot}Tells") for rule, end in ENDS.items() for robot in ROBOTS]


@pytest.mark.parametrize("case", mark_slow(CASES), ids=lambda case: case.broken)
def test_finds_the_mistake_and_only_that(case):
    check_case(case)
