"""An imported policy walks, is evaluated and exported as rlctl's own, and its mistakes are named."""

import contextlib

import numpy as np
import pytest

from rlctl.environments.spec import EnvSpec
from rlctl.errors import AnswerIsNo, TaskError
from rlctl.exporting.c_source import find_compiler
from rlctl.importing.foreign.import_policy import import_policy
from rlctl.importing.foreign.request import ForeignFiles
from rlctl.policy.file import PolicyFile
from rlctl.policy.load import check_playable
from rlctl.task.deployment import MOTION_TASK, TASK, Deployment
from rlctl.task.model_files import find_model_file
from rlctl.task.motion import MotionClip, write_motion
from rlctl.task.mujoco.robot import read_robot
from rlctl_robot.diagnose.deployed import diagnose_deployment
from rlctl_robot.diagnose.mapped_actor import map_action, map_observation
from tests.importing.foreign.policies import (
    A1,
    describe_walk,
    expect_as,
    read_walk,
    write_onnx,
    write_scene,
    write_yaml,
)

FOREIGN = {
    "observations": [
        {"kind": "command"},
        {"kind": "gyroscope", "scale": 0.25},
        {"kind": "gravity"},
        {"kind": "joint_positions"},
        {"kind": "joint_velocities", "scale": 0.05},
        {"kind": "last_action"},
    ]
}


@pytest.fixture
def import_walk(tmp_path):
    """Import rlctl's policy `walk` from an ONNX file, described with some mistakes."""

    def run(**mistakes):
        right = describe_walk()
        file = write_onnx(tmp_path / "walk.onnx", expect_as(read_walk(), right))
        deploy = write_yaml(tmp_path / "deploy.yaml", {**right, **mistakes})
        return import_policy(file, ForeignFiles(deploy, A1), output=tmp_path / "walk.safetensors").policy

    return run


def diagnose(policy):
    own = check_playable(PolicyFile.read(policy.path)).actor_only()
    return diagnose_deployment(own, own.info.spec)


def test_the_task_needs_a_deployment():
    with pytest.raises(TaskError, match="rlctl runs import POLICY --deploy FILE --model ROBOT"):
        EnvSpec(TASK).make_worlds(1)


def test_observations_follow_the_deployment():
    parts = [
        {"kind": "command"},
        {"kind": "velocity", "frame": "world"},
        {"kind": "euler"},
        {"kind": "phase", "period_s": 0.08, "offsets": [0.0, 0.5]},
        {"kind": "joint_positions", "clip": [-0.001, 0.001]},
    ]
    deployment = describe_walk(observations=parts)
    spec = EnvSpec(TASK, {"deployment": deployment, "robot_file": A1})
    worlds = spec.make_worlds(2)
    first = worlds.reset(np.arange(2), [0, 1])
    assert first.shape == (2, 3 + 3 + 3 + 4 + 12)
    second = worlds.step(np.zeros((2, 12), np.float32)).observation
    # A quarter of the period: sines 1 and -1, cosines 0.
    assert second[0, 9:13] == pytest.approx([1.0, -1.0, 0.0, 0.0], abs=1e-6)
    assert np.abs(second[:, 13:]).max() <= 0.001 + 1e-6
    low, high = np.array([-0.5, -0.4, -0.8]), np.array([1.0, 0.4, 0.8])
    assert ((first[:, :3] >= low - 1e-6) & (first[:, :3] <= high + 1e-6)).all()
    worlds.close()


def test_wheels_follow_speeds():
    deployment = describe_walk(wheels=["FR_lower_joint"], stiffness=[35.0, 35.0, 0.0] + [35.0] * 9)
    deployment["observations"] = [{"kind": "joint_velocities"}]
    worlds = EnvSpec(TASK, {"deployment": deployment, "robot_file": A1}).make_worlds(1)
    worlds.reset(np.arange(1), [0])
    action = np.zeros((1, 12), np.float32)
    action[0, 2] = 4.0
    observation = worlds.step(action).observation
    # The damper of 1 N m s/rad pushes towards 0.25 * 4 = 1 rad/s.
    assert 0.2 < observation[0, 2] < 1.5
    worlds.close()


