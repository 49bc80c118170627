"""Drives an arm through LeRobot's `Robot` contract with a policy of `rlctl serve`.

It needs mujoco and NumPy, not rlctl: LeRobot and rlctl need other versions of torch.
"""

import argparse
import csv
import json
import math
import time
import urllib.request
from pathlib import Path

import mujoco
import numpy as np

DEGREE = math.pi / 180
MAPPING = {  # joint of the model: name at the robot, and rad = scale * robot's number + offset
    "shoulder_pan": ("shoulder_pan.pos", DEGREE, 0.0),
    "shoulder_lift": ("shoulder_lift.pos", DEGREE, 0.0),
    "elbow_flex": ("elbow_flex.pos", DEGREE, 0.0),
    "wrist_flex": ("wrist_flex.pos", DEGREE, 0.0),
    "wrist_roll": ("wrist_roll.pos", DEGREE, 0.0),
    "gripper": ("gripper.pos", (1.75 - -0.17) / 100, -0.17),  # from 0, closed at -0.17 rad, to 100, open at 1.75 rad
}
PARTS = ["joint_positions", "joint_targets", "tip_to_goal", "goal"]  # what this program can observe
START_SPEED = 0.5  # [rad/s], to the pose where the task's episodes begin
MOST_LATE = 3  # control periods


class Fault(Exception):
    """Why the program stopped the arm, in words."""


def connect_arm(port):
    """Return an SO-101; LeRobot's class may be any other with the same contract."""
    from lerobot.robots.so_follower import SO101Follower, SO101FollowerConfig

    # The arm keeps its pose after the program, and a target is at most 15 degrees from where its joint is.
    limits = {"disable_torque_on_disconnect": False, "max_relative_target": 15.0, "use_degrees": True}
    return SO101Follower(SO101FollowerConfig(port=port, id="arm", **limits))


class Server:
    """The policy with its limits: see `rlctl serve`."""

    def __init__(self, url):
        self._url = url
        metadata = self._ask("/metadata")
        unknown = [name for name in metadata["observation"] if name not in PARTS]
        if unknown:
            raise SystemExit(f"the policy observes {', '.join(unknown)}, which this program does not measure")
        self.parts = list(metadata["observation"])
        self.control_dt = metadata["control_dt"]  # [s]
        joints = metadata["env"].get("joints") or {}
        if not joints.get("action_step"):
            raise SystemExit("the policy's actions are no steps of joint targets, as this program expects")
        self.joints = joints["names"]  # in the order of the action
        for name, shape in metadata["observation"].items():
            expected = len(self.joints) if name.startswith("joint") else 3
            if shape != [expected]:
                raise SystemExit(
                    f"the policy observes {name} of shape {shape}, and this program has {expected} numbers"
                )
        self.step = np.array(joints["action_step"])  # [rad] per 1 of the action
        self.low, self.high = np.array(joints["low"]), np.array(joints["high"])  # [rad]
        self.start = np.array(joints["default_positions"])  # [rad]

    def act(self, observation, age_s, is_first):
        """Return the action within the limits, and the state of the limits."""
        request = {name: list(observation[name]) for name in self.parts}
        answer = self._ask("/act", {**request, "age_s": age_s, "reset": is_first})
        if "error" in answer or answer["state"] == "stopped":
            raise Fault(f"the server stopped: {answer.get('error', answer.get('reason'))}")
        return np.array(answer["actions"][0]), answer["state"]

    def _ask(self, path, content=None):
        body = None if content is None else json.dumps(content).encode()
        with urllib.request.urlopen(self._url + path, body, timeout=1.0) as answer:
            return json.load(answer)


class Arm:
    """The robot in the model's names and in radians."""

    def __init__(self, robot, model, tip, moved):
        spec = mujoco.MjSpec.from_file(str(model))
        spec.compiler.fusestatic = False  # keeps the tip, which hangs at a fixed joint
        for shape in [*spec.geoms, *spec.meshes]:
            spec.delete(shape)
        self._data = mujoco.MjData(spec.compile())
        self._model, self._tip, self.robot = self._data.model, tip, robot
        joints = [self._model.joint(index).name for index in range(self._model.njnt)]
        names = [name for name, _, _ in MAPPING.values()]
        refuse_missing("the model has no joint", MAPPING, joints)
        refuse_missing("MAPPING has no joint", [*joints, *moved], MAPPING)
        refuse_missing("the robot measures no", names, robot.observation_features)
        refuse_missing("the robot takes no", names, robot.action_features)
        refuse_missing("the model has no link", [tip], [body.name for body in spec.bodies])

    def measure(self):
        """Return the positions of the joints by name [rad], and where the tip is [m] by forward kinematics."""
        measured = self.robot.get_observation()
        for name, _, _ in MAPPING.values():
            if not math.isfinite(measured.get(name, math.nan)):
                raise Fault(f"the robot measured no {name}")
        positions = {joint: scale * measured[name] + offset for joint, (name, scale, offset) in MAPPING.items()}
        for joint, position in positions.items():
            self._data.joint(joint).qpos = position
        mujoco.mj_kinematics(self._model, self._data)
        return positions, self._data.body(self._tip).xpos.copy()

    def command(self, targets):
        """Send the targets of joints by name [rad]; return those that the robot has sent to its motors."""
        action = {}
        for joint, target in targets.items():
            name, scale, offset = MAPPING[joint]
            action[name] = (target - offset) / scale
        sent = self.robot.send_action(action)
        return {joint: scale * sent[name] + offset for joint, (name, scale, offset) in MAPPING.items()}


