"""Files of each project become a policy that acts as in that project; what they lack is asked for by name."""

import contextlib
import dataclasses
import itertools
import pathlib
import re

import numpy as np
import pytest
import torch

from rlctl.errors import ArtifactError, RecipeError, UsageError
from rlctl.importing.foreign.import_policy import import_policy, import_to_play
from rlctl.importing.foreign.network import ForeignLinear, ForeignNetwork
from rlctl.importing.foreign.request import ForeignFiles
from rlctl.policy.load import load_policy
from rlctl.task.deployment import MOTION_TASK, TASK, Deployment
from rlctl.task.motion import read_motion
from rlctl_locomotion.quadruped import JOINTS
from tests.importing.foreign.policies import (
    A1,
    STANCE,
    add_clip,
    describe_walk,
    expect_as,
    read_walk,
    write_onnx,
    write_scene,
    write_torchscript,
    write_yaml,
)

UNTAGGED = re.compile(r"joint_ids:\n\s+- null")
LAB = {
    "joint_ids_map": list(range(12)),
    "step_dt": 0.02,
    "stiffness": [float(number) for number in range(1, 13)],
    "damping": [1.0] * 12,
    "default_joint_pos": STANCE,
    "commands": {"base_velocity": {"ranges": {"lin_vel_x": [-1.0, 1.0], "lin_vel_y": None, "heading": None}}},
    "actions": {"JointPositionAction": {"clip": None, "scale": [0.25] * 12, "offset": STANCE, "joint_ids": [None]}},
    "observations": {
        "base_ang_vel": {"scale": [0.2] * 3, "clip": [-10.0, 10.0], "history_length": 2},
        "projected_gravity": {"scale": [1.0] * 3, "history_length": 1},
        "velocity_commands": {"scale": None, "history_length": 0},
        "joint_pos_rel": {"scale": [1.0] * 12},
        "joint_vel_rel": {"scale": [0.05] * 12},
        "last_action": {"scale": [1.0] * 12},
    },
}
GYM = {
    "simulation_dt": 0.005,
    "control_decimation": 4,
    "kps": [35.0] * 12,
    "kds": [1.0] * 12,
    "default_angles": STANCE,
    "ang_vel_scale": 0.25,
    "dof_pos_scale": 1.0,
    "dof_vel_scale": 0.05,
    "action_scale": 0.25,
    "cmd_scale": [2.0, 2.0, 0.25],
    "num_actions": 12,
    "num_obs": 47,
}
SAR = {
    "observations": ["ang_vel", "gravity_vec", "commands", "dof_pos", "dof_vel", "actions"],
    "observations_history": [0, 1],
    "observations_history_priority": "time",
    "clip_actions_lower": [-3.0] * 12,
    "clip_actions_upper": [3.0] * 12,
    "rl_kp": [35.0] * 12,
    "rl_kd": [1.0] * 12,
    "action_scale": [0.25] * 12,
    "wheel_indices": [],
    "ang_vel_scale": 0.25,
    "dof_pos_scale": 1.0,
    "dof_vel_scale": 0.05,
    "commands_scale": [2.0, 2.0, 0.25],
    "torque_limits": [33.5] * 12,
    "default_dof_pos": STANCE,
    "joint_mapping": [3, 4, 5, 0, 1, 2, 9, 10, 11, 6, 7, 8],
}


@pytest.fixture
def run_import(tmp_path, monkeypatch):
    """Import a policy of so many observations with a deployment file."""
    monkeypatch.chdir(tmp_path)

    def run(content, size, settings=None, name="deploy.yaml"):
        write_torchscript(tmp_path / "policy.pt", [size, 8, 12])
        deploy = write_yaml(tmp_path / name, content)
        return import_policy(tmp_path / "policy.pt", ForeignFiles(deploy, A1), settings=settings)

    return run


