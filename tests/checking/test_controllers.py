"""RL824: forces with the wrong sign are found in robots that differ, and not in those that carry their weight."""

import pytest

from tests.checking.judging import case, check_case, findings, mark_slow

pytest.importorskip("mujoco")


def broken(name, twin, **settings):
    file = "broken_controllers.py"
    return case(f"{file}:{name}", ("RL824", "warning"), twin=f"{file}:{twin}", **settings)


CASES = [
    broken("RL824HopperShakes", "HopperDamps", slow=True),
    broken("RL824LeverRepels", "Lever", slow=True),
    broken("RL824HopperRepels", "HopperDamps", slow=True),
    broken("RL824ArmRepels", "ArmDamps", slow=True),
    broken("RL824CartRepels", "CartKeepsSpeed", slow=True),
    broken("RL824CraneRepels", "Crane", slow=True),
]


@pytest.mark.parametrize("case", mark_slow(CASES), ids=lambda case: case.broken)
def test_finds_the_mistake_and_only_that(case):
    check_case(case)


@pytest.mark.slow
def test_finding_names_the_stiffness():
    (finding,) = findings("broken_controllers.py:RL824CraneRepels", "RL824")
    assert "joint rail pushes in the direction of its position, by 80 N/m" in finding.message