def test_what_a_robot_with_sensors_observes(tmp_path):
    observations = [
        {"kind": "accelerometer", "shift": [1.3, 0.0, 0.0]},
        {"kind": "constant", "values": [0.0, 0.0]},  # part of the network's input only
        {"kind": "last_action", "history": 2},
        {"kind": "targets", "relative": False},
        {"kind": "contacts", "links": ["left", "right"]},
    ]
    deployment = {
        "joints": ["right_hip", "left_hip"],
        "default_positions": [0.1, -0.1],
        "action_scale": [0.25] * 2,
        "stiffness": [20.0] * 2,
        "damping": [1.0] * 2,
        "target_speed": [5.0, 1e3],
        "control_dt": 0.02,
        "observations": observations,
        "start_height": 0.16,
    }
    spec = EnvSpec(TASK, {"deployment": deployment, "robot_file": write_scene(tmp_path)})
    with contextlib.closing(spec.make_worlds(2)) as worlds:
        first = worlds.reset(np.arange(2), [0, 1])
        assert first.shape == (2, 3 + 2 * 2 + 2 + 2)
        assert first[0] == pytest.approx([1.3, 0.0, 9.81, 0.0, 0.0, 0.0, 0.0, 0.1, -0.1, 0.0, 0.0])
        # 0.25 * 2 rad are wanted; the target of the right hip moves by 5 rad/s * 0.02 s.
        second = worlds.step(np.full((2, 2), 2.0, np.float32)).observation
        assert second[0, 3:9] == pytest.approx([0.0, 0.0, 2.0, 2.0, 0.1 + 0.1, -0.1 + 0.5])
        for _ in range(100):
            last = worlds.step(np.array([[0.0, 0.0], [-0.4, 0.4]], np.float32)).observation
    assert last[0, :3] == pytest.approx([1.3, 0.0, 9.81], abs=0.3)
    assert last[:, 9:].tolist() == [[1.0, 1.0], [1.0, 1.0]]


TERRAIN = """
<mujoco><worldbody>
  <geom type="plane" size="20 20 1"/>
  <geom type="box" pos="1.35 0 0.05" size="1 5 0.05"/>
</worldbody></mujoco>
"""


@pytest.fixture
def scanning(tmp_path):
    """Return a robot that observes heights before a step of 0.1 m at x = 0.35 m, as a specification."""
    terrain = tmp_path / "step.xml"
    terrain.write_text(TERRAIN)
    scan = {"x": [-0.3, 0.0, 0.45], "y": [-0.1, 0.1]}
    parts = [{"kind": "heights", "shift": -0.5, "clip": [-1.0, 1.0], "scale": 5.0}]
    deployment = describe_walk(observations=parts, scan=scan, start_height=0.3)
    return EnvSpec(TASK, {"deployment": deployment, "robot_file": A1, "start_noise": 0.0}), str(terrain)


def test_heights_of_flat_ground(scanning):
    flat, _ = scanning
    with contextlib.closing(flat.make_worlds(2)) as worlds:
        first = worlds.reset(np.arange(2), [0, 1])
        height = worlds.task.body.link_position(worlds.task.body.base_name)[0, 2]
    # The scale of 5 is in the network.
    assert first == pytest.approx(np.full((2, 6), height - 0.5), abs=1e-5)


def test_heights_of_a_terrain_turn_with_the_robot(scanning):
    spec, terrain = scanning
    with contextlib.closing(EnvSpec(TASK, {**spec.parameters, "terrain": terrain}).make_worlds(2)) as worlds:
        first = worlds.reset(np.arange(2), [0, 1])
        task = worlds.task
        # It stands 0.3 m above the highest ground near it.
        assert task.body.base_position[0, 2] == pytest.approx(0.4)
        assert task.measure_height()[0] == pytest.approx(0.4)
        assert first[0] - first[0, 0] == pytest.approx([0.0, 0.0, -0.1] * 2, abs=1e-5)
        half_turn = (0.0, 0.0, 1.0, 0.0)
        task.body.set_base((0.1, 0.0, 0.4), half_turn, worlds=np.array([1]))
        turned = task.observe()["heights"][1]
        # Behind it, 0.3 m, is now x = 0.4 m.
        assert turned - turned[1] == pytest.approx([-0.1, 0.0, 0.0] * 2, abs=1e-5)


def test_points_of_a_scan_in_both_orders():
    described = describe_walk(observations=[{"kind": "heights"}])
    scan = {"x": [0.0, 1.0], "y": [2.0, 3.0]}
    first = Deployment(**described, scan=scan).scan.points.tolist()
    other = Deployment(**described, scan={**scan, "x_first": False}).scan.points.tolist()
    assert first == [[0.0, 2.0], [1.0, 2.0], [0.0, 3.0], [1.0, 3.0]]
    assert other == [[0.0, 2.0], [0.0, 3.0], [1.0, 2.0], [1.0, 3.0]]


@pytest.fixture
def standing(tmp_path):
    """Return how a policy of the A1 follows a clip of 0.6 s in which it stands, as a specification."""
    robot = read_robot(find_model_file(A1))
    described = describe_walk(
        observations=[{"kind": kind} for kind in ("motion", "anchor_orientation", "joint_positions")],
        commands={},
        anchor="FR_hip",
        start_height=0.31,
    )
    pose = dict(zip(described["joints"], described["default_positions"], strict=True))
    frames = 30
    clip = MotionClip(
        name="stand",
        rate=50.0,
        root_position=np.tile([0.0, 0.0, 1.0], (frames, 1)),  # recorded on another floor
        root_orientation=np.tile([0.0, 0.0, 0.0, 1.0], (frames, 1)),
        joint_names=robot.joints,
        joint_positions=np.tile([pose[name] for name in robot.joints], (frames, 1)),
    )
    file = tmp_path / "stand.motion.csv"
    file.write_bytes(write_motion(clip))
    parameters = {"deployment": described, "robot_file": A1, "motion_file": str(file), "random_start": False}
    return EnvSpec(MOTION_TASK, parameters)


