"""A SCARA arm puts a square peg into a square hole: assembly with a force-torque sensor at the wrist."""

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from rlctl.task import Box, Event, Joints, Sim, Task, TaskError, events, rewards
from rlctl_manipulation.approach import find_yaw_error, measure_way

MODELS = Path(__file__).parent / "models"
SCARA, HOLE = MODELS / "scara.urdf", MODELS / "hole.urdf"
JOINTS = ["shoulder", "elbow", "slide", "wrist"]
TOP_SPEED = np.array([0.8, 1.0, 0.1, 2.0])  # [rad/s, rad/s, m/s, rad/s] at action 1
HOME = np.array([-0.7, 1.4, 0.02, 0.0])  # [rad, rad, m, rad]
HOME_NOISE = np.array([0.2, 0.2, 0.01, 0.3])  # to each side
MOUTH_HEIGHT = 0.1  # [m], of the hole's mouth above the floor
HOLE_DEPTH = 0.03  # [m]
NEAREST, FURTHEST, WIDEST = 0.28, 0.4, 0.7  # [m], [m], [rad]: where the hole may be, seen from the arm's base
SENSOR = "sensor"
SAFE_FORCE = 20.0  # [N], at the wrist
NEAR = 0.005  # [m]
ABOVE = 0.015  # [m], how high the peg is carried beside the hole
CLOSE_UP = 0.01  # [m]
CLOSE = 0.002  # [m], from the hole's axis: the peg may go down


