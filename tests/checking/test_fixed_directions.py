"""RL124, RL130: directions that are fixed in the world, and velocities in the frame of a robot."""

import pytest

from tests.checking.judging import case, check_case, mark_slow, verdict_of

pytest.importorskip("mujoco")


def broken(name, twin, rule, **settings):
    file = "broken_fixed_directions.py"
    return case(f"{file}:{name}", (rule, "warning"), twin=f"{file}:{twin}", pybullet=True, **settings)


CASES = [
    broken("RL124SatelliteStar", "Satellite", "RL124", slow=True),
    broken("RL124SatelliteOfMatrixStar", "SatelliteOfMatrix", "RL124", slow=True),
    broken("RL124ProbeBeacon", "Probe", "RL124", slow=True),
    broken("RL130ProbePoint", "Probe", "RL130"),
    broken("RL130PuckPoint", "PuckWithPlace", "RL130", slow=True),
    broken("RL130BoatPoint", "Boat", "RL130", slow=True),
]


@pytest.mark.parametrize("case", mark_slow(CASES), ids=lambda case: case.broken)
def test_finds_the_mistake_and_only_that(case):
    check_case(case)


def test_what_raises_where_the_check_moved_an_attribute_is_no_failure():
    verdict = verdict_of("broken_fixed_directions.py:SatelliteOfMatrix", "RL129", "RL207")
    assert verdict.findings == []
    assert verdict.not_judged["RL129"].startswith(
        "step raised in a state that the check made: ValueError: Non-positive"
    )
