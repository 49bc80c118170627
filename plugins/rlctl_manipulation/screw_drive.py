"""A gantry drives a screw home: a square bit into the head's socket, turns, not too tight."""

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from rlctl.task import Box, Event, Joints, Sim, Task, TaskError, events, rewards
from rlctl_manipulation.approach import find_yaw_error, measure_way

MODELS = Path(__file__).parent / "models"
GANTRY, SCREW = MODELS / "gantry.urdf", MODELS / "screw.urdf"
JOINTS = ["x", "y", "z", "spindle"]
TOP_SPEED = np.array([0.2, 0.2, 0.1, 12.0])  # [m/s, m/s, m/s, rad/s] at action 1
HOME = np.array([0.0, 0.0, 0.01, 0.0])  # [m, m, m, rad]
HOME_NOISE = np.array([0.05, 0.05, 0.005, math.pi / 4])  # to each side
BLOCK_LOW, BLOCK_HIGH = (-0.05, -0.1), (0.15, 0.1)  # [m], x and y
BLOCK_HEIGHT = 0.1  # [m]
LEAD = 0.005  # [m], what a turn of the screw takes it down
TRAVEL = 0.018  # [m], until the head is on the block
LOOSEST = 0.006  # [m], of TRAVEL, is behind a screw at most when it starts
SEATED = 0.0005  # [m], of TRAVEL left
SENSOR = "sensor"
SAFE_FORCE, SAFE_TORQUE = 20.0, 0.5  # [N], [N m], at the spindle
NEAR = 0.005  # [m]
ABOVE = 0.015  # [m], how high the bit is carried beside the socket
CLOSE_UP = 0.01  # [m]
CLOSE = 0.002  # [m], from the socket's axis: the bit may go down
ENGAGED = 0.005  # [m], how deep in the socket the bit turns the screw safely


