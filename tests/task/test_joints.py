"""What a task says of its joints reaches policies and exports, and nothing that it does not know does."""

import json

import numpy as np
import pytest

from rlctl.environments.info import EnvInfo, describe
from rlctl.environments.spec import EnvSpec
from rlctl.errors import TaskError
from rlctl.exporting.onnx_source import make_metadata
from rlctl.policy.file import PolicyInfo
from rlctl.task.joints import Joints

pytestmark = pytest.mark.pybullet


def describe_task(task):
    env = EnvSpec(task).make()
    try:
        return describe(env), env.unwrapped
    finally:
        env.close()


def write_metadata(task):
    env = describe_task(task)[0]
    info = PolicyInfo(algo="ppo", policy="MlpPolicy", env=env, spec=EnvSpec(task).__dict__)
    return make_metadata(PolicyInfo.model_validate_json(info.model_dump_json()))


def test_position_targets_have_the_keys_of_controllers():
    keys = write_metadata("quadruped")
    assert keys["joint_names"].split(",")[:3] == ["FR_hip_joint", "FR_upper_joint", "FR_lower_joint"]
    assert keys["default_joint_pos"].split(",")[:3] == ["0", "0.9", "-1.8"]
    assert keys["action_scale"].split(",")[:3] == ["0.2", "0.4", "0.4"]
    assert {len(value.split(",")) for key, value in keys.items() if "joint" in key or key == "action_scale"} == {12}
    # Bullet's motors remove a part of the error in every step: they have no stiffness in N m/rad.
    assert not {"joint_stiffness", "joint_damping"} & keys.keys()


def test_steps_and_torques_have_no_scale():
    keys = write_metadata("reach")
    assert keys["joint_names"].split(",")[0] == "lbr_iiwa_joint_1"
    assert [float(value) for value in keys["joint_pos_upper"].split(",")[:2]] == pytest.approx(
        [2.9671, 2.0944], abs=1e-3
    )
    assert "action_scale" not in keys
    assert "default_joint_pos" not in write_metadata("hopper")


def test_limits_of_the_motors_replace_those_of_the_model_file():
    body = describe_task("reach")[1].task.arm
    joints = body.describe_joints(body.joint_names, max_torque=[3.35] * 7)
    assert (joints.max_torque, joints.max_speed) == ((3.35,) * 7, (10.0,) * 7)


def test_a_task_without_joints_says_nothing():
    assert describe_task("kuka-grasp")[0].joints is None
    assert "joint_names" not in write_metadata("kuka-grasp")
    assert describe_task("Pendulum-v1")[0].joints is None


@pytest.mark.parametrize("task", ["biped", "gear-arm", "ant"])
def test_joints_are_those_of_the_action(task):
    env, made = describe_task(task)
    assert len(env.joints.names) == made.action_space.shape[0]
    assert EnvInfo.model_validate(json.loads(env.model_dump_json())) == env


@pytest.mark.parametrize("values", [[1.0], [1.0, np.inf]])
def test_values_must_fit_the_names(values):
    with pytest.raises(TaskError, match="must have 2 finite values, one per joint"):
        Joints(["hip", "knee"], action_scale=values)


def test_a_number_is_that_of_all_joints():
    joints = Joints(["one", "two"], default_positions=0.1, action_torque=0.6, max_torque=np.float32(2.0))
    assert (joints.default_positions, joints.action_torque, joints.max_torque) == ((0.1, 0.1), (0.6, 0.6), (2.0, 2.0))
    body = describe_task("reach")[1].task.arm
    assert body.describe_joints(body.joint_names, action_torque=0.6).action_torque == (0.6,) * 7
    with pytest.raises(TaskError, match=r"^joints: action_torque is '0.6'; give a number, or one per joint"):
        Joints(["one"], action_torque="0.6")  # text
