"""Walk: Unitree's A1 follows velocity commands in every direction, in many worlds at once."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from rlctl.task import BatchTask, Body, Box, CommandTerm, Event, Joints, Sim, WorldRngs, events, rewards, terms
from rlctl.task.rotations import rotate_inverse
from rlctl_locomotion.quadruped import JOINTS

STANCE = np.array([0.0, 0.8, -1.6] * 4)  # [rad]
REACH = 0.25  # [rad], from the stance, at action 1
STIFFNESS, DAMPING, ARMATURE = 35.0, 0.7, 0.01  # [N m/rad], [N m s/rad], [kg m^2]: of the A1's position controllers
START_HEIGHT, HEIGHT, FALLEN = 0.30, 0.28, 0.14  # [m], of the trunk
LOWEST = np.array([-0.5, -0.4, -0.8])  # commanded velocities forwards and sideways [m/s], and of turning [rad/s]
HIGHEST = np.array([1.0, 0.4, 0.8])
VELOCITIES = {"lin_vel_x": "m/s", "lin_vel_y": "m/s", "ang_vel_z": "rad/s"}  # their names and units
OTHER_SIDE = (-4, 5, 6, -1, 2, 3, -10, 11, 12, -7, 8, 9)  # joints of the mirror image: hips turn the other way
DOWN = np.array([0.0, 0.0, -1.0])


@dataclass
class Walk(BatchTask):
    """Walk forwards, sideways and turn as commanded, without falling; linear velocity is not observed."""

    tolerance: float = 0.2  # [m/s], largest mean error of the velocity in an episode that succeeds
    start_noise: float = 0.1  # [rad], of every joint, to each side of the stance
    episode_s: float = 10.0

    command: np.ndarray = field(init=False, repr=False)  # velocities forwards, sideways [m/s] and of turning [rad/s]
    last_action: np.ndarray = field(init=False, repr=False)
    action_change: np.ndarray = field(init=False, repr=False)
    error_sum: np.ndarray = field(init=False, repr=False)  # [m/s], over the steps of the episode
    steps: np.ndarray = field(init=False, repr=False)

    robot = "Unitree A1"
    control_dt, substeps, solver_iterations = 0.02, 4, 3  # [s], -, -
    action_space = Box(-4.0, 4.0, (12,), np.float32)
    action_meaning = "joint angles from the stance; 1 is 0.25 rad"
    observation_units = {
        "gyroscope": "rad/s",
        "orientation": "quaternion x, y, z, w",
        "command": "m/s, m/s, rad/s",
        "joint_positions": "rad",
        "joint_velocities": "rad/s",
    }
    observation_terms = {
        "gravity": terms.Gravity("orientation"),
        "joint_positions": terms.Scaled("joint_positions", offset=tuple(STANCE)),
        "last_action": terms.LastAction(),
    }
    reward_weights = {
        "tracking": 0.1,
        "turning": 0.05,
        "bounce": -0.03,
        "sway": -0.005,
        "smoothness": -0.012,
        "posture": -0.2,
        "height": -2.0,
        "fall": -1.0,
        "velocity_error": 0.0,  # a metric [m/s]
    }
    scale = 0.5  # [m/s] and [rad/s]; so far from the command, tracking is worth 1/e
    per_world = {"command": (3,), "last_action": (12,), "action_change": (12,), "error_sum": (), "steps": ()}
    mirror = {
        "gyroscope": (-1, 2, -3),
        "gravity": (1, -2, 3),
        "command": (1, -2, -3),
        **dict.fromkeys(("joint_positions", "joint_velocities", "last_action", "action"), OTHER_SIDE),
    }
    events = {  # with `randomize: true`
        "mass": Event("reset", events.scale_mass, body="robot", factor=(0.8, 1.2)),
        "friction": Event("reset", events.set_friction, body="ground", friction=(0.4, 1.2)),
        "motor_strength": Event("reset", events.scale_motor_strength, body="robot", factor=(0.8, 1.0)),
        "gyroscope_noise": Event("observation", events.noise, of="gyroscope", std=(0.0, 0.2)),  # [rad/s]
        "position_noise": Event("observation", events.noise, of="joint_positions", std=(0.0, 0.01)),  # [rad]
        "velocity_noise": Event("observation", events.noise, of="joint_velocities", std=(0.0, 1.0)),  # [rad/s]
        "action_delay": Event("action", events.delay, steps=(0, 1)),  # of 20 ms
        "push": Event("interval", events.kick, every_s=4.0, body="robot", speed=(0.0, 0.7)),  # [m/s]
    }
    rlctl_ignore = {
        "RL106": "action 1 is 0.25 rad, about what it needs; up to 4 it may target angles out of reach, for force",
        "RL611": "following a command is what training is for; random actions stay where they are",
    }

    def build(self, sim: Sim) -> None:
        """Load the ground and the robot."""
        self.ground = self.load_ground(sim)
        self.ground.set_friction(0.8)
        self.body = sim.load("robot", "a1.urdf", position=(0.0, 0.0, START_HEIGHT))
        self.body.set_friction(1.0)  # times the ground's
        self.body.set_drives(STIFFNESS, DAMPING, armature=ARMATURE)
        self.body.set_joint_damping(0.3)  # [N m s/rad], of the gears
        self.joints = self.body.find_joints(JOINTS)

    def load_ground(self, sim: Sim) -> Body:
        """Load the body `ground`."""
        return sim.load("ground", "plane.urdf", fixed=True)

    def reset(self, rng: WorldRngs, worlds: np.ndarray) -> None:
        """Stand, with a commanded velocity."""
        count = len(worlds)
        self.body.set_base(np.tile([0.0, 0.0, START_HEIGHT], (count, 1)), worlds=worlds)
        self.body.set_joints(STANCE + rng.uniform(-self.start_noise, self.start_noise, 12), worlds=worlds)
        self.command[worlds] = rng.uniform(LOWEST, HIGHEST)

    def act(self, action: np.ndarray) -> None:
        """Set the joints' target angles."""
        self.body.drive_to(STANCE + REACH * action)
        self.action_change = action - self.last_action
        self.last_action = action.astype(float)
        self.steps += 1

    def is_terminated(self) -> np.ndarray:
        """It has fallen: upside down, or with its trunk near the ground."""
        self.measure()
        return self.fallen

    def measure(self) -> None:
        """Compute what rewards, success and the end share, once per step."""
        orientation = self.body.base_orientation
        self.velocity = rotate_inverse(orientation, self.body.base_velocity)  # [m/s], of the trunk, in its frame
        self.turning = rotate_inverse(orientation, self.body.base_angular_velocity)  # [rad/s], in its frame
        self.gravity = rotate_inverse(orientation, DOWN)
        self.height = self.measure_height()
        self.fallen = (self.gravity[:, 2] > -0.5) | (self.height < FALLEN)
        self.error = np.linalg.norm(self.command[:, :2] - self.velocity[:, :2], axis=1)  # [m/s]
        self.error_sum += self.error

    def measure_height(self) -> np.ndarray:
        """Return the height of the trunk above the ground [m]."""
        return self.body.base_position[:, 2]

    def observe(self) -> dict[str, np.ndarray]:
        """Return what the robot's own sensors measure, the command and the last action; see `observation_terms`."""
        orientation = self.body.base_orientation
        return {
            "gyroscope": rotate_inverse(orientation, self.body.base_angular_velocity),
            "gravity": orientation,
            "command": self.command,
            "joint_positions": self.body.joint_positions,
            "joint_velocities": self.body.joint_velocities,
            "last_action": self.last_action,
        }

    def rewards(self, action: np.ndarray) -> dict[str, np.ndarray]:
        """Return how well the command is followed, and how calmly."""
        return {
            "tracking": rewards.closeness(self.error, self.scale),
            "turning": rewards.closeness(self.command[:, 2] - self.turning[:, 2], self.scale),
            "bounce": self.velocity[:, 2] ** 2,
            "sway": np.sum(self.turning[:, :2] ** 2, axis=1),
            "smoothness": rewards.squared(self.action_change),
            "posture": np.sum(self.gravity[:, :2] ** 2, axis=1),
            "height": (self.height - HEIGHT) ** 2,
            "fall": self.fallen.astype(float),
            "velocity_error": self.error,
        }

    def is_success(self) -> np.ndarray:
        """It is up, and on average within `tolerance` of the commanded velocity."""
        return ~self.fallen & (self.error_sum <= self.tolerance * np.maximum(self.steps, 1))

    def commands(self) -> dict[str, CommandTerm]:
        """Return the commanded velocities: forwards, to the left, and of turning to the left."""
        rows = zip(VELOCITIES.items(), self.command.T, LOWEST.tolist(), HIGHEST.tolist(), strict=True)
        return {name: CommandTerm(values, low, high, unit, True) for (name, unit), values, low, high in rows}

    def set_commands(self, values: Mapping[str, np.ndarray]) -> None:
        """Set commanded velocities."""
        for name, value in values.items():
            self.command[:, list(VELOCITIES).index(name)] = value

    def describe_joints(self) -> Joints:
        """The legs', leg by leg."""
        return self.body.describe_joints(
            JOINTS, default_positions=STANCE.tolist(), action_scale=[REACH] * 12, measured="joint_positions"
        )
