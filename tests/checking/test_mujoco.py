"""RL116 and RL8 in MuJoCo: each mistake is found, in two robots where it can be made in both, and none in the twins."""

import pytest

from rlctl.checking.check import judge
from tests.checking.judging import case, check_case, findings, found, mark_slow, records_of, rules_of

pytest.importorskip("mujoco")


def broken(name, rule, severity="warning", twin=None, **settings):
    base = "mujoco_robots.py:MujocoArm" if name.startswith("Arm") else "mujoco_robots.py:MujocoHopper"
    return case(
        f"broken_mujoco.py:{name}", (rule, severity), twin=f"broken_mujoco.py:{twin}" if twin else base, **settings
    )


def broken_joints(name, rule, twin, severity="warning", **settings):
    return case(f"broken_mujoco_joints.py:{name}", (rule, severity), twin=f"broken_mujoco_joints.py:{twin}", **settings)


CASES = [
    broken("RL116ArmQuaternion", "RL116", "error", "RL116ArmRightQuaternion", slow=True),
    broken("RL116HopperQuaternion", "RL116", "error", slow=True),
    broken("RL116HopperVelocity", "RL116", "error", "RL116HopperRightVelocity", slow=True),
    broken("RL116HopperHeading", "RL116", "error", "RL116HopperRightHeading", slow=True),
    broken("RL804ArmBeyondLimits", "RL804", slow=True),
    broken("RL805HopperExplodes", "RL805", slow=True),
    broken("RL807HopperInTheGround", "RL807", slow=True),
    broken("RL813ArmLongSteps", "RL813", slow=True),
    broken("RL814ArmWeakMotors", "RL814", slow=True),
    broken("RL810ArmDegrees", "RL810", "error", slow=True),
    broken("RL810ArmRangeInDegrees", "RL810", "error", "ArmRange", slow=True),
    broken("RL810ArmRangeOfActuatorInDegrees", "RL810", slow=True),
    broken("RL810ArmDrivesRangesInDegrees", "RL810", "error", slow=True),
    broken("RL810HopperRangesInDegrees", "RL810", twin="HopperHolds", slow=True),
    broken("RL810ArmObservesRadiansOfRadians", "RL810", "error", slow=True),
    broken("RL810HopperStartsInDegrees", "RL810", "error", slow=True),
    broken("RL811ArmOrder", "RL811", "error", slow=True),
    broken("RL811ArmOrderOfRanges", "RL811", "error", "ArmRange", slow=True),
    broken("RL811HopperOrder", "RL811", "error", slow=True),
    broken("RL812ArmTouchesWithPalm", "RL812", twin="RL812ArmTouchesWithFinger", slow=True),
    broken("RL812HopperOtherSoles", "RL812", twin="RL812HopperThighs", slow=True),
    broken("RL815ArmOldTip", "RL815", slow=True),
    broken("RL815ArmOldSensor", "RL815", twin="RL815ArmRightSensor", slow=True),
    broken("RL815ArmResetsWithoutForward", "RL815", slow=True),
    broken("RL815ArmForwardTooEarly", "RL815", slow=True),
    broken("RL815HopperStateInTheLoop", "RL815", slow=True),
    broken("RL816ArmBeyondRange", "RL816", slow=True),
    broken("RL816ArmWithJetBeyondRange", "RL816", twin="ArmWithJet", slow=True),
    broken("RL816HopperTorqueBeyondRange", "RL816", twin="RL816HopperTorque", slow=True),
    broken("RL817ArmGrowsHeavy", "RL817", "error", "RL817ArmNominalMass", slow=True),
    broken("RL817HopperSlips", "RL817", "error", "RL817HopperFriction", slow=True),
    broken("RL302ArmKeepsActivation", "RL302", "error", "RL302ArmResets", slow=True),
    broken("RL301HopperKeepsTime", "RL301", "error", "RL301HopperResets", slow=True),
    broken("RL818ArmInverse", "RL818", twin="RL818ArmActuator", slow=True),
    broken("RL818HopperForces", "RL818", twin="RL818HopperRightForces", slow=True),
    broken("RL818HopperFeelsNothing", "RL818", twin="HopperFeels", slow=True),
    broken("RL818ArmFeelsNothing", "RL818", twin="ArmFeels", slow=True),
    case(
        "broken_mujoco_joints.py:RL804ArmLimitsInRadians",
        ("RL804", "warning"),
        twin="mujoco_robots.py:MujocoArm",
        slow=True,
    ),
    broken_joints("RL803RoverInTheGround", "RL803", "RoverByPositions", slow=True),
    broken_joints("RL811ArmIncrementsInOtherOrder", "RL811", "ArmIncrements", "error", slow=True),
    broken_joints("RL811HopperIncrementsInOtherOrder", "RL811", "RL811HopperIncrements", "error", slow=True),
    broken_joints("RL816ArmIncrementsTooFar", "RL816", "ArmIncrements", slow=True),
    broken_joints("RL816CartSpeedsUpTooFar", "RL816", "CartSpeedsUp", slow=True),
    broken_joints("RL816HopperPushesTooFar", "RL816", "HopperPushes", slow=True),
    broken_joints("RL119HopperInDegrees", "RL119", "HopperObserves", slow=True),
    broken_joints("RL819HopperSpeedsInOtherOrder", "RL819", "HopperObserves", slow=True),
    broken_joints("RL820ArmVelocityOfSubsteps", "RL820", "RL820ArmVelocity", slow=True),
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
@pytest.mark.parametrize("name", ["ArmPalmMustNotTouch", "HopperFalls"])
def test_a_part_that_must_not_touch_is_no_wrong_part(name):
    assert found(f"broken_mujoco.py:{name}", "RL812") == set()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "rule", "words"),
    [
        ("joints.py:RL804ArmLimitsInRadians", "RL804", ("in radians, and was read in degrees",)),
        ("joints.py:RL811ArmIncrementsInOtherOrder", "RL811", ("of joint wrist", "the start of joint shoulder")),
        (
            "joints.py:RL811HopperIncrementsInOtherOrder",
            "RL811",
            ("left_hip, follows the position of joint left_knee",),
        ),
        ("joints.py:RL816ArmIncrementsTooFar", "RL816", ("ctrl[2] (bend)", "opposite action then changes nothing")),
        ("joints.py:RL119HopperInDegrees", "RL119", ("position of joint left_hip, in degrees", "57.3 times")),
        ("joints.py:RL819HopperSpeedsInOtherOrder", "RL819", ("the speeds of left_hip, right_hip",)),
        ("joints.py:RL820ArmVelocityOfSubsteps", "RL820", ("divided by 0.004 s", "5 times too large")),
        ("RL116HopperQuaternion", "RL116", ("of body", "(w, x, y, z) read as x, y, z, w")),
        ("RL811ArmOrder", "RL811", ("another order", "shoulder")),
        ("RL811HopperOrder", "RL811", ("right_knee", "left_knee", "not of its own joint")),
        ("RL810ArmRangeInDegrees", "RL810", ("were taken for degrees", "shoulder")),
        ("RL810ArmDrivesRangesInDegrees", "RL810", ("turn is [-50, 120], in degrees (likewise lift, bend)",)),
        ("RL812HopperOtherSoles", "RL812", ("geom left_thigh",)),
        ("RL815ArmOldTip", "RL815", ("site_xpos of tip", "one substep old")),
        ("ArmOldTipOfGlobalDraws", "RL815", ("site_xpos of tip", "one substep old")),
        ("ArmOldTipSteers", "RL815", ("site_xpos of tip", "one substep old")),
        ("ArmOldTipInParts", "RL815", ("observation['goal'][0] (site_xpos of tip)", "observation['goal'][2]")),
        ("RL815ArmResetsWithoutForward", "RL815", ("of reset", "before mj_forward")),
        ("RL815HopperStateInTheLoop", "RL815", ("observation[0] (position of body)",)),
        ("RL816ArmBeyondRange", "RL816", ("only", "of the action's range")),
        ("RL816ArmWithJetBeyondRange", "RL816", ("ctrl[3] (bend)", "turn, lift")),
        ("RL817ArmGrowsHeavy", "RL817", ("body_mass[1] (upper)",)),
        ("RL817HopperSlips", "RL817", ("geom_friction[", ", 0]")),
        ("RL302ArmKeepsActivation", "RL302", ("reset keeps state (data.act",)),
        ("ArmGrowsHeavyAndRemembers", "RL302", ("reset keeps state (model.body_mass, self.last_targets)",)),
        ("RL818HopperForces", "RL818", ("data.cfrc_ext", "mj_rnePostConstraint")),
    ],
)
def test_finding_names_what_is_wrong(name, rule, words):
    task = f"broken_mujoco_{name}" if name.startswith("joints.py") else f"broken_mujoco.py:{name}"
    messages = " ".join(finding.message for finding in findings(task, rule))
    assert [word for word in words if word not in messages] == []


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "kept"),
    [
        ("ArmKeepsSpeed", "data.qvel[0]"),
        ("HopperKeepsPlace", "data.qpos[0]"),
        ("ArmKeepsActivation", "data.act[0]"),
        ("ArmKeepsMocap", "data.mocap_pos[0, "),
    ],
)
def test_kept_state_that_is_observed_is_named_first(name, kept):
    (finding,) = findings(f"broken_mujoco.py:{name}", "RL301")
    field = kept.partition("[")[0]
    assert f"reset keeps state ({field}" in finding.message
    assert f"; {finding.evidence['element']} is {kept}" in finding.message
    assert finding.fix.startswith(f"Set back in reset: {field}")
    assert finding.fix.endswith("mujoco.mj_resetData(model, data) sets back all of data.")


