"""Which single changes of an imported policy's mapping are tried."""

from pathlib import Path

import pytest

from rlctl.task.deployment import Deployment
from rlctl.task.mujoco.robot import Robot
from rlctl_robot.diagnose.variants import list_variants

DOGS = ["FR_hip", "FR_knee", "FL_hip", "FL_knee", "RR_hip", "RR_knee", "RL_hip", "RL_knee"]
ANYMALS = ["LF_HAA", "LF_KFE", "RF_HAA", "RF_KFE", "LH_HAA", "LH_KFE", "RH_HAA", "RH_KFE"]
PEOPLE = ["Waist", "Left_Hip", "Left_Knee", "Right_Hip", "Right_Knee"]


def list_changes(joints, **values):
    """Return what the variants change, by kind and text."""
    count = len(joints)
    gains = {"stiffness": [40.0] * count, "damping": [1.0] * count, "action_scale": [0.25] * count}
    positions = [0.1 * (index + 1) for index in range(count)]
    parts = [{"kind": "gravity"}, {"kind": "joint_positions"}]
    ranges = {"lin_vel_x": [-1.0, 1.0]}
    content = {"default_positions": positions, "observations": parts, "control_dt": 0.02, "start_height": 0.5}
    deployment = Deployment(joints=joints, commands=ranges, **gains, **{**content, **values})
    own = tuple(joints)
    named = {"joints": own, "motors": (), "breadth_first": own, "links": ("trunk",)}
    robot = Robot(Path("robot.xml"), limits={}, ranges={}, has_armature=True, **named)
    return {
        (variant.kind, variant.text): variant.list_changes(deployment) for variant in list_variants(deployment, robot)
    }


@pytest.mark.parametrize(
    ("joints", "groups"),
    [
        (DOGS, ["FR_hip and FL_hip and RR_hip and RL_hip", "FR_hip and FL_hip", "FR_knee and RR_knee"]),
        (ANYMALS, ["LF_HAA and RF_HAA", "RF_KFE and RH_KFE"]),
        (PEOPLE, ["Left_Hip and Right_Hip"]),
    ],
)
def test_joints_of_a_kind_may_turn_the_other_way(joints, groups):
    changes = list_changes(joints)
    for group in groups:
        scale = changes["sign", f"joints {group} turn the other way"]["action_scale"]
        assert [name for name, value in zip(joints, scale, strict=True) if value < 0] == group.split(" and ")


def test_a_leg_may_have_the_pose_of_its_counterpart():
    pose = [0.1, 1.0, -0.1, 0.5, 0.0, 0.6, 0.0, 0.6]
    changes = list_changes(DOGS, default_positions=pose)
    text = "the policy's default positions are those of the other side, at FL_hip and the joints of its leg or side"
    # The hips of FR and FL are mirrored, so the sign stays.
    assert changes["default pose", text]["default_positions"] == [0.1, 1.0, -0.1, 1.0, 0.0, 0.6, 0.0, 0.6]


@pytest.mark.parametrize(("joints", "order"), [(ANYMALS, "RF_HAA"), (PEOPLE, "Waist")])
def test_sides_are_found_in_names(joints, order):
    changes = list_changes(joints)
    prefix = "the policy's joints are in another order: "
    swapped = changes["joint order", f"{prefix}left and right exchanged"]["joints"]
    assert swapped[0] == order
    assert sorted(swapped) == sorted(joints)
