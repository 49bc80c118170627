"""Deployed: a robot that follows velocity commands with a policy from elsewhere, as its deployment is described."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from rlctl.task import Body, Box, Event, Joints, Sim, TaskError, WorldRngs
from rlctl.task.deployment import COMMANDS, NOT_TRAINED, ORIENTATION, USUAL_TOLERANCE, Deployment, ObservedPart
from rlctl.task.reference import find_heading
from rlctl.task.rotations import rotate, rotate_inverse
from rlctl_locomotion.walk import Walk

NOISE = {  # events of observations
    "gyroscope_noise": "gyroscope",
    "position_noise": "joint_positions",
    "velocity_noise": "joint_velocities",
}
UNITS = {
    **Walk.observation_units,
    "velocity": "m/s",
    "euler": "rad",
    "accelerometer": "m/s^2",
    "contacts": "1: touches something, 0: does not",
    "targets": "rad",
    "heights": "m",
}
AROUND = np.stack(np.meshgrid(np.linspace(-1.3, 1.3, 9), np.linspace(-1.3, 1.3, 9)), -1).reshape(-1, 2)
"""Where the ground is looked at before a start, from the trunk, in units of its height."""
AT_REST = np.array([0.0, 0.0, 9.81])  # [m/s^2], what an accelerometer measures
OTHER_STIFFNESS, OTHER_DAMPING, OTHER_ARMATURE = 100.0, 2.0, 0.01  # of joints that the policy does not move
ENDLESS = 1e6  # [N m], of joints without a limit


@dataclass
class Deployed(Walk):
    """Walk as commanded: robot, joints, observations, gains and rate are those of a deployment."""

    robot_file: str = ""  # URDF or MJCF
    deployment: Deployment | None = None
    terrain: str = ""  # model file of the ground; empty: flat
    tolerance: float = USUAL_TOLERANCE  # [m/s], largest mean error of the velocity in an episode that succeeds
    start_noise: float = 0.02  # [rad], of every joint, to each side of the default pose

    described: Deployment = field(init=False, repr=False)
    commanded: np.ndarray = field(init=False, repr=False)  # [rad], targets from the default positions
    robot = ""
    action_meaning = "joint angles from the default pose, times the action's scale"
    mirror = {}
    gear_damping = 0.0

    def __post_init__(self) -> None:
        """Take from the deployment what other tasks define as a class."""
        if self.deployment is None or not self.robot_file:
            raise TaskError(
                "Deployed: a task of imported policies: rlctl runs import POLICY --deploy FILE --model ROBOT\n"
                f"{NOT_TRAINED}"
            )
        described = self.described = self.deployment
        count = len(described.joints)
        shapes = dict.fromkeys(("last_action", "action_change", "commanded"), (count,))
        low, high = (np.array([described.commands.get(name, (0.0, 0.0))[end] for name in COMMANDS]) for end in (0, 1))
        self._define(
            model=Path(self.robot_file),
            control_dt=described.control_dt,
            substeps=described.substeps,
            solver_iterations=20,  # more than for training: foreign gains are stiff
            joint_order=list(described.joints),
            start_height=described.start_height,
            target_height=described.start_height,
            fallen_height=described.start_height / 2,
            lowest=low,
            highest=high,
            action_space=Box(*described.action_bounds, dtype=np.float32),
            observation_terms=described.make_terms(),
            observation_history=described.history,
            history_start=described.history_start,
            per_world={**Walk.per_world, **shapes},
            events=self._choose_events(),
            observation_units=self._list_units(),
        )

    def _define(self, **values: Any) -> None:
        """Set attributes that other tasks have in their class."""
        vars(self).update(values)

    def _list_units(self) -> dict[str, str]:
        observed: set[str] = {part.kind for part in self.described.measured_parts}
        if observed & {"gravity", "euler"}:  # computed from it
            observed.add(ORIENTATION)
        return {name: unit for name, unit in UNITS.items() if name in observed}

    def _choose_events(self) -> dict[str, Event]:
        observed = {part.kind for part in self.described.measured_parts}
        events = dict(Walk.events)
        for name, kind in NOISE.items():
            if kind not in observed:
                del events[name]
        return events

    def build(self, sim: Sim) -> None:
        """Load the ground and the robot."""
        described = self.described
        self.ground = self.load_ground(sim)
        self.ground.set_friction(0.8)
        self.body = body = sim.load("robot", self.model, floor=False)
        body.set_friction(1.0)  # times the ground's
        self.joints = body.find_joints(self.joint_order)
        count = len(body.joint_names)
        stiffness = self._spread(described.stiffness, OTHER_STIFFNESS, count)
        damping = self._spread(described.damping, OTHER_DAMPING, count)
        armature = None
        if described.armature:
            armature = self._spread(described.armature, OTHER_ARMATURE, count)
        body.set_drives(stiffness, damping, armature=armature)
        stance = self._spread(described.default_positions, 0.0, count)
        self._define(stance=stance, reach=np.array(described.action_scale))
        limits = np.where(body.joint_max_force > 0, body.joint_max_force, ENDLESS)
        if described.max_torque:
            limits[self.joints] = described.max_torque
        self.max_force = limits.tolist()
        self.is_wheel = np.isin(self.joint_order, described.wheels)
        self.farthest = np.full(len(self.joints), np.inf)  # [rad], that a target moves in a step
        if described.target_speed:
            self.farthest = np.array(described.target_speed) * described.control_dt
        self.prepare_sensors()

    def prepare_sensors(self) -> None:
        """Prepare what measures contacts; raises `TaskError` for a link or a sensor that the robot does not have."""
        for part in self.described.observations:
            if part.kind == "contacts":
                for link in part.links:
                    self.body.add_contact_sensor(link)
            if part.kind == "accelerometer":
                self.body.sensor(part.sensor)

    def _spread(self, values: tuple[float, ...], of_others: float, count: int) -> np.ndarray:
        """Return values of the policy's joints as an array of all joints of the model."""
        spread = np.full(count, of_others)
        spread[self.joints] = values
        return spread

    def load_ground(self, sim: Sim) -> Body:
        """Load the body `ground`."""
        return sim.load("ground", self.terrain or "plane.urdf", fixed=True)

    def act(self, action: np.ndarray) -> None:
        """Set the joints' target angles, and the speeds of wheels."""
        wanted = self.reach * action
        low, high = self.commanded - self.farthest, self.commanded + self.farthest
        self.commanded = commanded = np.clip(wanted, low, high)
        targets = np.tile(self.stance, (self.worlds, 1))
        speeds = np.zeros_like(targets)
        speeds[:, self.joints] = np.where(self.is_wheel, commanded, 0.0)
        targets[:, self.joints] += np.where(self.is_wheel, 0.0, commanded)
        self.body.drive_to(targets, velocities=speeds, max_force=self.max_force)
        self.action_change = action - self.last_action
        self.last_action = action.astype(float)
        self.steps += 1

    def observe(self) -> dict[str, np.ndarray]:
        """Return what the policy's observations are computed from, in its order."""
        self.orientation = self.body.base_orientation
        return {part.kind: self._measure(part) for part in self.described.measured_parts}

    def _measure(self, part: ObservedPart) -> np.ndarray:
        if part.kind == "gyroscope":
            return self._turn(self.body.base_angular_velocity, part)
        if part.kind == "velocity":
            return self._turn(self.body.base_velocity, part)
        if part.kind in ("gravity", "euler"):
            return self.orientation
        if part.kind == "command":
            return self.command
        if part.kind == "joint_positions":
            return self.body.joint_positions[:, self.joints]
        if part.kind == "joint_velocities":
            return self.body.joint_velocities[:, self.joints]
        if part.kind == "last_action":
            return self.last_action
        if part.kind == "targets":
            return self.stance[self.joints] + self.commanded
        if part.kind == "heights":
            return self._scan_heights()
        if part.kind == "contacts":
            return np.stack([self.body.touches(link) for link in part.links], axis=-1).astype(float)
        if part.kind == "accelerometer":
            at_rest = rotate_inverse(self.orientation, AT_REST)
            return np.where(self.steps[:, None] == 0, at_rest, self.body.sensor(part.sensor))
        return (self.steps * self.control_dt)[:, None]  # of the clock

    def _scan_heights(self) -> np.ndarray:
        """Return how far the ground is below the trunk's frame [m], at the points of the scan."""
        scan = self.described.scan
        assert scan is not None
        place = self.body.link_position(self.body.base_name)[:, None]
        around = rotate(find_heading(self.orientation)[:, None], np.pad(scan.points, ((0, 0), (0, 1))))
        return place[..., 2] - self.ground.surface_heights((place + around)[..., :2])

    def draw_place(self, rng: WorldRngs, worlds: np.ndarray) -> np.ndarray:
        """Return where the trunk starts [m], shape (k, 3): above the highest ground near it."""
        place = super().draw_place(rng, worlds)
        if self.terrain:
            place[:, 2] += self.ground.surface_heights(place[:, None, :2] + self.start_height * AROUND).max(axis=1)
        return place

    def measure_height(self) -> np.ndarray:
        """Return the height of the trunk above the ground [m]."""
        position = self.body.base_position
        if not self.terrain:
            return position[:, 2]
        return position[:, 2] - self.ground.surface_heights(position[:, :2])

    def _turn(self, vector: np.ndarray, part: ObservedPart) -> np.ndarray:
        return vector if part.frame == "world" else rotate_inverse(self.orientation, vector)

    def describe_joints(self) -> Joints:
        """The robot's, in the order of the policy."""
        if self.described.wheels:  # `Joints` has one kind of command for all joints
            return self.body.describe_joints(self.joint_order)
        described = self.described
        observed = {part.kind for part in described.observations}
        measured = ""
        if "joint_positions" in observed:
            measured = "joint_positions"
        torque = {}
        if described.max_torque:
            torque = {"max_torque": described.max_torque}
        return self.body.describe_joints(
            self.joint_order,
            default_positions=described.default_positions,
            action_scale=described.action_scale,
            measured=measured,
            **torque,
        )
