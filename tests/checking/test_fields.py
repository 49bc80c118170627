"""RL834, RL839: fields of PyBullet's tuples that are something else than what is meant."""

import pytest

from tests.checking.judging import case, check_case, found_in_source, mark_slow

FILE = "broken_fields.py"
FORCES = ["RamAny", "RamConstant", "RamSum", "RamLargest"]
OTHERS = ["RamForces", "RamForceSum", "RamTorqueAsSpeed", "RamSpeeds", "RL839RamSwapped", "RamTurnAsSpeed"]
OTHERS += ["RamNormalAsPlace"]
WRONG = dict.fromkeys(FORCES, "RL834") | dict.fromkeys(OTHERS, "RL839")
CASES = [case(f"{FILE}:RL839RamSwapped", ("RL839", "warning"), twin=f"{FILE}:Ram", pybullet=True, slow=True)]


@pytest.mark.parametrize("case", mark_slow(CASES), ids=lambda case: case.broken)
def test_finds_the_mistake_and_only_that(case):
    check_case(case)


@pytest.mark.slow
@pytest.mark.pybullet
@pytest.mark.parametrize("name", WRONG)
def test_another_field_is_read(name):
    assert found_in_source(f"{FILE}:{name}").keys() == {WRONG[name]}


@pytest.mark.slow
@pytest.mark.pybullet
@pytest.mark.parametrize("name", ["Ram", "RamApart", "RamOtherNames"])
def test_fields_that_fit(name):
    assert found_in_source(f"{FILE}:{name}") == {}