@dataclass
class ScrewDrive(Task):
    """Drive a screw down until its head is on the block, without pressing or tightening too much."""

    thread_friction: float = 0.2  # [N m]
    start_noise: float = 1.0  # part of HOME_NOISE
    head_start: float = 0.0  # mean part of the way to the socket that is gone already; much above 1: the bit is in it

    robot = "gantry with a screwdriver"
    control_dt, substeps, episode_s = 1 / 60, 4, 5.0  # [s], -, [s]
    action_space = Box(-1.0, 1.0, (4,), np.float32)
    action_meaning = "speeds of x, y, z and spindle; 1 is 0.2 m/s, 0.2 m/s, 0.1 m/s (down), 12 rad/s (clockwise)"
    observation_units = {
        "slide_positions": "m",
        "joint_velocities": "m/s, spindle rad/s",
        "socket_from_tip": "m",
        "close_up": "m",
        "yaw_error": "rad",
        "left_to_drive": "m",
        "wrist_force": "N",
        "wrist_torque": "N m",
    }
    reward_weights = {
        "distance": -5.0,
        "near": 1.0,
        "yaw_error": -2.0,
        "engaged": 2.0,
        "turning": 1.0,
        "driven": 8.0,
        "home": 3.0,
        "excess_force": -0.02,
        "excess_torque": -1.0,
        "action": -0.02,
        "smoothness": -0.05,
    }
    events = {  # with `randomize: true`
        "mass": Event("reset", events.scale_mass, body="gantry", factor=(0.8, 1.2)),
        "friction": Event("reset", events.set_friction, body="screw", friction=(0.1, 0.8)),
        "thread": Event("reset", events.scale_motor_strength, body="screw", joints=["turn"], factor=(0.5, 1.5)),
        "joint_damping": Event("reset", events.scale_joint_damping, body="gantry", joints=JOINTS, factor=(0.5, 1.5)),
        "motor_strength": Event("reset", events.scale_motor_strength, body="gantry", joints=JOINTS, factor=(0.8, 1.0)),
        "color": Event("reset", events.set_color, body="screw", red=(0, 1), green=(0, 1), blue=(0, 1)),
        "socket_noise": Event(
            "observation", events.noise, of=["socket_from_tip", "close_up"], std=(0.0, 0.0005)
        ),  # [m], of a camera
        "force_noise": Event("observation", events.noise, of="wrist_force", std=(0.0, 0.5)),  # [N]
        "torque_noise": Event("observation", events.noise, of="wrist_torque", std=(0.0, 0.02)),  # [N m]
        "observation_delay": Event("observation", events.delay, steps=(0, 1)),  # of 17 ms
        "action_delay": Event("action", events.delay, steps=(0, 1)),
    }
    rlctl_ignore = {"RL611": "the socket has 2 mm of play, and the block lies anywhere in 0.2 m x 0.2 m"}

    def build(self, sim: Sim) -> None:
        """Load gantry, block and screw, and cut the thread."""
        if not 0 <= self.thread_friction < 1:
            raise TaskError(f"thread_friction: {self.thread_friction:g} N m is not in [0, 1), the spindle's torque")
        sim.load("floor", "plane.urdf", fixed=True)
        self.screw = sim.load("screw", SCREW, position=(0.05, 0.0, BLOCK_HEIGHT), fixed=True)
        self.screw.disable_motors(["travel"])
        sim.connect_gear(self.screw, "turn", "travel", ratio=LEAD / (2 * math.pi))
        self.gantry = sim.load("gantry", GANTRY, fixed=True)
        self.gantry.add_force_sensor(SENSOR)

    def reset(self, rng: np.random.Generator) -> None:
        """Put the block somewhere below the gantry, its screw partly in; the gantry starts near home or on the way."""
        x, y = rng.uniform(BLOCK_LOW, BLOCK_HIGH)
        self.block_yaw = rng.uniform(-math.pi / 4, math.pi / 4)
        half = self.block_yaw / 2
        # The block's frame is its upper side; PyBullet places its centre of mass, 5 cm below.
        self.screw.set_base((x, y, BLOCK_HEIGHT - 0.05), (0.0, 0.0, math.sin(half), math.cos(half)))
        self.start = rng.uniform(0.0, LOOSEST)
        self.screw.set_joints(np.array([self.start, 2 * math.pi / LEAD * self.start]))
        self.gantry.set_joints(HOME + self.start_noise * rng.uniform(-HOME_NOISE, HOME_NOISE))
        if self.head_start > 0:
            self.update()
            self.shorten_way(rng)
        self.last_action = self.action_change = np.zeros(4, np.float32)
        self.force, self.torque = np.zeros(3), 0.0  # no step has measured anything yet
        self.update()

    def shorten_way(self, rng: np.random.Generator) -> None:
        """Move the bit to somewhere on its way to a place over the socket, or into it where that is reached."""
        way = min(rng.uniform(0.0, 2 * self.head_start), 1.0)
        height = rng.uniform(-ENGAGED, 0.003) if way == 1.0 else 0.005  # [m]
        x, y, z = self.from_tip + np.array([*rng.uniform(-0.001, 0.001, 2), height])
        left = np.array([x, y, -z, rng.uniform(-0.2, 0.2) - self.yaw_error])
        self.gantry.set_joints(self.gantry.joint_positions + way * left)

    def act(self, action: np.ndarray) -> None:
        """Set the joints' speeds, and the friction of the thread."""
        self.gantry.drive_at(TOP_SPEED * action, joints=JOINTS)
        self.screw.drive_at(np.zeros(1), max_force=self.thread_friction, joints=["turn"])
        self.action_change, self.last_action = action - self.last_action, action

    def update(self) -> None:
        """Read what rewards and observations share, once per step."""
        self.from_tip = self.screw.link_position("screw") - self.gantry.link_position("tip")
        self.travel, turned = (float(each) for each in self.screw.joint_positions)
        self.bit_yaw = -float(self.gantry.joint_positions[3])  # the spindle turns about an axis that points down
        self.yaw_error = find_yaw_error(self.block_yaw - turned - self.bit_yaw)

    def observe(self) -> dict[str, np.ndarray]:
        """Return the gantry, the screw as the bit sees it, and the force at the spindle, along the gantry's axes."""
        cos, sin = math.cos(self.bit_yaw), math.sin(self.bit_yaw)
        x, y, z = self.force
        return {
            "slide_positions": self.gantry.joint_positions[:3],
            "joint_velocities": self.gantry.joint_velocities,
            "socket_from_tip": self.from_tip,
            "close_up": np.clip(self.from_tip, -CLOSE_UP, CLOSE_UP),  # normalised, 1 mm of 20 cm is hardly anything
            "yaw_error": np.array([self.yaw_error]),
            "left_to_drive": np.array([TRAVEL - self.travel]),
            "wrist_force": np.array([cos * x - sin * y, sin * x + cos * y, z]),
            "wrist_torque": np.array([self.torque]),
        }

    def rewards(self, action: np.ndarray) -> dict[str, float]:
        """Return the way to the socket, how far the screw is driven, how hard the bit presses and turns."""
        reaction = self.gantry.joint_reaction(SENSOR)
        self.force, self.torque = reaction[:3], float(reaction[5])
        self.update()
        way = measure_way(self.from_tip, close=CLOSE, above=ABOVE, depth=ENGAGED)
        engaged, home = self.measure_engagement(), self.is_success()
        return {
            "distance": way,
            "near": rewards.closeness(way, NEAR),
            "yaw_error": 0.0 if engaged > 0 else abs(self.yaw_error),  # a bit that turns the screw is askew
            "engaged": engaged,
            "turning": 0.0 if home else engaged * self.gantry.joint_velocities[3] / TOP_SPEED[3],
            "driven": (self.travel - self.start) / (TRAVEL - self.start),
            "home": float(home),
            "excess_force": rewards.excess_force(np.array([np.linalg.norm(self.force)]), SAFE_FORCE),
            "excess_torque": rewards.excess_force(np.array([abs(self.torque)]), SAFE_TORQUE),
            "action": rewards.squared(action),
            "smoothness": rewards.squared(self.action_change),
        }

    def measure_engagement(self) -> float:
        """Return how deep the bit is in the socket, as part of ENGAGED, at most 1."""
        x, y, depth = self.from_tip
        return min(max(float(depth) / ENGAGED, 0.0), 1.0) if math.hypot(x, y) < CLOSE else 0.0

    def is_success(self) -> bool:
        """The head is on the block."""
        return TRAVEL - self.travel <= SEATED

    def markers(self) -> dict[str, np.ndarray]:
        """The socket's mouth."""
        return {"socket": self.screw.link_position("screw")}

    def describe_joints(self) -> Joints:
        """The gantry's, which get speeds."""
        return self.gantry.describe_joints(JOINTS)