def refuse_missing(what, wanted, present):
    """End the program if a name is missing, before anything moves."""
    missing = [name for name in wanted if name not in present]
    if missing:
        raise SystemExit(f"{what} {', '.join(missing)}")


class Log:
    """The CSV file that `rlctl diagnose` reads: a row per action."""

    def __init__(self, file, server):
        self._rows, self._parts = csv.writer(file), server.parts
        names = []
        for part in server.parts:
            elements = server.joints if part.startswith("joint") else "xyz"
            names += [f"{part}_{element}" for element in elements]
        actions = [f"action_{joint}" for joint in server.joints]
        self._rows.writerow(["time", "episode", *names, *actions, "state"])

    def write(self, time_s, episode, observation, action, state):
        """Write what the policy observed, the action that it returned within the limits, and the limits' state."""
        numbers = np.concatenate([observation[part] for part in self._parts])
        self._rows.writerow([time_s, episode, *numbers.tolist(), *action.tolist(), state])


class Ticks:
    """A loop at a fixed rate."""

    def __init__(self, period, clock):
        self._period, self._clock, self._next = period, clock, clock.perf_counter()

    def wait(self):
        """Wait for the next period; raises `Fault` if the loop is too late for control."""
        self._next += self._period
        left = self._next - self._clock.perf_counter()
        if left < -MOST_LATE * self._period:
            raise Fault(f"the loop is {-left:.3f} s late")
        self._clock.sleep(max(left, 0.0))


def go_to_start(arm, server, clock):
    """Move at a low speed to where the task's episodes begin; return the targets."""
    targets, _ = arm.measure()
    start = dict(zip(server.joints, server.start, strict=True))
    way = max(abs(start[joint] - targets[joint]) for joint in start)  # [rad]
    steps = math.ceil(way / START_SPEED / server.control_dt)
    ticks = Ticks(server.control_dt, clock)
    for step in range(steps):
        left = steps - step
        moved = {joint: targets[joint] + (start[joint] - targets[joint]) / left for joint in start}
        targets = targets | moved
        arm.command(targets)
        ticks.wait()
    return targets


def play(arm, server, episode, goal, seconds, log, clock):
    """Let the policy bring the tip to a goal [m]; return how far away it is by the program's own kinematics [m]."""
    targets = go_to_start(arm, server, clock)
    ticks = Ticks(server.control_dt, clock)
    for step in range(round(seconds / server.control_dt)):
        measured_at = clock.perf_counter()
        positions, tip = arm.measure()
        observation = {
            "joint_positions": [positions[joint] for joint in server.joints],
            "joint_targets": [targets[joint] for joint in server.joints],
            "tip_to_goal": goal - tip,
            "goal": goal,
        }
        action, state = server.act(observation, clock.perf_counter() - measured_at, is_first=step == 0)
        stepped = np.clip(observation["joint_targets"] + server.step * action, server.low, server.high)
        targets = arm.command(targets | dict(zip(server.joints, stepped, strict=True)))
        log.write(measured_at, episode, observation, action, state)
        ticks.wait()
    _, tip = arm.measure()
    return float(np.linalg.norm(goal - tip))


def drive(robot, server, model, tip, goals, seconds, log_file, clock=time):
    """Play an episode per goal, and log it; at the end, whatever ends it, the arm keeps the pose in which it is."""
    arm = Arm(robot, model, tip, server.joints)
    robot.connect()
    try:
        with Path(log_file).open("w", newline="") as file:
            log = Log(file, server)
            for episode, goal in enumerate(goals):
                distance = play(arm, server, episode, np.array(goal), seconds, log, clock)
                print(f"goal {goal}: {distance:.3f} m away, as the program computes it; look whether it is")
    finally:
        try:
            positions, _ = arm.measure()
            arm.command(positions)  # where it is now, so that it pushes against nothing
        finally:
            robot.disconnect()


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--model", required=True, help="URDF or MJCF file of the arm, that of the task")
    parser.add_argument("--tip", required=True, help="link that goes to the goal, TIP of the task")
    parser.add_argument("--goal", required=True, nargs=3, type=float, action="append", help="x y z [m]; repeatable")
    parser.add_argument("--port", help="serial port of the arm; without it the stand-in is driven")
    parser.add_argument("--seconds", type=float, default=3.0, help="of each goal")
    parser.add_argument("--log", default="log.csv")
    parser.add_argument("--server", default="http://127.0.0.1:8000")
    options = parser.parse_args()
    if options.port is None:
        from stand_in import StandIn

        robot = StandIn()
    else:
        robot = connect_arm(options.port)
    try:
        server = Server(options.server)
        drive(robot, server, options.model, options.tip, options.goal, options.seconds, options.log)
    except KeyboardInterrupt:
        raise SystemExit("stopped by Ctrl-C; the arm holds its pose") from None
    except (Fault, OSError) as error:  # LeRobot's errors of the connection are OSError
        raise SystemExit(f"stopped: {error}") from None


if __name__ == "__main__":
    main()
