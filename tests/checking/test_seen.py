"""RL125: ways of the world that are turned by an orientation, instead of its inverse."""

import pytest

from tests.checking.judging import found_in_source

pytest.importorskip("mujoco")

FILE = "broken_seen.py"
PAIRS = {
    "ProbeSeesByTheMatrix": "Probe",
    "ProbeForgetsToNegate": "ProbeOfMujoco",
    "ScoutSeesTheOtherWay": "ScoutInObserve",
    "LoaderSeesTheOtherWay": "Loader",
    "LoaderByThePoseItself": "LoaderByPoses",
}


@pytest.mark.slow
@pytest.mark.pybullet
@pytest.mark.parametrize("name", PAIRS)
def test_finds_the_way_that_is_turned_wrongly(name):
    assert found_in_source(f"{FILE}:{name}").keys() == {"RL125"}
    assert not found_in_source(f"{FILE}:{PAIRS[name]}")


@pytest.mark.slow
@pytest.mark.pybullet
@pytest.mark.parametrize("name", ["Scout", "LoaderOnItsHead"])
def test_elements_in_a_function_and_a_joint_that_counts_clockwise(name):
    assert not found_in_source(f"{FILE}:{name}")