def test_deploy_yaml_of_unitree_rl_lab_has_two_orders(run_import):
    imported = run_import(LAB, 3 * 2 + 3 + 3 + 36)
    deployment = imported.deployment
    assert imported.form == "deploy.yaml of unitree_rl_lab"
    # The motors of Unitree's quadrupeds: each leg in the order FR, FL, RR, RL, as in the A1's file.
    assert list(deployment.joints) == JOINTS
    assert deployment.stiffness == tuple(LAB["stiffness"])
    gyroscope = deployment.observations[0]
    assert (gyroscope.kind, gyroscope.scale, gyroscope.clip, gyroscope.history) == ("gyroscope", 0.2, (-10.0, 10.0), 2)
    assert dict(deployment.commands) == {"lin_vel_x": (-1.0, 1.0)}
    assert "joint_ids_map: guessed the order FR, FL, RR, RL of Unitree's quadrupeds" in imported.notes


DESCRIPTORS = {  # as Isaac Lab writes them
    "actions": [
        {
            "name": "joint_position_action",
            "clip": None,
            "joint_names": JOINTS,
            "offset": STANCE,
            "scale": 0.5,
        }
    ],
    "articulations": {
        "robot": {
            "joint_names": JOINTS[::-1],
            "default_joint_stiffness": [float(number) for number in range(1, 13)],
            "default_joint_damping": [1.0] * 12,
            "default_joint_armature": [0.0] * 12,
        }
    },
    "observations": {
        "policy": [
            {"name": "base_lin_vel", "overloads": {"clip": None, "history_length": 0, "scale": None}},
            {"name": "generated_commands", "overloads": {"scale": [2.0, 2.0, 0.25]}},
            {"name": "joint_pos_rel", "joint_names": JOINTS, "joint_pos_offsets": STANCE},
            {"name": "last_action", "overloads": {"clip": None, "history_length": 3}},
        ]
    },
    "scene": {"decimation": 4, "dt": 0.02, "physics_dt": 0.005},
}


def test_io_descriptors_of_isaac_lab(run_import):
    imported = run_import(DESCRIPTORS, 3 + 3 + 12 + 36)
    deployment = imported.deployment
    assert imported.form == "IO descriptors of Isaac Lab"
    assert deployment.stiffness == tuple(float(number) for number in range(12, 0, -1))
    assert (deployment.control_dt, deployment.physics_dt) == (0.02, 0.005)
    assert deployment.observations[1].scale == (2.0, 2.0, 0.25)
    assert deployment.history == {"last_action": 3}
    assert deployment.action_scale == (0.5,) * 12


def test_gains_of_explicit_actuators_are_asked_for(run_import):
    robot = {**DESCRIPTORS["articulations"]["robot"], "default_joint_stiffness": [0.0] * 12}
    content = {**DESCRIPTORS, "articulations": {"robot": robot}}
    with pytest.raises(UsageError, match=r"does not say: stiffness\. Give --set stiffness=40"):
        run_import(content, 54)
    assert run_import(content, 54, {"stiffness": 30}).deployment.stiffness == (30.0,) * 12


def test_a_command_that_is_no_velocity(run_import):
    goal = {"policy": [{"name": "generated_commands", "shape": [4]}]}
    with pytest.raises(
        UsageError, match=r"generated_commands has 4 numbers.* policies that reach a goal are not imported"
    ):
        run_import({**DESCRIPTORS, "observations": goal}, 4)


def test_leapp_is_refused_with_what_to_do(run_import):
    content = {"models": {}, "pipeline": {}, "system information": {}}
    with pytest.raises(UsageError, match=r"LEAPP, .* is not imported\ngive the policy\.onnx that Isaac Lab's"):
        run_import(content, 45)


def test_height_scan_of_isaac_lab(run_import):
    observations = {**LAB["observations"], "height_scan": {"scale": [5.0] * 187, "clip": [-1.0, 1.0]}}
    imported = run_import({**LAB, "observations": observations}, 48 + 187)
    heights = imported.deployment.observations[-1]
    assert (heights.kind, heights.shift, heights.clip, heights.scale) == ("heights", -0.5, (-1.0, 1.0), 5.0)
    assert "scan: guessed 17 x 11 points, 0.1 m apart, as in Isaac Lab's velocity tasks" in imported.notes
    pathlib.Path(imported.policy.path).unlink()
    with pytest.raises(UsageError, match=r"heights 187\), and the network takes 148"):
        run_import({**LAB, "observations": observations}, 148, name="other.yaml")


