"""examples/lerobot drives a stand-in with LeRobot's contract; its log is sound, and exchanged joints are named."""

import csv
import importlib.util
import json
import math
from pathlib import Path

import numpy as np
import pytest
from gymnasium import spaces

from rlctl.cli import run
from rlctl.environments.info import EnvInfo, space_to_json
from rlctl.task.joints import Joints
from tests.play.policies import linear
from tests.robot.serve.serving import RunningServer

EXAMPLE = Path(__file__).parent.parent / "examples" / "lerobot"
MODEL = EXAMPLE / "arm.urdf"
JOINTS = ["shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll"]
GOALS = [
    [0.25, 0.1, 0.2],
    [0.3, -0.1, 0.25],
    [0.25, -0.15, 0.15],
    [0.2, 0.15, 0.3],
    [0.3, 0.05, 0.1],
    [0.28, 0.12, 0.2],
]


def load(name):
    spec = importlib.util.spec_from_file_location(name, EXAMPLE / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def drive():
    return load("drive")


@pytest.fixture
def stand_in():
    return load("stand_in")


class Clock:
    """Time that passes only while the program sleeps."""

    def __init__(self):
        self.now = 0.0

    def perf_counter(self):
        return self.now

    def sleep(self, seconds):
        self.now += seconds


@pytest.fixture
def clock():
    return Clock()


@pytest.fixture
def serve():
    """Serve a policy file with limits; return the address."""
    running = []

    def start(file, **settings):
        running.append(RunningServer(file, **settings))
        return f"http://127.0.0.1:{running[-1].port}"

    yield start
    for server in running:
        server.close()


def describe_arm(**changes):
    """What a task with this arm says: actions are steps of targets, 0.05 rad per 1, every 0.05 s."""
    joints = Joints(
        JOINTS,
        default_positions=[0.0] * 5,
        low=[-1.6] * 5,
        high=[1.6] * 5,
        max_speed=[1.0] * 5,
        action_step=[0.05] * 5,
        measured="joint_targets",
        clips_target=True,
    )
    fields = {
        "observation_space": space_to_json(spaces.Box(-np.inf, np.inf, (13,), np.float32)),
        "action_space": space_to_json(spaces.Box(-1.0, 1.0, (5,), np.float32)),
        "observation_sizes": {"joint_positions": 5, "joint_targets": 5, "tip_to_goal": 3},
        "control_dt": 0.05,
        "joints": joints,
    }
    return EnvInfo(**fields | changes)


@pytest.fixture
def policy(tmp_path):
    """A policy that turns the arm's base towards the goal: its action is 10 times the way to the left [m]."""
    weight = np.zeros((5, 13))
    weight[0, 11] = 10.0
    linear(describe_arm(), weight, -1.0).write(tmp_path / "policy.safetensors")
    return tmp_path / "policy.safetensors"


def read_log(file):
    with file.open(newline="") as lines:
        return list(csv.DictReader(lines))


def test_targets_within_limits_and_a_log_in_radians(drive, stand_in, clock, serve, policy, tmp_path):
    (tmp_path / "limits.yaml").write_text("limits:\n  all: {speed: 0.8}\n")
    server = drive.Server(serve(policy, limits=tmp_path / "limits.yaml"))
    robot = stand_in.StandIn(clock)
    drive.drive(robot, server, MODEL, "tip", [[0.25, 0.2, 0.2]], 1.0, tmp_path / "log.csv", clock)
    rows = read_log(tmp_path / "log.csv")
    # Before it, from 10 degrees to the start: 0.1745 rad at 0.5 rad/s and 0.05 s a step are 7 steps.
    assert [float(row["time"]) for row in rows] == pytest.approx([0.05 * step for step in range(7, 27)])
    assert {row["state"] for row in rows} == {"running"}
    # The goal is 0.2 m to the left, so the policy wants 1 rad/s, and the limit is 0.8 rad/s: a step of 0.8 * 0.05 rad.
    assert float(rows[0]["action_shoulder_pan"]) == pytest.approx(0.8, abs=1e-3)
    targets = [float(row["joint_targets_shoulder_pan"]) for row in rows[:3]]
    assert np.diff(targets) == pytest.approx([0.04, 0.04], abs=1e-4)
    # The tip of the straight arm is 0.392 m in front of the base.
    assert float(rows[0]["tip_to_goal_x"]) == pytest.approx(0.25 - 0.392, abs=2e-3)
    degrees = robot.sent["shoulder_pan.pos"]
    assert degrees == pytest.approx(math.degrees(float(rows[-1]["joint_positions_shoulder_pan"])), abs=2.0)
    assert robot.sent["gripper.pos"] == pytest.approx(10.0)  # is kept
    assert not robot.is_connected


def test_names_are_checked_before_anything_moves(drive, stand_in, clock, serve, policy, tmp_path):
    server = drive.Server(serve(policy))
    robot = stand_in.StandIn(clock)

    def refuse(message, tip="tip"):
        with pytest.raises(SystemExit, match=message):
            drive.drive(robot, server, MODEL, tip, GOALS, 1.0, tmp_path / "log.csv", clock)
        assert not robot.is_connected

    refuse("the model has no link hand_tip", tip="hand_tip")
    robot.observation_features = dict.fromkeys(JOINTS, float)
    refuse(r"the robot measures no shoulder_pan\.pos, shoulder_lift\.pos")
    del drive.MAPPING["gripper"]
    refuse("MAPPING has no joint gripper")


def test_a_policy_that_observes_something_else(drive, serve, tmp_path):
    sizes = {"joint_positions": 5, "joint_targets": 5, "camera": 3}
    linear(describe_arm(observation_sizes=sizes), np.zeros((5, 13)), -1.0).write(tmp_path / "policy.safetensors")
    address = serve(tmp_path / "policy.safetensors")
    with pytest.raises(SystemExit, match="the policy observes camera, which this program does not measure"):
        drive.Server(address)


@pytest.mark.parametrize(
    ("fault", "message"),
    [("nan", r"the robot measured no elbow_flex\.pos"), ("late", "the loop is .* s late"), ("cable", "unplugged")],
)
def test_faults_stop_the_arm(drive, stand_in, clock, serve, policy, tmp_path, fault, message):
    robot = stand_in.StandIn(clock)
    measure = robot.get_observation
    reads = iter(range(100))

    def measure_with_a_fault():
        measured = measure()
        if next(reads) == 5:
            if fault == "cable":
                raise ConnectionError("unplugged")
            if fault == "late":
                clock.sleep(0.5)
            if fault == "nan":
                measured["elbow_flex.pos"] = math.nan
        return measured

    robot.get_observation = measure_with_a_fault
    server = drive.Server(serve(policy))
    with pytest.raises((drive.Fault, OSError), match=message):
        drive.drive(robot, server, MODEL, "tip", GOALS[:1], 2.0, tmp_path / "log.csv", clock)
    assert len(read_log(tmp_path / "log.csv")) < 6
    assert not robot.is_connected
    # The last targets are where the arm was, so that it pushes against nothing.
    assert robot.sent == pytest.approx(measure_at_rest(robot, measure), abs=0.5)


def measure_at_rest(robot, measure):
    robot.is_connected = True
    return measure()


def test_ctrl_c_stops_the_arm(drive, stand_in, clock, serve, policy, tmp_path):
    robot = stand_in.StandIn(clock)
    send, sends = robot.send_action, iter(range(100))

    def send_until_ctrl_c(action):
        if next(sends) == 9:
            raise KeyboardInterrupt
        return send(action)

    robot.send_action = send_until_ctrl_c
    server = drive.Server(serve(policy))
    with pytest.raises(KeyboardInterrupt):
        drive.drive(robot, server, MODEL, "tip", GOALS[:1], 2.0, tmp_path / "log.csv", clock)
    assert len(read_log(tmp_path / "log.csv")) == 2  # after 7 steps to the start
    assert not robot.is_connected


@pytest.mark.slow
def test_diagnose_finds_nothing_in_its_log_and_names_joints_that_are_exchanged(
    rlctl, drive, stand_in, serve, tmp_path, monkeypatch
):
    """The steps of the README, with a training that is long enough to move the arm."""
    done = rlctl("tasks", "new", "so-arm", "--model", MODEL, "--link", "tip")
    assert done.returncode == 0, done.stderr
    task = tmp_path / "so-arm/so_arm/task.py"
    lines = task.read_text().splitlines(keepends=True)
    task.write_text("".join(line for line in lines if '"joint_velocities"' not in line))
    done = rlctl("train", f"{task}:SoArm", "-n", "40000", "--no-check")
    assert done.returncode == 0, done.stderr
    monkeypatch.chdir(tmp_path)
    (tmp_path / "limits.yaml").write_text((EXAMPLE / "limits.yaml").read_text())
    address = serve(tmp_path / "runs/latest/policies/best.safetensors", limits=tmp_path / "limits.yaml")

    def diagnose(exchanged):
        clock = Clock()
        robot = stand_in.StandIn(clock, exchanged)
        drive.drive(robot, drive.Server(address), MODEL, "tip", GOALS, 3.0, tmp_path / "log.csv", clock)
        code = run(["diagnose", "log.csv", "--limits", "limits.yaml", "--json", "result.json"])
        return code, json.loads((tmp_path / "result.json").read_text())

    code, result = diagnose(())
    assert (code, result["findings"]) == (0, [])
    code, result = diagnose(("shoulder_lift.pos", "elbow_flex.pos"))
    assert code == 1
    first = result["findings"][0]["text"]
    assert "elements 1 and 2" in first
    assert "are swapped" in first
