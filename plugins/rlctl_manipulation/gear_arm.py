"""Gear arm: torques, gears and a linkage bring a gripper to an object, which it grasps and lifts.

The arm hangs from a base 0.5 m high. Every motor turns its joint through a gear of ratio 1/3: 5 N m become 15 N m, four
times what holds the arm out level, at a third of the speed. The forearm is moved by a crank beside the upper arm:
crank, rod, upper arm and forearm are a four-bar linkage, a parallelogram, so that all motors sit at the base and the
forearm's slope is the crank's angle. The wrist is geared to the crank with ratio -1: the gripper always points down.
Its right finger is geared to its left one, which the fourth action moves.
"""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from rlctl.task import Attachment, Box, Event, Joints, Sim, Task, TaskError, events, rewards

MODEL = Path(__file__).parent / "models" / "gear_arm.urdf"
JOINTS = ["turn", "shoulder", "crank"]
MOTORS = [f"{joint}_motor" for joint in JOINTS]
GEAR = 1 / 3
TORQUE = 5.0  # [N m], of a motor at action 1
FINGERS = ["left_finger_joint", "right_finger_joint"]
FINGER_SPEED, FINGER_FORCE = 0.1, [15.0]  # [m/s] at action 1, [N]
OPEN = 0.034  # [m], of each finger
BASE = (0.0, 0.0, 0.5)  # [m]
UPPER_ARM = FOREARM = 0.3  # [m]
CRANK = 0.12  # [m]
TOOL = 0.1  # [m], from the wrist down to the middle between the finger tips
HOME = np.array([0.0, -0.4, 1.57])  # [rad], of JOINTS: the tool is 0.28 m before the base and 0.22 m high
HOME_NOISE = 0.1  # [rad]
# End stops of the motors' controllers [rad]: softer than those of joints, which kick in a closed loop.
STOPS = {"turn": (-3.14, 3.14), "shoulder": (-0.8, 0.9), "crank": (0.5, 2.9)}
ELBOW = (0.75, 2.4)  # [rad]; straight or folded, a parallelogram would not know which way to go
STOP_STIFFNESS = 60.0  # [N m/rad]

GOAL_HEIGHT = 0.1  # [m]: of the middle of an object of 4 cm on a table of 8 cm
TABLE_HEIGHT = 0.08  # [m]
DROP = np.array([0.0, 0.0, 0.02])  # [m], from where the cube falls onto the table
NEAR = 0.05  # [m]
HELD = 0.025  # [m], from the tool to an object that is between the fingers, and not below closed ones
HALF_OBJECT = 0.02  # [m]
WIDE = HALF_OBJECT + 0.002  # [m], of each finger: they go down beside the object
OVER = 0.02  # [m], the way to the object at which fingers go down beside it
CLEARANCE = 0.06  # [m], above an object, at which the tool goes there from beside it
LIFTED = 0.05  # [m], above the table
FARTHEST = 0.5  # [m], that an object counts as being away
HOLD_S = 0.5  # [s]