def test_stiffness_follows_joint_ids_map(run_import):
    order = [3, 4, 5, 0, 1, 2, 9, 10, 11, 6, 7, 8]
    deployment = run_import({**LAB, "joint_ids_map": order}, 48).deployment
    assert deployment.stiffness == tuple(float(index + 1) for index in order)
    assert list(deployment.joints) == [JOINTS[index] for index in order]


def test_yaml_of_unitree_rl_gym_gets_what_its_scripts_say(run_import):
    imported = run_import(GYM, 47)
    deployment = imported.deployment
    assert deployment.control_dt == pytest.approx(0.02)
    assert deployment.observations[-1].period_s == 0.8
    assert deployment.observations[2].scale == (2.0, 2.0, 0.25)
    assert list(deployment.joints) == JOINTS
    guessed = [note.partition(":")[0] for note in imported.notes]
    assert guessed == ["observations", "joints", "commands", "armature"]


def test_config_of_rl_sar_with_its_base(run_import, tmp_path):
    folder = tmp_path / "a1" / "himloco"
    folder.mkdir(parents=True)
    write_yaml(tmp_path / "a1" / "base.yaml", {"a1": {"dt": 0.005, "decimation": 4, "joint_names": JOINTS}})
    deployment = run_import({"a1/himloco": SAR}, 90, name="a1/himloco/config.yaml").deployment
    assert deployment.joints[:3] == tuple(JOINTS[3:6])
    assert (deployment.history_order, deployment.newest_first) == ("frames", True)
    assert deployment.action_clip == ((-3.0,) * 12, (3.0,) * 12)
    assert deployment.max_torque == (33.5,) * 12


def test_rl_sar_without_its_base(run_import, tmp_path):
    (tmp_path / "a1" / "himloco").mkdir(parents=True)
    with pytest.raises(UsageError, match=r"base\.yaml, in a folder above, where there is none"):
        run_import({"a1/himloco": SAR}, 90, name="a1/himloco/config.yaml")