def test_a_clip_is_followed_to_its_end(standing):
    with contextlib.closing(standing.make_worlds(2)) as worlds:
        worlds.reset(np.arange(2), [0, 1])
        task = worlds.task
        assert task.body.base_position[:, 2] == pytest.approx([0.31, 0.31])
        for _ in range(28):
            step = worlds.step(np.zeros((2, 12), np.float32))
            assert not (step.terminated | step.truncated).any()
        assert np.abs(step.observation[:, 24:30] - [1.0, 0.0, 0.0, 1.0, 0.0, 0.0]).max() < 0.1
        last = worlds.step(np.zeros((2, 12), np.float32))
    assert last.truncated.all()
    assert last.success.all()
    assert task.commands() == {}


def test_a_clip_of_other_joints_is_refused(standing, tmp_path):
    file = tmp_path / "stand.motion.csv"
    header, rest = file.read_text().split("\n", 1)
    names = header.split(",")
    names[-1], names[-2] = names[-2], names[-1]
    file.write_text("\n".join([",".join(names), rest]))
    with pytest.raises(TaskError, match=r"stand.motion.csv: its joints are not those of a1\.urdf, in their order"):
        standing.make_worlds(1)


def test_a_variant_reads_the_clip_in_its_own_order(standing):
    own = Deployment(**standing.parameters["deployment"])
    swapped = [*own.joints[3:6], *own.joints[:3], *own.joints[6:]]
    other = Deployment(**{**standing.parameters["deployment"], "joints": swapped})
    seen = map_observation(own, other, own)
    # Positions and velocities of its joint 0 are those of joint 3.
    assert (seen.source[0], seen.source[12]) == (3, 15)


def test_variants_read_and_send_what_another_deployment_says():
    own = Deployment(**describe_walk(**FOREIGN))
    swapped = [*own.joints[3:6], *own.joints[:3], *own.joints[6:]]
    other = Deployment(
        **describe_walk(**FOREIGN, joints=swapped, default_positions=[0.1] * 12, action_scale=[0.5] * 12)
    )
    action = map_action(own, other)
    # Joint 0 gets element 3: 0.1 + 0.5 * 1 = 0.6 rad, which is 0.6 / 0.25 = 2.4 from its own default of 0.
    assert (action.source[0], action.factor[0] * 1.0 + action.offset[0]) == (3, pytest.approx(2.4))
    seen = map_observation(own, other, own)
    place = own.layout.columns["joint_positions"].start
    # Its element 0 is joint 3, from 0.1 rad instead of 0.
    assert (seen.source[place], seen.factor[place], seen.offset[place]) == (place + 3, 1.0, pytest.approx(-0.1))
    assert map_observation(own, own, own).source.tolist() == list(range(own.layout.size))


@pytest.mark.slow
def test_an_imported_policy_walks(import_walk, rlctl, tmp_path):
    policy = import_walk()
    result = rlctl("eval", policy.path, "--episodes", "8", "--json", "-")
    assert result.returncode == 0, result.stderr
    assert '"success_rate": 1.0' in result.stdout
    diagnosis = diagnose(policy)
    assert diagnosis.best is None
    diagnosis.check()


@pytest.mark.slow
@pytest.mark.skipif(find_compiler() is None, reason="no C compiler")
def test_it_is_exported_as_a_controller(import_walk, rlctl, tmp_path):
    policy = import_walk()
    result = rlctl("export", policy.path, "--controller", "--c")
    assert result.returncode == 0, result.stderr


@pytest.mark.slow
@pytest.mark.parametrize(
    ("mistakes", "kind"),
    [
        (
            {
                "joints": [
                    *describe_walk()["joints"][3:6],
                    *describe_walk()["joints"][:3],
                    *describe_walk()["joints"][6:],
                ]
            },
            "joint order",
        ),
        ({"action_scale": [1.0] * 12}, "scale"),
        ({"stiffness": [1.0] * 12, "damping": [35.0] * 12}, "gains"),
    ],
)
def test_a_mistake_is_named(import_walk, mistakes, kind):
    diagnosis = diagnose(import_walk(**mistakes))
    assert diagnosis.best is not None
    assert diagnosis.best.kind == kind
    with pytest.raises(AnswerIsNo, match="a mistake in the mapping"):
        diagnosis.check()