@dataclass
class GearArm(Task):
    """Bring the tool within 5 cm of the goal (`stage: reach`), hold an object there (`grasp`), lift it (`lift`)."""

    stage: Literal["reach", "grasp", "lift"] = "reach"
    goal_range: float = 0.3  # [m], of the goal's x and y around the base
    tolerance: float = NEAR  # [m]
    start_noise: float = HOME_NOISE  # [rad], of JOINTS, to each side of the home pose
    head_start: float = 0.0  # mean part of the way to the object that is gone already when grasp or lift begins
    episode_s: float = 10.0  # [s], 500 steps

    robot = "gear arm"
    control_dt, substeps, solver_iterations = 0.02, 8, 120  # [s], -, -; the linkage drifts 2 mm with 50 iterations
    action_space = Box(-1.0, 1.0, (4,), np.float32)
    action_meaning = "torques of the motors of turn, shoulder and crank, 1 is 5 N m; opening speed of the gripper"
    observation_units = {
        "joint_positions": "rad",
        "joint_velocities": "rad/s",
        "opening": "m",
        "tool": "m",
        "turn_to_object": "rad",
        "object_from_tool": "m",
    }
    reward_weights = {
        "distance": -2.0,
        "arrival": 1.0,
        "grasp": 1.0,
        "lift": 2.0,
        "lost": -50.0,
        "energy": -0.001,
        "amplitude": -0.01,
        "time": -0.5,
    }
    events = {  # with `randomize: true`
        "mass": Event("reset", events.scale_mass, body="arm", factor=(0.8, 1.2)),
        "gravity": Event("reset", events.shift_gravity, change=(-0.5, 0.5)),  # [m/s^2]
        "joint_damping": Event("reset", events.scale_joint_damping, body="arm", joints=JOINTS, factor=(0.5, 1.5)),
        "friction": Event(
            "reset", events.set_friction, body="arm", links=["left_finger", "right_finger"], friction=(0.3, 1.5)
        ),
        "table_friction": Event("reset", events.set_friction, body="table", friction=(0.3, 1.5)),
        "motor_strength": Event("reset", events.scale_motor_strength, body="arm", joints=MOTORS, factor=(0.8, 1.0)),
        "color": Event("reset", events.set_color, body="arm", red=(0, 1), green=(0, 1), blue=(0, 1)),
        "position_noise": Event("observation", events.noise, of="joint_positions", std=(0.0, 0.005)),  # [rad]
        "velocity_noise": Event("observation", events.noise, of="joint_velocities", std=(0.0, 0.05)),  # [rad/s]
        "goal_noise": Event("observation", events.noise, of="object_from_tool", std=(0.0, 0.005)),  # [m]
        "observation_delay": Event("observation", events.delay, steps=(0, 1)),  # of 20 ms
        "action_noise": Event("action", events.noise, std=(0.0, 0.05)),
        "action_delay": Event("action", events.delay, steps=(0, 1)),
        "push": Event("interval", events.push, every_s=2.0, body="arm", link="palm", force=(0.0, 5.0)),
    }
    rlctl_ignore = {
        "RL110": "in the stage reach there is no object that could turn or be touched; all stages observe the same",
        "RL611": "a goal is 5 cm in a circle of 0.4 m, and torques have to hold the arm there",
    }

    def build(self, sim: Sim) -> None:
        """Load arm and table, close the linkage, mesh the gears."""
        if self.stage not in ("reach", "grasp", "lift"):
            raise TaskError(f"stage: {self.stage!r} is not one of: reach, grasp, lift")
        check_reach(self.goal_range)
        self.arm = sim.load("arm", MODEL, position=BASE, fixed=True)
        self.joints, self.motors = self.arm.find_joints(JOINTS), self.arm.find_joints(MOTORS)
        self.elbow, self.left_finger = self.arm.find_joints(["elbow", FINGERS[0]])
        self.arm.set_joints(self.pose(HOME, OPEN / 2))
        for joint, motor in zip(JOINTS, MOTORS, strict=True):
            sim.connect_gear(self.arm, motor, joint, ratio=GEAR)
        sim.connect_gear(self.arm, "crank", "wrist", ratio=-1.0)
        sim.connect_gear(self.arm, *FINGERS, ratio=1.0)
        self.linkage = sim.connect_point(
            Attachment(self.arm, "rod", (UPPER_ARM, 0.0, 0.0)), Attachment(self.arm, "forearm", (-CRANK, 0.0, 0.0))
        )
        self.arm.disable_motors()
        self.table = sim.load("table", MODEL.with_name("table.urdf"), fixed=True)
        if self.stage != "reach":
            sim.load("floor", "plane.urdf", fixed=True)  # a cube that slides off the table does not fall for ever
            self.cube = sim.load("object", MODEL.with_name("cube.urdf"), position=(0.3, 0.0, GOAL_HEIGHT))

    def pose(self, joints: np.ndarray, opening: float) -> np.ndarray:
        """Return all joint positions, gears and linkage included, for JOINTS of shape (3,) [rad] and fingers [m]."""
        _, shoulder, crank = joints
        angles = dict(zip(JOINTS, joints, strict=True)) | {"elbow": crank - shoulder, "rod_joint": shoulder - crank}
        angles |= {motor: angle / GEAR for motor, angle in zip(MOTORS, joints, strict=True)}
        angles |= {"wrist": -crank} | dict.fromkeys(FINGERS, opening)
        return np.array([angles[name] for name in self.arm.joint_names])

    def reset(self, rng: np.random.Generator) -> None:
        """Start near the home pose, a goal on the table; where there is an object to grasp, with open fingers."""
        joints = HOME + rng.uniform(-self.start_noise, self.start_noise, 3)
        self.goal = np.array([*rng.uniform(-self.goal_range, self.goal_range, 2), GOAL_HEIGHT])
        opening = OPEN / 2 if self.stage == "reach" else 0.95 * OPEN
        if self.head_start > 0 and self.stage != "reach":
            # Anywhere on the way, evenly, and over the object where that is beyond it: 1 begins half of them there.
            way = min(rng.uniform(0.0, 2 * self.head_start), 1.0)
            over = find_joints_for(self.goal + np.array([0.0, 0.0, rng.uniform(0.005, 0.05)]))
            joints = (1 - way) * joints + way * (over + rng.uniform(-0.01, 0.01, 3))
            opening = OPEN * rng.uniform(0.62, 1.0)  # from 1 mm beside the object on
        self.arm.set_joints(self.pose(joints, opening))
        if self.stage != "reach":
            # One side faces the base: the gripper turns with the arm, and not by itself. A box, and let fall, because
            # contacts of round shapes, and those that last through a fast reset, do not repeat bit for bit.
            half = math.atan2(self.goal[1], self.goal[0]) / 2
            self.cube.set_base((self.goal + DROP).tolist(), (0.0, 0.0, math.sin(half), math.cos(half)))
        self.action, self.held_steps = np.zeros(4), 0
        self.update()

    def act(self, action: np.ndarray) -> None:
        """Set the motors' torques and the fingers' speed."""
        self.action = action
        self.arm.set_torques(TORQUE * action[:3] + GEAR * self.stop_torques(), joints=MOTORS)
        self.arm.drive_at(FINGER_SPEED * action[3:].astype(np.float64), max_force=FINGER_FORCE, joints=FINGERS[:1])

    def stop_torques(self) -> np.ndarray:
        """Return what the end stops turn the joints back with [N m], shape (3,); 0 between them."""
        angles = self.arm.joint_positions
        turn, shoulder, crank = (
            stop_torque(angles[joint], *STOPS[name]) for name, joint in zip(JOINTS, self.joints, strict=True)
        )
        elbow = stop_torque(angles[self.elbow], *ELBOW)  # the elbow's angle is the crank's less the shoulder's
        return np.array([turn, shoulder - elbow, crank + elbow])

    def update(self) -> None:
        """Read what rewards and observations share, once per step."""
        self.tool = self.arm.link_position("tool")
        self.object = self.goal if self.stage == "reach" else self.cube.base_position

    def observe(self) -> dict[str, np.ndarray]:
        """Return the arm, the gripper, and the object, which is the goal in `reach`, in the frame of the turning arm.

        There a grasp is the same all around the base: in the world's frame it had to be learned for each direction.
        """
        turn = float(self.arm.joint_positions[self.joints[0]])
        out, side = np.array([math.cos(turn), math.sin(turn)]), np.array([-math.sin(turn), math.cos(turn)])
        (x, y), away = self.object[:2], self.object - self.tool
        yaw, touching = 0.0, set[str]()
        if self.stage != "reach":
            yaw, touching = yaw_of(self.cube.base_orientation) - turn, self.arm.links_touching(self.cube)
        return {
            "joint_positions": self.arm.joint_positions[self.joints],
            "joint_velocities": self.arm.joint_velocities[self.joints],
            "opening": self.arm.joint_positions[self.left_finger : self.left_finger + 1],
            "tool": np.array([self.tool[:2] @ out, self.tool[2]]),
            "turn_to_object": np.array([math.atan2(y, x) - turn]),
            "object_from_tool": np.array([away[:2] @ out, away[:2] @ side, away[2]]),
            "object_yaw": np.array([math.sin(4 * yaw), math.cos(4 * yaw)]),  # a cube has four sides alike
            "touching": np.array([finger in touching for finger in ("left_finger", "right_finger")], np.float64),
        }

    def rewards(self, action: np.ndarray) -> dict[str, float]:
        """Return how near the tool is, what the object does, and what it takes."""
        self.update()
        held = self.is_held()
        height = float(self.object[2]) - GOAL_HEIGHT
        done = held and (self.stage != "lift" or height > LIFTED)
        self.held_steps = self.held_steps + 1 if done else 0
        way = rewards.distance(self.tool, self.object) if self.stage == "reach" else self.measure_way()
        torques = self.arm.joint_torques[self.motors]
        return {
            "distance": way,
            "arrival": rewards.closeness(way, NEAR),
            "grasp": self.measure_grasp(way, held),
            "lift": min(max(height, 0.0), LIFTED) / LIFTED if held else 0.0,
            "lost": float(self.is_lost()),
            "energy": rewards.power(torques, self.arm.joint_velocities[self.motors]),
            "amplitude": rewards.squared(action),
            "time": rewards.time_spent(self.control_dt),
        }

    def measure_way(self) -> float:
        """Return how far the tool is from above the object, and the nearer to its axis the lower above it [m].

        Straight for the object, the fingers would push it away. It counts as FARTHEST at most.
        """
        x, y, z = self.object - self.tool
        aside = math.hypot(x, y)
        return min(math.hypot(aside, z + min(max(2 * (aside - 0.01), 0.0), CLEARANCE)), FARTHEST)

    def measure_grasp(self, way: float, held: bool) -> float:
        """Return how far a grasp has come, in [0, 1]: half for going down over the object, half for closing on it.

        Closed before they are beside the object, the fingers would stand on it; pressed onto the table beside it, they
        could not close. Wider than the object is wide enough: paid for more, fingers stay open.
        """
        if self.stage == "reach":
            return rewards.grasp(way, NEAR, held)
        opening = min(max(float(self.arm.joint_positions[self.left_finger]), 0.0), OPEN)
        near = 0.5 * rewards.closeness(way, OVER)
        if rewards.distance(self.tool, self.object) > HELD:
            return near * min(opening / WIDE, 1.0)
        closed = min((OPEN - opening) / (OPEN - HALF_OBJECT), 1.0)
        return near * (1.0 + 0.5 * closed) + 0.25 * held

    def is_held(self) -> bool:
        """Both fingers touch the object, which is between them."""
        if self.stage == "reach" or rewards.distance(self.tool, self.object) > HELD:
            return False
        return self.arm.links_touching(self.cube) >= {"left_finger", "right_finger"}

    def is_lost(self) -> bool:
        """The object is not on the table any more, nor above it."""
        return self.stage != "reach" and self.object[2] < TABLE_HEIGHT

    def is_terminated(self) -> bool:
        """The object is lost."""
        return self.is_lost()

    def is_success(self) -> bool:
        """The tool is at the goal; or the object has been held, or held above the table, for half a second."""
        if self.stage == "reach":
            return rewards.distance(self.tool, self.goal) < self.tolerance
        return self.held_steps * self.control_dt >= HOLD_S

    def markers(self) -> dict[str, np.ndarray]:
        """The goal."""
        return {"goal": self.goal}

    def describe_joints(self) -> Joints:
        """The motors', which get torques, and a finger's, which gets a speed."""
        return self.arm.describe_joints([*MOTORS, FINGERS[0]])