def test_metadata_of_an_onnx_file(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    metadata = {
        "joint_names": ",".join(JOINTS),
        "joint_stiffness": ",".join(["35.0"] * 12),
        "joint_damping": ",".join(["1.0"] * 12),
        "default_joint_pos": ",".join(map(str, STANCE)),
        "action_scale": "0.25",
        "observation_names": "base_ang_vel,projected_gravity,command,joint_pos,joint_vel,actions",
    }
    file = write_onnx(tmp_path / "policy.onnx", read_walk(), metadata=metadata)
    with pytest.raises(UsageError, match=r"does not say: control_dt\. Give --set control_dt=0.02"):
        import_policy(file, ForeignFiles(None, A1))
    deployment = import_policy(file, ForeignFiles(None, A1), settings={"control_dt": 0.02}).deployment
    assert deployment.action_scale == (0.25,) * 12
    # Names are of terms here: what mjlab calls joint_pos are positions from the default pose.
    assert all(part.relative for part in deployment.observations)


def test_a_policy_acts_as_in_its_own_project(tmp_path, monkeypatch):
    """Alphabetical joints, scales, and histories by frames with the newest first: the action is the same."""
    monkeypatch.chdir(tmp_path)
    network = read_walk()
    foreign = describe_walk()
    foreign["observations"][0]["scale"] = 0.25
    foreign["observations"][3]["scale"] = 2.0
    file = write_onnx(tmp_path / "policy.onnx", expect_as(network, foreign))
    deploy = write_yaml(tmp_path / "deploy.yaml", foreign)
    import_policy(file, ForeignFiles(deploy, A1))
    imported = load_policy(tmp_path / "policy.safetensors")
    observation = np.random.default_rng(0).normal(size=45).astype(np.float32)
    value = observation.astype(float)
    for number, linear in enumerate(network.linears):
        value = linear.weight @ (np.tanh(value) if number else value) + linear.bias
    assert imported.predict(observation) == pytest.approx(np.clip(value, -4.0, 4.0), abs=1e-4)


def test_columns_of_histories():
    parts = [{"kind": "gyroscope", "history": 2, "scale": 2.0}, {"kind": "gravity", "history": 2}]
    newest = Deployment(**describe_walk(observations=parts, history_order="frames", newest_first=True))
    columns, factors = newest.find_columns()
    # rlctl has the gyroscope's last two values, oldest first, then gravity's; this policy gyroscope and gravity of now,
    # then those of the step before.
    assert columns.tolist() == [3, 4, 5, 9, 10, 11, 0, 1, 2, 6, 7, 8]
    assert factors.tolist() == [2.0, 2.0, 2.0, 1.0, 1.0, 1.0] * 2


@pytest.mark.slow_except(first=4)
@pytest.mark.parametrize(
    ("content", "size", "settings", "message"),
    [
        (GYM, 50, None, "12 joints make 45 observations, with a phase 47, and the network takes 50"),
        (LAB, 99, None, r"observations of 48 numbers \(gyroscope 3 x 2, .*\), and the network takes 99"),
        (describe_walk(joints=["FR_hip", *JOINTS[1:]]), 45, None, "a1.urdf has no joint 'FR_hip'. Did you mean"),
        (describe_walk(stiffness=[1.0]), 45, None, "stiffness has 1 numbers for 12 joints"),
        (describe_walk(stiffness=None), 45, None, "does not say: stiffness. Give --set stiffness=40"),
        (GYM, 47, {"stifness": 1}, "a deployment has no 'stifness'. Did you mean 'stiffness'"),
        (LAB | {"observations": {"motion_command": {}}}, 24, None, "give the one it was trained with: --motion FILE"),
        (LAB | {"observations": {"motion_anchor_pos_b": {}}}, 48, None, "observes motion_anchor_pos_b, which is not"),
        (LAB | {"observations": {"pose_command": {}}}, 48, None, "policies that reach a goal are not imported"),
        (LAB | {"observations": {"hight_scan": {}}}, 48, None, "no known observation is 'hight_scan'. Did you mean"),
        (LAB | {"joint_ids_map": [99] * 12}, 48, None, "joint_ids_map has the index 99, and there are 12 values"),
        (describe_walk(), 45, {"observations": 5}, "observations"),
        ({"a": 1}, 45, None, "in none of the known forms"),
    ],
)
def test_what_does_not_fit_is_a_line(run_import, content, size, settings, message):
    with pytest.raises(UsageError, match=message) as raised:
        run_import(content, size, settings)
    assert str(raised.value).count("\n") == 0


def test_a_policy_of_rl_sar_that_knows_its_phase_alone(run_import, tmp_path):
    name = "RoboMimic_Deploy/phase"
    folder = tmp_path / "a1" / "dance"
    folder.mkdir(parents=True)
    write_yaml(tmp_path / "a1" / "base.yaml", {"a1": {"dt": 0.005, "decimation": 4, "joint_names": JOINTS}})
    content = {"a1/dance": SAR | {"observations": [name, *SAR["observations"]]}}
    with pytest.raises(UsageError, match=f"observes {name}, which is not imported"):
        run_import(content, 90, name="a1/dance/config.yaml")


def write_clip(path, frames=40):
    """Write a clip of the A1 at 50 Hz: it stands, and moves its front left hip."""
    joints = np.tile(STANCE, (frames, 1))
    joints[:, JOINTS.index("FL_hip_joint")] = 0.002 * np.arange(frames)
    rows = np.hstack([np.tile([0.0, 0.0, 0.5, 0.0, 0.0, 0.0, 1.0], (frames, 1)), joints])
    np.savetxt(path, rows, delimiter=",")
    return path


def test_a_policy_that_follows_a_clip(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    folder = tmp_path / "a1" / "dance"
    folder.mkdir(parents=True)
    write_yaml(tmp_path / "a1" / "base.yaml", {"a1": {"dt": 0.005, "decimation": 4, "joint_names": JOINTS}})
    observed = ["motion_command", "motion_anchor_ori_b"]
    content = SAR | {
        "observations": [*(f"whole_body_tracking/{name}" for name in observed), "dof_pos"],
        "observations_history": [],
        "motion_file": "stand_50hz.csv",
    }
    deploy = write_yaml(folder / "config.yaml", {"a1/dance": content})
    write_torchscript(tmp_path / "policy.pt", [42, 8, 12])
    with pytest.raises(UsageError, match=r"--motion: no file .*stand_50hz\.csv"):
        import_policy(tmp_path / "policy.pt", ForeignFiles(deploy, A1))
    write_clip(folder / "stand_50hz.csv")
    imported = import_policy(tmp_path / "policy.pt", ForeignFiles(deploy, A1))
    assert imported.deployment.anchor == "trunk"
    assert any("anchor: the file does not name" in note for note in imported.notes)
    spec = imported.policy.info.spec
    assert spec.task == MOTION_TASK
    spec = dataclasses.replace(spec, parameters={**spec.parameters, "random_start": False, "start_noise": 0.0})
    with contextlib.closing(spec.make_worlds(1)) as worlds:
        first = worlds.reset(np.arange(1), [0])[0]
        second = worlds.step(np.zeros((1, 12), np.float32)).observation[0]
    # SAR's joint_mapping exchanges the legs of each side: element 3 is joint 0 of the robot, FR_hip_joint.
    hip = imported.deployment.joints.index("FL_hip_joint")
    assert (first[hip], second[hip]) == (0.0, pytest.approx(0.002))  # [rad]
    assert second[12 + hip] == pytest.approx(0.002 / 0.02)  # [rad/s]
    assert first[24:30] == pytest.approx([1.0, 0.0, 0.0, 1.0, 0.0, 0.0], abs=1e-6)
    assert deployed_in(tmp_path) == ["policy.safetensors", "stand_50hz.motion.csv"]


def deployed_in(folder):
    return sorted(path.name for path in folder.iterdir() if path.suffix in (".safetensors", ".csv"))


def test_a_clip_in_the_graph(tmp_path, monkeypatch):
    """A file of whole_body_tracking: joints in another order than the model's, links from the base on, w first."""
    monkeypatch.chdir(tmp_path)
    frames, joints = 20, JOINTS[::-1]
    positions = np.tile(STANCE[::-1], (frames, 1))
    positions[:, joints.index("FL_hip_joint")] = 0.01 * np.arange(frames)
    tables = {
        "joint_pos": positions,
        "joint_vel": np.zeros((frames, 12)),
        "body_pos_w": np.tile([0.0, 0.0, 0.3], (frames, 2, 1)),
        "body_quat_w": np.tile([1.0, 0.0, 0.0, 0.0], (frames, 2, 1)),
    }
    listed = ",".join(["1.0"] * 12)
    metadata = {
        "joint_names": ",".join(joints),
        "joint_stiffness": listed,
        "joint_damping": listed,
        "default_joint_pos": ",".join(map(str, STANCE[::-1])),
        "action_scale": "0.25",
        "command_names": "motion",
        "observation_names": "command,motion_anchor_ori_b,joint_pos",
        "anchor_body_name": "trunk",
        "body_names": "trunk,FL_hip",
    }
    layer = ForeignLinear(np.zeros((12, 42)), np.zeros(12))
    file = write_onnx(tmp_path / "jump.onnx", ForeignNetwork((layer,), "elu"), metadata=metadata)
    add_clip(file, tables)
    with pytest.raises(UsageError, match="does not say: control_dt"):
        import_policy(file, ForeignFiles(None, A1))
    imported = import_policy(file, ForeignFiles(None, A1), settings={"control_dt": 0.02})
    assert imported.deployment.anchor == "trunk"
    assert any("clip: 20 rows in jump.onnx, one per action" in note for note in imported.notes)
    clip = read_motion(tmp_path / "jump.motion.csv")
    assert clip.take_joints(["FL_hip_joint"])[:3, 0] == pytest.approx([0.0, 0.01, 0.02])
    metadata["body_names"] = "FL_hip,trunk"
    add_clip(write_onnx(file, ForeignNetwork((layer,), "elu"), metadata=metadata), tables)
    with pytest.raises(UsageError, match=r"the base of a1\.urdf is trunk, which is not the first"):
        import_policy(file, ForeignFiles(None, A1), settings={"control_dt": 0.02}, output=tmp_path / "b.safetensors")


@pytest.mark.slow
def test_a_clip_without_a_rate_or_for_another_policy(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_torchscript(tmp_path / "policy.pt", [24, 8, 12])
    motion = LAB | {"observations": {"motion_command": {}}}
    deploy, clip = write_yaml(tmp_path / "deploy.yaml", motion), write_clip(tmp_path / "stand.csv")
    with pytest.raises(UsageError, match="no times and no rate; add --motion-rate 30"):
        import_policy(tmp_path / "policy.pt", ForeignFiles(deploy, A1, motion=clip))
    imported = import_policy(tmp_path / "policy.pt", ForeignFiles(deploy, A1, motion=clip, motion_rate=50.0))
    assert imported.deployment.follows_motion
    write_torchscript(tmp_path / "walk.pt", [48, 8, 12])
    walk = write_yaml(tmp_path / "walk.yaml", LAB)
    with pytest.raises(UsageError, match="the policy observes no clip; leave out --motion stand"):
        import_policy(tmp_path / "walk.pt", ForeignFiles(walk, A1, motion=clip, motion_rate=50.0))


@pytest.mark.slow
def test_an_imported_policy_is_not_trained_and_has_no_recipe(rlctl, tmp_path):
    write_torchscript(tmp_path / "policy.pt", [45, 8, 12])
    import_policy(
        tmp_path / "policy.pt",
        ForeignFiles(write_yaml(tmp_path / "deploy.yaml", describe_walk()), A1),
        output=tmp_path / "policy.safetensors",
    )
    for arguments, message in (
        (("train", "walk", "--from", "policy.safetensors"), "rlctl distill POLICY trains a student of it"),
        (("train", TASK), "rlctl distill POLICY trains a student of it"),
        (("export", "policy.safetensors", "--policy", "a.safetensors"), "the file itself is what to pass on"),
    ):
        result = rlctl(*arguments)
        assert result.returncode in (2, 3)
        assert message in result.stderr


def test_tags_of_python_are_not_constructed(run_import, tmp_path):
    write_torchscript(tmp_path / "policy.pt", [48, 8, 12])
    text = write_yaml(tmp_path / "plain.yaml", LAB).read_text()
    marker = tmp_path / "constructed"
    call = f"!!python/object/apply:os.mkdir ['{marker}']"
    (tmp_path / "deploy.yaml").write_text(UNTAGGED.sub(f"joint_ids: {call}", text))
    with pytest.raises(UsageError, match="the actions move some joints only"):
        import_policy(
            tmp_path / "policy.pt", ForeignFiles(tmp_path / "deploy.yaml", A1), output=tmp_path / "a.safetensors"
        )
    assert not marker.exists()
    tagged = UNTAGGED.sub("joint_ids: !!python/object/apply:builtins.slice [null, null, null]", text)
    (tmp_path / "deploy.yaml").write_text(tagged)
    deploy = tmp_path / "deploy.yaml"
    imported = import_policy(tmp_path / "policy.pt", ForeignFiles(deploy, A1), output=tmp_path / "a.safetensors")
    assert imported.deployment.control_dt == 0.02


DUCK = {  # as Open Duck's policies, of a smaller robot
    "action_scale": 0.25,
    "target_speed": 5.24,
    "control_dt": 0.02,
    "observations": [
        {"kind": "gyroscope"},
        {"kind": "accelerometer", "shift": [1.3, 0.0, 0.0]},
        {"kind": "command"},
        {"kind": "constant", "values": [0.5, -0.5], "scale": 2.0},
        {"kind": "joint_positions"},
        {"kind": "last_action", "history": 3},
        {"kind": "targets", "relative": False},
        {"kind": "contacts", "links": ["left", "right"]},
    ],
    "newest_first": True,
    "commands": {"lin_vel_x": [-0.15, 0.15], "lin_vel_y": [-0.2, 0.2]},
}


def test_constants_become_part_of_the_network(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    size = 3 + 3 + 3 + 2 + 2 + 6 + 2 + 2
    module = write_torchscript(tmp_path / "policy.pt", [size, 8, 2])
    deploy = write_yaml(tmp_path / "deploy.yaml", DUCK)
    imported = import_policy(tmp_path / "policy.pt", ForeignFiles(deploy, write_scene(tmp_path)))
    # Half of the fastest command, of 0.25 m/s.
    assert imported.policy.info.spec.parameters["tolerance"] == 0.125
    deployment = imported.deployment
    assert (deployment.default_positions, deployment.target_speed) == ((0.0, 0.0), (5.24, 5.24))
    seen = np.linspace(-1.0, 1.0, size - 2).astype(np.float32)  # rlctl's layout: the oldest action first
    own = np.concatenate([seen[:9], [1.0, -1.0], seen[9:11], seen[15:17], seen[13:15], seen[11:13], seen[17:]])
    expected = module(torch.tensor(own[None], dtype=torch.float32)).detach().numpy()[0]
    acted = load_policy(imported.policy.path).predict(seen)
    assert acted == pytest.approx(expected, abs=1e-5)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"kind": "contacts", "links": ["lefd"]}, r"scene\.xml has no link 'lefd'. Did you mean 'left'"),
        ({"kind": "accelerometer", "sensor": "acc"}, r"scene\.xml has no sensor 'acc'"),
        ({"kind": "constant"}, "observation 'constant' has no values"),
        ({"kind": "phase", "period_s": 1.0, "shift": 1.0}, "observation 'phase' cannot be shifted"),
    ],
)
def test_sensors_that_the_robot_lacks(tmp_path, changes, message):
    write_torchscript(tmp_path / "policy.pt", [5, 8, 2])
    content = {**DUCK, "observations": [{"kind": "joint_positions"}, changes]}
    deploy = write_yaml(tmp_path / "deploy.yaml", content)
    with pytest.raises(UsageError, match=message) as raised:
        import_policy(tmp_path / "policy.pt", ForeignFiles(deploy, write_scene(tmp_path)))
    assert str(raised.value).count("\n") < 3


