"""RL116 and RL8 in MuJoCo: each mistake is found, in two robots where it can be made in both, and none in the twins."""

import pytest

from tests.checking.judging import case, check_case, findings, found, mark_slow, rules_of

pytest.importorskip("mujoco")


def broken(name, rule, severity="warning", twin=None, **settings):
    base = "mujoco_robots.py:MujocoArm" if name.startswith("Arm") else "mujoco_robots.py:MujocoHopper"
    return case(
        f"broken_mujoco.py:{name}", (rule, severity), twin=f"broken_mujoco.py:{twin}" if twin else base, **settings
    )


def broken_joints(name, rule, twin, severity="warning", **settings):
    return case(f"broken_mujoco_joints.py:{name}", (rule, severity), twin=f"broken_mujoco_joints.py:{twin}", **settings)


CASES = [
    broken("ArmQuaternion", "RL116", "error", "ArmRightQuaternion", slow=True),
    broken("HopperQuaternion", "RL116", "error"),
    broken("HopperVelocity", "RL116", "error", "HopperRightVelocity"),
    broken("HopperHeading", "RL116", "error", "HopperRightHeading"),
    broken("ArmBeyondLimits", "RL804"),
    broken("HopperExplodes", "RL805", slow=True),
    broken("HopperInTheGround", "RL807", slow=True),
    broken("ArmLongSteps", "RL813"),
    broken("ArmWeakMotors", "RL814"),
    broken("ArmDegrees", "RL810", "error"),
    broken("ArmRangeInDegrees", "RL810", "error", "ArmRange"),
    broken("ArmRangeOfActuatorInDegrees", "RL810"),
    broken("ArmObservesRadiansOfRadians", "RL810", "error"),
    broken("HopperStartsInDegrees", "RL810", "error"),
    broken("ArmOrder", "RL811", "error"),
    broken("ArmOrderOfRanges", "RL811", "error", "ArmRange"),
    broken("HopperOrder", "RL811", "error"),
    broken("ArmTouchesWithPalm", "RL812", twin="ArmTouchesWithFinger", slow=True),
    broken("HopperOtherSoles", "RL812", twin="HopperThighs"),
    broken("ArmOldTip", "RL815"),
    broken("ArmOldSensor", "RL815", twin="ArmRightSensor"),
    broken("ArmResetsWithoutForward", "RL815"),
    broken("ArmForwardTooEarly", "RL815"),
    broken("HopperStateInTheLoop", "RL815"),
    broken("ArmBeyondRange", "RL816"),
    broken("HopperTorqueBeyondRange", "RL816", twin="HopperTorque"),
    broken("ArmGrowsHeavy", "RL817", "error", "ArmNominalMass"),
    broken("HopperSlips", "RL817", "error", "HopperFriction"),
    broken("ArmKeepsActivation", "RL302", "error", "ArmResets"),
    broken("HopperKeepsTime", "RL301", "error", "HopperResets", slow=True),
    broken("ArmInverse", "RL818", twin="ArmActuator", slow=True),
    broken("HopperForces", "RL818", twin="HopperRightForces"),
    case("broken_mujoco_joints.py:ArmLimitsInRadians", ("RL804", "warning"), twin="mujoco_robots.py:MujocoArm"),
    broken_joints("ArmIncrementsInOtherOrder", "RL811", "ArmIncrements", "error"),
    broken_joints("HopperIncrementsInOtherOrder", "RL811", "HopperIncrements", "error"),
    broken_joints("ArmIncrementsTooFar", "RL816", "ArmIncrements"),
    broken_joints("HopperInDegrees", "RL119", "HopperObserves"),
    broken_joints("HopperSpeedsInOtherOrder", "RL819", "HopperObserves", slow=True),
    broken_joints("ArmVelocityOfSubsteps", "RL820", "ArmVelocity", slow=True),
]
CLEAN = [f"broken_mujoco_joints.py:{name}" for name in ("ArmFollowsMeasured", "ArmResolvesMotion")]
IN_DEGREES = "broken_mujoco_joints.py:HopperAllInDegrees"  # RL118 says that such numbers are large


@pytest.mark.parametrize("case", mark_slow(CASES), ids=lambda case: case.broken)
def test_finds_the_mistake_and_only_that(case):
    check_case(case)


@pytest.mark.slow
@pytest.mark.parametrize("task", [*CLEAN, IN_DEGREES])
def test_clean_is_clean(task):
    assert found(task, "RL119", *rules_of("RL8")) == set()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "rule", "words"),
    [
        ("joints.py:ArmLimitsInRadians", "RL804", ("in radians, and was read in degrees",)),
        ("joints.py:ArmIncrementsInOtherOrder", "RL811", ("of joint wrist", "the start of joint shoulder")),
        ("joints.py:HopperIncrementsInOtherOrder", "RL811", ("left_hip, follows the position of joint left_knee",)),
        ("joints.py:ArmIncrementsTooFar", "RL816", ("ctrl[2] (bend)", "opposite action then changes nothing")),
        ("joints.py:HopperInDegrees", "RL119", ("joint left_hip in degrees", "is in rad/s")),
        ("joints.py:HopperSpeedsInOtherOrder", "RL819", ("the speeds of left_hip, right_hip",)),
        ("joints.py:ArmVelocityOfSubsteps", "RL820", ("divided by 0.004 s", "5 times too large")),
        ("HopperQuaternion", "RL116", ("of body", "(w, x, y, z) read as x, y, z, w")),
        ("ArmOrder", "RL811", ("another order", "shoulder")),
        ("HopperOrder", "RL811", ("right_knee", "left_knee", "not of its own joint")),
        ("ArmRangeInDegrees", "RL810", ("were taken for degrees", "shoulder")),
        ("HopperOtherSoles", "RL812", ("geom left_thigh",)),
        ("ArmOldTip", "RL815", ("site_xpos of tip", "one substep old")),
        ("ArmResetsWithoutForward", "RL815", ("of reset", "before mj_forward")),
        ("HopperStateInTheLoop", "RL815", ("observation[0] (position of body)",)),
        ("ArmBeyondRange", "RL816", ("only", "of the action's range")),
        ("ArmGrowsHeavy", "RL817", ("body_mass[1] (upper)",)),
        ("HopperSlips", "RL817", ("geom_friction[", ", 0]")),
        ("ArmKeepsActivation", "RL302", ("reset keeps state (data.act",)),
        ("HopperForces", "RL818", ("data.cfrc_ext", "mj_rnePostConstraint")),
    ],
)
def test_finding_names_what_is_wrong(name, rule, words):
    task = f"broken_mujoco_{name}" if name.startswith("joints.py") else f"broken_mujoco.py:{name}"
    messages = " ".join(finding.message for finding in findings(task, rule))
    assert [word for word in words if word not in messages] == []
