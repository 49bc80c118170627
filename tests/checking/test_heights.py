"""Goals beyond what joints or a clipped command allow along one axis."""

import pytest

from tests.checking.judging import found_in_source

pytest.importorskip("mujoco")
pytestmark = pytest.mark.slow


@pytest.mark.parametrize(
    ("robot", "text"),
    [
        ("LampMastTooLow", "self.plant[2] is out of reach"),
        ("MicroscopeAboveTheDish", "self.lens[2] gets to 0.04 at most; np.clip(self.lens"),
    ],
)
def test_goals_beyond_a_component_are_named(robot, text):
    finding = found_in_source(f"broken_heights.py:{robot}")["RL619"]
    assert text in finding.message


@pytest.mark.parametrize("robot", ["LampMast", "LampBeside", "Microscope"])
def test_goals_within_reach_are_not(robot):
    assert "RL619" not in found_in_source(f"broken_heights.py:{robot}")