def test_an_accelerometer_needs_mjcf(tmp_path):
    write_torchscript(tmp_path / "policy.pt", [3, 8, 12])
    content = describe_walk(observations=[{"kind": "accelerometer"}])
    deploy = write_yaml(tmp_path / "deploy.yaml", content)
    with pytest.raises(UsageError, match=r"a1\.urdf has no sensors; give an MJCF file with <accelerometer>"):
        import_policy(tmp_path / "policy.pt", ForeignFiles(deploy, A1))


def test_anchors_and_large_files_are_refused(tmp_path):
    write_torchscript(tmp_path / "policy.pt", [45, 8, 12])
    bomb = tmp_path / "bomb.yaml"
    names = "abcdefghijklmnopqr"
    lines = [f"{name}: &{name} [*{before}, *{before}]" for before, name in itertools.pairwise(names)]
    bomb.write_text("\n".join(["a: &a [x, x]", *lines]))
    with pytest.raises(RecipeError, match="anchors and aliases make more than 100,000 values"):
        import_policy(tmp_path / "policy.pt", ForeignFiles(bomb, A1))
    with (tmp_path / "large.yaml").open("wb") as file:
        file.truncate(10**9)
    with pytest.raises(ArtifactError, match="too large"):
        import_policy(tmp_path / "policy.pt", ForeignFiles(tmp_path / "large.yaml", A1))