@pytest.mark.slow
def test_rules_that_compare_repeated_episodes_say_why_they_could_not():
    """RL815 would be a pass that nobody judged."""
    verdict = judge(records_of("broken_mujoco.py:ArmOldTipAtRandom", "build", "worlds"), ["RL815"])
    assert verdict.judged == []
    assert verdict.not_judged == {"RL815": "an episode with the same seed and actions is not the same again (RL302)"}


@pytest.mark.slow
def test_a_controller_may_read_where_the_tip_is():
    assert found("broken_mujoco.py:ArmSteers", "RL815") == set()


@pytest.mark.slow
def test_a_fix_names_the_calls_of_the_own_engine():
    [finding] = findings("broken_mujoco.py:RL815HopperStateInTheLoop", "RL815")
    assert "mj_forward" in finding.fix
    assert "getLinkState" not in finding.fix
    assert finding.name == "state is out of date"


@pytest.mark.slow
def test_fix_speaks_of_the_file_where_the_mistake_is():
    (in_file,) = findings("broken_mujoco.py:RL810HopperRangesInDegrees", "RL810")
    (in_code,) = findings("broken_mujoco.py:RL810ArmDegrees", "RL810")
    assert "In the XML" in in_file.fix
    assert "np.deg2rad" in in_code.fix
    assert "(likewise" in in_code.message


@pytest.mark.slow
def test_the_range_of_a_joint_without_limits_is_explained():
    (finding,) = findings("broken_mujoco.py:ArmSpaceOfRanges", "RL103")
    assert "the space allows [0, 0]" in finding.message
    assert finding.fix.startswith("Declare infinite bounds")
    assert findings("broken_mujoco.py:ArmSpaceOfLimits", "RL103") == []
