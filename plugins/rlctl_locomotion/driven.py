"""Driven: a robot whose joints are springs and dampers about a stance, Unitree's A1 unless a task names another."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar

import numpy as np

from rlctl.task import BatchTask, Body, Box, Event, Joints, Sim, events, terms
from rlctl.task.rotations import rotate_inverse
from rlctl_locomotion.quadruped import JOINTS

STANCE = np.array([0.0, 0.8, -1.6] * 4)  # [rad], of the A1
OTHER_SIDE = (-4, 5, 6, -1, 2, 3, -10, 11, 12, -7, 8, 9)  # joints of the A1's mirror image: hips turn the other way
DOWN = np.array([0.0, 0.0, -1.0])


@dataclass
class Driven(BatchTask):
    """What the tasks in many worlds share: ground and robot, joint targets, and what the robot itself measures."""

    last_action: np.ndarray = field(init=False, repr=False)
    action_change: np.ndarray = field(init=False, repr=False)
    steps: np.ndarray = field(init=False, repr=False)  # since the start of the episode

    robot = "Unitree A1"
    model: ClassVar[str | Path] = "a1.urdf"
    joint_order: ClassVar[list[str]] = JOINTS
    self_collision: ClassVar[bool] = False
    stance: ClassVar[np.ndarray] = STANCE
    reach: ClassVar[float | np.ndarray] = 0.25  # [rad], from the stance, at action 1
    stiffness: ClassVar[float | np.ndarray] = 35.0  # [N m/rad], of the A1's position controllers, as the next two
    damping: ClassVar[float | np.ndarray] = 0.7  # [N m s/rad]
    armature: ClassVar[float | np.ndarray] = 0.01  # [kg m^2]
    gear_damping: ClassVar[float] = 0.3  # [N m s/rad]
    start_height: ClassVar[float] = 0.30  # [m], of the trunk
    target_height: ClassVar[float] = 0.28  # [m]

    control_dt, substeps, solver_iterations = 0.02, 4, 3  # [s], -, -
    action_space = Box(-4.0, 4.0, (12,), np.float32)
    action_meaning = "joint angles from the stance; 1 is 0.25 rad"
    observation_units = {
        "gyroscope": "rad/s",
        "orientation": "quaternion x, y, z, w",
        "joint_positions": "rad",
        "joint_velocities": "rad/s",
    }
    observation_terms = {
        "gravity": terms.Gravity("orientation"),
        "joint_positions": terms.Scaled("joint_positions", offset=tuple(STANCE)),
        "last_action": terms.LastAction(),
    }
    per_world = {"last_action": (12,), "action_change": (12,), "steps": ()}
    events = {  # with `randomize: true`
        "mass": Event("reset", events.scale_mass, body="robot", factor=(0.8, 1.2)),
        "friction": Event("reset", events.set_friction, body="ground", friction=(0.4, 1.2)),
        "motor_strength": Event("reset", events.scale_motor_strength, body="robot", factor=(0.8, 1.0)),
        "gyroscope_noise": Event("observation", events.noise, of="gyroscope", std=(0.0, 0.2)),  # [rad/s]
        "position_noise": Event("observation", events.noise, of="joint_positions", std=(0.0, 0.01)),  # [rad]
        "velocity_noise": Event("observation", events.noise, of="joint_velocities", std=(0.0, 1.0)),  # [rad/s]
        "action_delay": Event("action", events.delay, steps=(0, 1)),  # of one action
    }
    mirror = {
        "gyroscope": (-1, 2, -3),
        "gravity": (1, -2, 3),
        **dict.fromkeys(("joint_positions", "joint_velocities", "last_action", "action"), OTHER_SIDE),
    }

    def build(self, sim: Sim) -> None:
        """Load the ground and the robot."""
        self.ground = self.load_ground(sim)
        self.ground.set_friction(0.8)
        place = (0.0, 0.0, self.start_height)
        self.body = sim.load("robot", self.model, position=place, self_collision=self.self_collision)
        self.body.set_friction(1.0)  # times the ground's
        self.body.set_drives(self.stiffness, self.damping, armature=self.armature)
        self.body.set_joint_damping(self.gear_damping)
        self.joints = self.body.find_joints(self.joint_order)

    def load_ground(self, sim: Sim) -> Body:
        """Load the body `ground`."""
        return sim.load("ground", "plane.urdf", fixed=True)

    def act(self, action: np.ndarray) -> None:
        """Set the joints' target angles."""
        self.body.drive_to(self.stance + self.reach * action)
        self.action_change = action - self.last_action
        self.last_action = action.astype(float)
        self.steps += 1

    def measure(self) -> None:
        """Compute what rewards, success and the end share, once per step."""
        orientation = self.body.base_orientation
        self.velocity = rotate_inverse(orientation, self.body.base_velocity)  # [m/s], of the trunk, in its frame
        self.turning = rotate_inverse(orientation, self.body.base_angular_velocity)  # [rad/s], in its frame
        self.gravity = rotate_inverse(orientation, DOWN)
        self.height = self.measure_height()

    def measure_height(self) -> np.ndarray:
        """Return the height of the trunk above the ground [m]."""
        return self.body.base_position[:, 2]

    def observe(self) -> dict[str, np.ndarray]:
        """Return what the robot's own sensors measure, what is commanded, and the last action."""
        orientation = self.body.base_orientation
        return {
            "gyroscope": rotate_inverse(orientation, self.body.base_angular_velocity),
            "gravity": orientation,
            **self.observe_command(),
            "joint_positions": self.body.joint_positions,
            "joint_velocities": self.body.joint_velocities,
            "last_action": self.last_action,
        }

    def observe_command(self) -> dict[str, np.ndarray]:
        """Return what is commanded: nothing, unless a task says what."""
        return {}

    def describe_joints(self) -> Joints:
        """The robot's, in the order of the action."""
        scale = np.broadcast_to(self.reach, len(self.stance)).tolist()
        return self.body.describe_joints(
            self.joint_order, default_positions=self.stance.tolist(), action_scale=scale, measured="joint_positions"
        )
