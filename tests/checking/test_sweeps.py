"""RL634 and RL635: which value of the command pays most, with the same motion."""

import pytest

from tests.checking.judging import case, check_case, found, mark_slow

pytest.importorskip("mujoco")
FILE = "broken_sweeps.py"


def broken(name, twin, **settings):
    return case(f"{FILE}:{name}", (name[:5], "warning"), twin=f"{FILE}:{twin}", **settings)


CASES = [
    broken("RL634RoverRaces", "Rover", slow=True),
    broken("RL634BoatFleesTheCommand", "Boat", slow=True),
    broken("RL635RoverTurnsAboutItsSide", "Rover", slow=True),
    broken("RL635RoverTurnsBack", "Rover", slow=True),
    broken("RL635BoatTurnsBack", "Boat", slow=True),
]


@pytest.mark.parametrize("case", mark_slow(CASES), ids=lambda case: case.broken)
def test_finds_the_mistake_and_only_that(case):
    check_case(case)


@pytest.mark.slow
@pytest.mark.parametrize("sound", ["RoverIsCapped", "BoatGoesAlong"])
def test_a_reward_without_a_best_command_may_be_meant(sound):
    assert found(f"{FILE}:{sound}", "RL634", "RL635") == set()