def find_joints_for(point: np.ndarray) -> np.ndarray:
    """Return the angles of JOINTS [rad], shape (3,), that bring the tool to a point [m]: law of cosines, elbow up."""
    x, y, z = point
    away, drop = math.hypot(x, y), BASE[2] - TOOL - z
    cosine = (away**2 + drop**2 - UPPER_ARM**2 - FOREARM**2) / (2 * UPPER_ARM * FOREARM)
    elbow = math.acos(min(max(cosine, math.cos(ELBOW[1])), math.cos(ELBOW[0])))
    shoulder = math.atan2(drop, away) - elbow / 2
    return np.array([math.atan2(y, x), shoulder, shoulder + elbow])


def yaw_of(orientation: np.ndarray) -> float:
    """Return the angle [rad] about z that a quaternion (x, y, z, w) turns the x axis by."""
    x, y, z, w = orientation
    return math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))


def stop_torque(angle: float, low: float, high: float) -> float:
    """Return the torque [N m] of an end stop on a joint at `angle` [rad]."""
    return STOP_STIFFNESS * (max(low - angle, 0.0) - max(angle - high, 0.0))


def check_reach(goal_range: float) -> None:
    """Raise `TaskError` if a goal within +-`goal_range` [m] of the base, at GOAL_HEIGHT, is out of reach."""
    drop = BASE[2] - TOOL - GOAL_HEIGHT  # [m], from the shoulder to the wrist
    # The law of cosines for the wrist's distance, at the elbow's end stops.
    far, near = (np.sqrt(UPPER_ARM**2 + FOREARM**2 + 2 * UPPER_ARM * FOREARM * np.cos(angle)) for angle in ELBOW)
    furthest = float(np.sqrt(far**2 - drop**2)) / np.sqrt(2)
    if near > drop or goal_range > furthest:
        raise TaskError(
            f"goal_range: goals up to {goal_range:g} m to each side are out of reach. The arm gets to {furthest:.2f} m."
        )
