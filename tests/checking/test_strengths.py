"""Motors that are too weak for their load, or have the strength of other joints."""

import pytest

from tests.checking.judging import findings

pytestmark = [pytest.mark.slow, pytest.mark.pybullet]


@pytest.mark.parametrize(
    ("robot", "joint", "force", "needed"),
    [
        ("CraneStrengthsExchanged", "hoist", 20, 5 * 9.81),
        ("ForkliftOtherOrder", "joint1", 60, 12 * 9.81),
    ],
)
def test_motors_of_speeds_that_cannot_carry_their_load_are_named(robot, joint, force, needed):
    (finding,) = findings(f"broken_strengths.py:{robot}", "RL814")
    assert finding.message.startswith(f"the motor of {joint} has at most {force} N, and to hold the weight at reset")
    assert finding.evidence["expected"] == pytest.approx(needed, rel=0.01)


@pytest.mark.parametrize("robot", ["CraneStrengths", "Forklift", "ForkliftOfSubsteps", "SwingUp"])
def test_motors_of_speeds_that_carry_their_load_or_swing_are_not(robot):
    assert findings(f"broken_strengths.py:{robot}", "RL814", "RL811") == []


@pytest.mark.parametrize(
    ("robot", "twin"), [("ArmStrengthsOfATable", "ArmStrengths"), ("ArmOfOtherTorques", "ArmOfTorques")]
)
def test_forces_in_another_order_than_those_of_the_model_are_named(robot, twin):
    (finding,) = findings(f"broken_strengths.py:{robot}", "RL811")
    assert "shoulder gets 50 N m, which the model has for wrist, and 100 for shoulder" in finding.message
    assert findings(f"broken_strengths.py:{twin}", "RL811", "RL814") == []
