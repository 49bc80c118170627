"""`Draft`: what a file says of a deployment, before what it lacks is asked for or guessed."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from rlctl.environments.spec import merge
from rlctl.errors import UsageError, check_name
from rlctl.importing.foreign.network import ForeignNetwork
from rlctl.storage import validation
from rlctl.task.deployment import MOTION, Deployment
from rlctl.task.motion import MotionClip
from rlctl.task.mujoco.robot import Robot

_OF_JOINTS = ("default_positions", "action_scale", "stiffness", "damping", "max_torque", "armature", "target_speed")
_REQUIRED = ("default_positions", "action_scale", "stiffness", "damping", "control_dt", "observations")
_USUAL_COMMANDS = {"lin_vel_x": [-0.5, 1.0], "lin_vel_y": [-0.3, 0.3], "ang_vel_z": [-0.5, 0.5]}
_OF_GOALS = ("pose_command", "position_command", "pos_command", "goal", "target_pos", "target_heading", "waypoint")
_USUAL_SCAN = {
    "x": [round(0.1 * number, 1) for number in range(-8, 9)],
    "y": [round(0.1 * number, 1) for number in range(-5, 6)],
}
_USUAL_ANCHOR = "torso_link"  # of Unitree's G1, with which whole_body_tracking and mjlab train
_USUAL_ARMATURE = 0.01  # [kg m^2], of motors and gears of walking robots
_FORMS = {
    "default_positions": "[0.1, 0.8, ..]",
    "control_dt": "0.02",
    "action_scale": "0.25",
    "stiffness": "40",
    "damping": "1",
    "observations": "'[{kind: gyroscope, scale: 0.25}, {kind: gravity}, ..]'",
}


@dataclasses.dataclass
class Draft:
    """Values of a `Deployment` by name, with notes about what was guessed."""

    source: str  # the file, for errors
    values: dict[str, Any]
    notes: list[str] = dataclasses.field(default_factory=list)
    motion: Path | None = None  # the clip that the file names

    def complete(
        self, settings: Mapping[str, Any], robot: Robot, network: ForeignNetwork, clip: MotionClip | None = None
    ) -> Deployment:
        """Return the deployment; `settings` override what the file says.

        Raises `UsageError` for what is missing, for joints that the robot does not have, and for sizes that do not fit
        the network.
        """
        for name in settings:
            check_name(name, Deployment.model_fields, "--set: a deployment has no", UsageError)
        values = merge(self.values, settings)
        self._guess_joints(values, robot, network)
        joints = values["joints"]
        for name in joints:
            check_name(name, robot.joints, f"{self.source}: {robot.path.name} has no joint", UsageError)
        self._guess_pose(values, robot)
        self._guess_gains(values, robot)
        if missing := [name for name in _REQUIRED if values.get(name) is None]:
            forms = " ".join(f"--set {name}={_FORMS[name]}" for name in missing)
            raise UsageError(f"{self.source} does not say: {', '.join(missing)}. Give {forms}")
        for name in _OF_JOINTS:
            if isinstance(values.get(name), int | float) and not isinstance(values[name], bool):
                values[name] = [values[name]] * len(joints)
        self._guess_others(values, robot)
        if network.ends_with_tanh:  # a wider clip would never act; and the policy file scales tanh to this range
            values["action_clip"] = [-1.0, 1.0]
        if "start_height" not in values:
            pose = dict(zip(joints, values["default_positions"], strict=False))
            turn: Sequence[float] = (0.0, 0.0, 0.0, 1.0)
            if clip is not None:
                pose = dict(zip(clip.joint_names, clip.joint_positions[0].tolist(), strict=True))
                turn = clip.root_orientation[0].tolist()
            values["start_height"] = round(robot.measure_start(pose, turn), 4)
        deployment = validation.build(Deployment, values, UsageError, self.source)
        self._check_parts(deployment, robot)
        self._check_sizes(deployment, network)
        self._check_motion(deployment, clip)
        return deployment

    def _guess_joints(self, values: dict[str, Any], robot: Robot, network: ForeignNetwork) -> None:
        if "joints" in values:
            return
        if len(robot.joints) != network.action_size:
            raise UsageError(
                f"{self.source} does not say which joints the {network.action_size} actions move, and "
                f"{robot.path.name} has {len(robot.joints)}. Give --set joints='[{robot.joints[0]}, ..]'"
            )
        values["joints"] = list(robot.joints)
        self.notes.append(f"joints: the file does not name them; guessed the order of {robot.path.name}")

    def _guess_pose(self, values: dict[str, Any], robot: Robot) -> None:
        if values.get("default_positions") is None and robot.pose:
            values["default_positions"] = [robot.pose[name] for name in values["joints"]]
            self.notes.append(f"default_positions: guessed keyframe {robot.keyframe!r} of {robot.path.name}")

    def _guess_gains(self, values: dict[str, Any], robot: Robot) -> None:
        if not all(name in robot.gains for name in values["joints"]):
            return
        for number, key in enumerate(("stiffness", "damping")):
            if values.get(key) is None:
                values[key] = [robot.gains[name][number] for name in values["joints"]]
                self.notes.append(f"{key}: guessed that of the position actuators of {robot.path.name}")

    def _guess_others(self, values: dict[str, Any], robot: Robot) -> None:
        observed = values["observations"]
        if not isinstance(observed, list):
            observed = []  # which validation refuses
        kinds = [part.get("kind") for part in observed if isinstance(part, dict)]
        if "anchor_orientation" in kinds:
            self._guess_anchor(values, robot)
        if "heights" in kinds and values.get("scan") is None:
            values["scan"] = _USUAL_SCAN
            self.notes.append("scan: guessed 17 x 11 points, 0.1 m apart, as in Isaac Lab's velocity tasks")
        if not values.get("commands") and not set(kinds) & set(MOTION):
            values["commands"] = _USUAL_COMMANDS
            ranges = ", ".join(f"{name} {low:g} to {high:g}" for name, (low, high) in _USUAL_COMMANDS.items())
            self.notes.append(f"commands: the file has no ranges; guessed {ranges} [m/s, rad/s]")
        if not values.get("armature") and not robot.has_armature:
            values["armature"] = [_USUAL_ARMATURE] * len(values["joints"])
            self.notes.append(f"armature: neither file has it; guessed {_USUAL_ARMATURE:g} kg m^2 for every joint")
        endless = [name for name in values["joints"] if not robot.limits.get(name)]
        if not values.get("max_torque") and endless:
            self.notes.append(f"max_torque: {robot.path.name} has no limit for {endless[0]}; it is not limited")

    def _guess_anchor(self, values: dict[str, Any], robot: Robot) -> None:
        if "anchor" not in values:
            values["anchor"] = robot.links[0]
            if _USUAL_ANCHOR in robot.links:
                values["anchor"] = _USUAL_ANCHOR
            self.notes.append(
                f"anchor: the file does not name the link of anchor_orientation; guessed {values['anchor']}"
            )
        if values["anchor"]:
            check_name(values["anchor"], robot.links, f"{self.source}: {robot.path.name} has no link", UsageError)

    def _check_motion(self, deployment: Deployment, clip: MotionClip | None) -> None:
        if deployment.follows_motion and clip is None:
            raise UsageError(
                f"{self.source}: the policy follows a clip; give the one it was trained with: --motion FILE.csv or .npz"
            )
        if clip is not None and not deployment.follows_motion:
            raise UsageError(f"{self.source}: the policy observes no clip; leave out --motion {clip.name}")

    def _check_parts(self, deployment: Deployment, robot: Robot) -> None:
        """Raise `UsageError` for links and sensors that are observed and that the robot does not have."""
        for part in deployment.observations:
            for link in part.links:
                check_name(link, robot.links, f"{self.source}: {robot.path.name} has no link", UsageError)
            if part.kind == "accelerometer" and not robot.sensors:
                raise UsageError(
                    f"{self.source}: observes an accelerometer, and {robot.path.name} has no sensors; give an MJCF "
                    "file with <accelerometer>"
                )
            if part.kind == "accelerometer":
                check_name(part.sensor, robot.sensors, f"{self.source}: {robot.path.name} has no sensor", UsageError)

    def _check_sizes(self, deployment: Deployment, network: ForeignNetwork) -> None:
        if len(deployment.joints) != network.action_size:
            raise UsageError(
                f"{self.source}: {len(deployment.joints)} joints, and the network has {network.action_size} actions"
            )
        if deployment.observation_size != network.observation_size:
            sizes = [
                f"{part.kind} {deployment.find_size(part)}" + (f" x {part.history}" if part.history > 1 else "")
                for part in deployment.observations
            ]
            raise UsageError(
                f"{self.source}: observations of {deployment.observation_size} numbers ({', '.join(sizes)}), and the "
                f"network takes {network.observation_size}"
            )


def pick(values: Sequence[Any], order: Sequence[int], source: str, name: str) -> list[Any]:
    """Return values in another order; raises `UsageError` for an index that is not there."""
    for index in order:
        if not isinstance(index, int) or not 0 <= index < len(values):
            raise UsageError(f"{source}: {name} has the index {index!r}, and there are {len(values)} values")
    return [values[index] for index in order]


def refuse_motion(name: str, source: str) -> None:
    """Raise `UsageError` for what rlctl does not observe of a motion, or of a goal: where it is."""
    if "motion" in name or "anchor" in name or name.endswith("/phase"):
        raise UsageError(
            f"{source}: observes {name}, which is not imported; of a motion, policies may observe motion_command and "
            "motion_anchor_ori_b"
        )
    if any(word in name for word in _OF_GOALS):
        raise UsageError(
            f"{source}: observes {name}: policies that reach a goal are not imported; those that follow velocity "
            "commands or a clip are"
        )