@dataclass
class PegInsert(Task):
    """Put a square peg of 16 mm into a hole of 20 mm, `depth` deep, without pressing hard."""

    depth: float = 0.02  # [m], of 0.03
    start_noise: float = 1.0  # part of HOME_NOISE

    robot = "SCARA arm"
    control_dt, substeps, episode_s = 1 / 60, 4, 5.0  # [s], -, [s]
    action_space = Box(-1.0, 1.0, (4,), np.float32)
    action_meaning = "speeds of shoulder, elbow, slide and wrist; 1 is 0.8 rad/s, 1 rad/s, 0.1 m/s (down), 2 rad/s"
    observation_units = {
        "joint_positions": "rad, slide m",
        "joint_velocities": "rad/s, slide m/s",
        "hole_from_tip": "m",
        "close_up": "m",
        "yaw_error": "rad",
        "wrist_force": "N",
    }
    reward_weights = {
        "distance": -5.0,
        "near": 1.0,
        "yaw_error": -2.0,
        "inserted": 3.0,
        "excess_force": -0.02,
        "action": -0.02,
        "smoothness": -0.05,
    }
    events = {  # with `randomize: true`
        "mass": Event("reset", events.scale_mass, body="arm", factor=(0.8, 1.2)),
        "friction": Event("reset", events.set_friction, body="hole", friction=(0.1, 0.8)),
        "joint_damping": Event("reset", events.scale_joint_damping, body="arm", joints=JOINTS, factor=(0.5, 1.5)),
        "motor_strength": Event("reset", events.scale_motor_strength, body="arm", joints=JOINTS, factor=(0.8, 1.0)),
        "color": Event("reset", events.set_color, body="hole", red=(0, 1), green=(0, 1), blue=(0, 1)),
        "hole_noise": Event(
            "observation", events.noise, of=["hole_from_tip", "close_up"], std=(0.0, 0.0005)
        ),  # [m], of a camera
        "yaw_noise": Event("observation", events.noise, of="yaw_error", std=(0.0, 0.02)),  # [rad]
        "force_noise": Event("observation", events.noise, of="wrist_force", std=(0.0, 0.5)),  # [N]
        "observation_delay": Event("observation", events.delay, steps=(0, 1)),  # of 17 ms
        "action_delay": Event("action", events.delay, steps=(0, 1)),
    }
    rlctl_ignore = {"RL611": "the hole has 2 mm of play, and the arm a circle of 0.9 m"}

    def build(self, sim: Sim) -> None:
        """Load the arm and the block with the hole."""
        if not 0 < self.depth < HOLE_DEPTH:
            raise TaskError(f"depth: {self.depth:g} m is not between 0 and the hole's {HOLE_DEPTH:g} m")
        sim.load("floor", "plane.urdf", fixed=True)
        self.hole = sim.load("hole", HOLE, position=(NEAREST, 0.0, MOUTH_HEIGHT), fixed=True)
        self.arm = sim.load("arm", SCARA, fixed=True)
        self.arm.add_force_sensor(SENSOR)

    def reset(self, rng: np.random.Generator) -> None:
        """Turn the block and put it somewhere in front of the arm, which starts near its home."""
        away, bearing = rng.uniform(NEAREST, FURTHEST), rng.uniform(-WIDEST, WIDEST)
        self.mouth = np.array([away * math.cos(bearing), away * math.sin(bearing), MOUTH_HEIGHT])
        self.hole_yaw = rng.uniform(-math.pi / 4, math.pi / 4)
        half = self.hole_yaw / 2
        # The block's frame is the hole's mouth; PyBullet places its centre of mass, 5 cm below.
        middle = self.mouth - (0.0, 0.0, 0.05)
        self.hole.set_base(middle.tolist(), (0.0, 0.0, math.sin(half), math.cos(half)))
        self.arm.set_joints(HOME + self.start_noise * rng.uniform(-HOME_NOISE, HOME_NOISE))
        self.last_action = self.action_change = np.zeros(4, np.float32)
        self.force = np.zeros(3)  # no step has measured anything yet
        self.update()

    def act(self, action: np.ndarray) -> None:
        """Set the joints' speeds."""
        self.arm.drive_at(TOP_SPEED * action, joints=JOINTS)
        self.action_change, self.last_action = action - self.last_action, action

    def update(self) -> None:
        """Read what rewards and observations share, once per step."""
        self.from_tip = self.mouth - self.arm.link_position("tip")
        shoulder, elbow, _, wrist = self.arm.joint_positions
        self.forearm_yaw = float(shoulder + elbow)
        self.yaw_error = find_yaw_error(self.hole_yaw - self.forearm_yaw - float(wrist))

    def observe(self) -> dict[str, np.ndarray]:
        """Return the arm, the hole as the forearm sees it, and the force at the wrist, in the peg's axes."""
        cos, sin = math.cos(self.forearm_yaw), math.sin(self.forearm_yaw)
        x, y, z = self.from_tip
        hole = np.array([cos * x + sin * y, cos * y - sin * x, z])
        return {
            "joint_positions": self.arm.joint_positions,
            "joint_velocities": self.arm.joint_velocities,
            "hole_from_tip": hole,
            "close_up": np.clip(hole, -CLOSE_UP, CLOSE_UP),  # normalised, 2 mm of 40 cm are hardly anything
            "yaw_error": np.array([self.yaw_error]),
            "wrist_force": self.force,
        }

    def rewards(self, action: np.ndarray) -> dict[str, float]:
        """Return the way to the hole, how deep the peg is in it, and how hard it presses."""
        self.force = self.arm.joint_reaction(SENSOR)[:3]
        self.update()
        way = measure_way(self.from_tip, close=CLOSE, above=ABOVE)
        return {
            "distance": way,
            "near": rewards.closeness(way, NEAR),
            "yaw_error": abs(self.yaw_error),
            "inserted": min(self.inserted() / self.depth, 1.0),
            "excess_force": rewards.excess_force(np.array([np.linalg.norm(self.force)]), SAFE_FORCE),
            "action": rewards.squared(action),
            "smoothness": rewards.squared(self.action_change),
        }

    def aside(self) -> float:
        """Return how far the tip is from the hole's axis [m]."""
        return math.hypot(self.from_tip[0], self.from_tip[1])

    def inserted(self) -> float:
        """Return how deep the peg is in the hole [m]."""
        return max(float(self.from_tip[2]), 0.0) if self.aside() < CLOSE else 0.0

    def is_success(self) -> bool:
        """The peg is in, as deep as it should be."""
        return self.inserted() >= self.depth

    def markers(self) -> dict[str, np.ndarray]:
        """The hole's mouth."""
        return {"hole": self.mouth}

    def describe_joints(self) -> Joints:
        """The arm's, which get speeds."""
        return self.arm.describe_joints(JOINTS)