def test_models_that_are_no_robot(tmp_path):
    write_torchscript(tmp_path / "policy.pt", [45, 8, 12])
    deploy = write_yaml(tmp_path / "deploy.yaml", describe_walk())
    with pytest.raises(ArtifactError, match=r"--model: model file 'no\.xml' not found"):
        import_policy(tmp_path / "policy.pt", ForeignFiles(deploy, "no.xml"))
    floor = tmp_path / "floor.xml"
    floor.write_text('<mujoco><worldbody><geom type="plane" size="1 1 1"/></worldbody></mujoco>')
    with pytest.raises(UsageError, match=r"--model: .*floor\.xml: it has no body that moves"):
        import_policy(tmp_path / "policy.pt", ForeignFiles(deploy, str(floor)))


def test_other_files_are_refused(tmp_path):
    with pytest.raises(UsageError, match="is an ONNX"):
        import_policy(tmp_path / "policy.zip", ForeignFiles(None, A1))
    write_torchscript(tmp_path / "policy.pt", [45, 8, 12])
    with pytest.raises(UsageError, match="--model: MuJoCo cannot load"):
        import_policy(tmp_path / "policy.pt", ForeignFiles(None, "kuka_iiwa.urdf"))


@pytest.mark.slow
def test_the_command_names_what_it_needs(rlctl, tmp_path):
    write_torchscript(tmp_path / "policy.pt", [45, 8, 12])
    write_yaml(tmp_path / "deploy.yaml", describe_walk())
    result = rlctl("runs", "import", "policy.pt", "--deploy", "deploy.yaml")
    assert (result.returncode, result.stderr.strip()) == (
        2,
        "error: --deploy needs the robot: --model ROBOT.urdf or ROBOT.xml",
    )
    result = rlctl("runs", "import", "policy.pt")
    assert result.returncode == 2
    assert "--deploy FILE --model ROBOT" in result.stderr
    result = rlctl("runs", "import", "policy.pt", "--deploy", "deploy.yaml", "--model", A1)
    assert result.returncode == 0, result.stderr
    assert result.stdout.startswith("policy.safetensors: 12 joints, from deployment of rlctl")


