"""RL838: commands that act in one of several steps of the physics."""

import pytest

from tests.checking.judging import case, check_case, findings, found, mark_slow

pytest.importorskip("mujoco")

FILE = "broken_short.py"
PAIRS = {
    "PodPushesOnce": "Pod",
    "PodPushesAfterwards": "PodBumped",
    "SwimmerPushesOnce": "Swimmer",
    "RL838SliderTorquesOnce": "Slider",
    "SliderTorquesInTheFirst": "SliderVelocities",
    "GantryLetsGo": "Gantry",
    "GantryForcesOnce": "GantryForces",
    "GantryJointForcesOnce": "Gantry",
}
CASES = [case(f"{FILE}:RL838SliderTorquesOnce", ("RL838", "warning"), twin=f"{FILE}:Slider", pybullet=True, slow=True)]


@pytest.mark.parametrize("case", mark_slow(CASES), ids=lambda case: case.broken)
def test_finds_the_mistake_and_only_that(case):
    check_case(case)


@pytest.mark.slow
@pytest.mark.pybullet
@pytest.mark.parametrize("name", PAIRS)
def test_finds_commands_of_one_physics_step(name):
    assert found(f"{FILE}:{name}", "RL838") == {("RL838", "warning")}
    assert found(f"{FILE}:{PAIRS[name]}", "RL838") == set()


@pytest.mark.slow
@pytest.mark.pybullet
@pytest.mark.parametrize("name", ["PodShaken", "PodImpulses"])
def test_impulses_are_left_out(name):
    assert found(f"{FILE}:{name}", "RL838") == set()


@pytest.mark.slow
@pytest.mark.pybullet
def test_names_the_line():
    (finding,) = findings(f"{FILE}:RL838SliderTorquesOnce", "RL838")
    assert "one of the 4 steps of the physics" in finding.message
    assert finding.where is not None