@pytest.mark.slow
def test_one_command_imports_and_plays(rlctl, tmp_path):
    write_torchscript(tmp_path / "policy.pt", [45, 8, 12])
    write_yaml(tmp_path / "deploy.yaml", describe_walk())
    files = ("--deploy", "deploy.yaml", "--model", A1)
    first = rlctl("eval", "policy.pt", *files, "--episodes", "1", "--set", "task.tolerance=0.2")
    assert first.returncode == 0, first.stderr
    assert "policy file policy.safetensors, from deployment of rlctl" in first.stderr
    assert "Deployed: policy.safetensors" in first.stdout


@pytest.mark.slow
def test_an_import_to_play_keeps_what_is_there(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_torchscript(tmp_path / "policy.pt", [45, 8, 12])
    files = ForeignFiles(write_yaml(tmp_path / "deploy.yaml", describe_walk()), A1)
    settings = ["task.tolerance=0.2", "control_dt=0.01", "randomize=true"]
    assert import_to_play("policy.pt", files, []) == ("policy.safetensors", [])
    assert import_to_play("policy.pt", files, settings) == (
        "policy-2.safetensors",
        ["task.tolerance=0.2", "randomize=true"],
    )
    assert import_to_play("policy.pt", files, []) == ("policy.safetensors", [])
    assert import_to_play("policy.pt", files, settings)[0] == "policy-2.safetensors"
    assert sorted(path.name for path in tmp_path.glob("*.safetensors")) == [
        "policy-2.safetensors",
        "policy.safetensors",
    ]


def test_files_of_another_project_exclude_baselines(rlctl):
    result = rlctl("replay", "walk", "--policy", "zero", "--model", A1)
    assert (result.returncode, result.stderr.strip()) == (
        2,
        "error: --policy zero plays a task: leave out --deploy, --model and --terrain",
    )
