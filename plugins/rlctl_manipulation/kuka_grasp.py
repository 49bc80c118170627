"""Kuka grasp: steer a hand that descends by itself so that it closes on a block and lifts it from a tray.

The task of PyBullet's `KukaBulletEnv`, whose closing and lifting, 1,100 physics steps inside one call of `step`, are
control steps of their own here: the policy sees them, but only the descent is steered.
"""

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from rlctl.task import Box, Event, Sim, Task, TaskError, events, rewards

MODELS = Path(__file__).with_name("models")
# Seven joints of the arm, then the gripper's: turn, left finger, left tip, right finger, right tip. [rad]
START = [0.0064, 0.4132, -0.0114, -1.5893, 0.0054, 1.1377, -0.0065, 0.0, -0.3, 0.0, 0.3, 0.0]
ARM = [f"J{number}" for number in range(7)]
WRIST = ["gripper_to_arm"]
FINGERS = ["base_left_finger_joint", "left_base_tip_joint", "base_right_finger_joint", "right_base_tip_joint"]
# [N m], those of the file. The original's 200 are too few in MuJoCo, whose motors overshoot at their limit: with an
# outstretched arm a descent takes 190 to 210.
ARM_FORCE = [300.0] * 7
FINGER_FORCE = [2.0, 2.0, 2.5, 2.0]  # [N m], as the original has them
TIPS = {"left_finger_tip", "right_finger_tip"}
HAND = "lbr_iiwa_link_7"
GRIPPER = "base_link"
DOWN = (0.0, 1.0, 0.0, 0.0)  # quaternion: the hand's z axis points to the floor

BASE = (-0.1, 0.0, 0.07)  # [m], of the arm
TRAY = (0.64, 0.075, -0.19)
HAND_START = np.array([0.537, 0.0, 0.5])  # [m]
HAND_LOW, HAND_HIGH = np.array([0.50, -0.17]), np.array([0.65, 0.22])  # [m], x and y that the hand is kept in
BLOCK_X, BLOCK_Y = (0.48, 0.69), (-0.20, 0.25)  # [m], where fingers at the edge of that still get hold of a block
STEP = np.array([0.005, 0.005])  # [m], of the hand at action 1
TURN = 0.05  # [rad], of the gripper at action 1
DESCENT, LIFT = 0.002, 0.004  # [m], per control step; the original lifts 1 mm in each of its steps of 1/240 s
OPEN = 0.3  # [rad], of each finger
CLOSING_STEPS = 25
# Height of the gripper at which the descent ends [m]. Open fingers are 14 mm above the tray's floor then, and swing
# 12 mm lower when they close. The original measures the distance to the tray: there a wall near a finger counts too.
GRASP_HEIGHT = 0.055
TOP = 0.5  # [m], where the lift of the hand ends
BLOCK_REST = -0.175  # [m], height of the block's middle in the tray
ALIGNED = 0.02  # [m]; so far from the block's middle, alignment is worth 1/e
LIFTED = 0.1  # [m], above its rest
HOLD_S = 0.5  # [s]


@dataclass
class KukaGrasp(Task):
    """Lift the block out of the tray and hold it for half a second."""

    observe_height: bool = False
    """Also observe the block's height, how far the fingers are open, and whether the hand still descends: the
    original hides them, so that a policy cannot tell a grasp from a miss."""
    block_x: tuple[float, float] = (0.55, 0.67)  # [m], where the block starts
    block_y: tuple[float, float] = (0.0, 0.2)  # [m]
    episode_s: float = 6.0  # [s]: 3 of descent, 0.4 of closing, 2 of lifting

    robot = "KUKA LBR iiwa with a two-finger gripper"
    control_dt, substeps, solver_iterations = 4 / 240, 4, 150  # [s], -, -
    action_space = Box(-1.0, 1.0, (3,), np.float32)
    action_meaning = "the hand's way in x and y, 1 is 5 mm, and the gripper's turn, 1 is 0.05 rad; while it descends"
    observation_units = {"gripper": "m", "gripper_attitude": "rad", "block_in_gripper": "m", "block_yaw": "rad"}
    # The original's, at the end of an episode: reward_weights {original: 1} and 0 for the others.
    reward_weights = {
        "distance": -5.0,
        "misaligned": -0.5,
        "aligned": 0.5,
        "grasp": 0.5,
        "lift": 1.0,
        "held": 1.0,
        "action": -0.01,
        "smoothness": -0.05,  # without it the hand trembled, ten times a second
        "original": 0.0,
    }
    events = {  # with `randomize: true`
        "mass": Event("reset", events.scale_mass, body="block", factor=(0.8, 1.2)),
        "arm_mass": Event("reset", events.scale_mass, body="arm", factor=(0.8, 1.2)),
        "friction": Event("reset", events.set_friction, body="block", friction=(0.3, 1.5)),
        "tray_friction": Event("reset", events.set_friction, body="tray", friction=(0.3, 1.5)),
        "gravity": Event("reset", events.shift_gravity, change=(-0.5, 0.5)),  # [m/s^2]
        "joint_damping": Event("reset", events.set_joint_damping, body="arm", joints=ARM, damping=(0.0, 0.5)),
        "color": Event("reset", events.set_color, body="block", red=(0, 1), green=(0, 1), blue=(0, 1)),
        "start": Event("start", events.offset_joints, body="arm", joints=ARM, position=(-0.02, 0.02)),  # [rad]
        "block_noise": Event("observation", events.noise, of="block_in_gripper", std=(0.0, 0.003)),  # [m]
        "yaw_noise": Event("observation", events.noise, of="block_yaw", std=(0.0, 0.03)),  # [rad]
        "observation_delay": Event("observation", events.delay, steps=(0, 2)),  # of 17 ms
        "action_noise": Event("action", events.noise, std=(0.0, 0.05)),
        "action_delay": Event("action", events.delay, steps=(0, 2)),
        "push": Event("interval", events.push, every_s=2.0, body="block", force=(0.0, 0.1), duration_s=(0.1, 0.1)),
    }
    rlctl_ignore = {"RL611": "a grasp takes three seconds of good steering; tests/manipulation has one by a script"}

    def build(self, sim: Sim) -> None:
        """Load the arm, the tray and the block."""
        for name, drawn, (low, high) in (("block_x", self.block_x, BLOCK_X), ("block_y", self.block_y, BLOCK_Y)):
            if not low <= drawn[0] <= drawn[1] <= high:
                raise TaskError(
                    f"{name}: {drawn[0]:g} to {drawn[1]:g} m is out of the hand's reach. Stay between {low:g} and "
                    f"{high:g}, the lower value first."
                )
        sim.set_gravity(10.0)
        self.arm = sim.load("arm", MODELS / "kuka_gripper.urdf", position=BASE, fixed=True)
        self.arm.cap_joint_speed(10.0)  # [rad/s]
        self.tray = sim.load("tray", MODELS / "tray.urdf", position=TRAY, orientation=(0, 0, 1, 0), fixed=True)
        self.block = sim.load("block", MODELS / "long_block.urdf")
        self.all_joints = np.array(START)
        self.finger_joints = self.arm.find_joints(FINGERS)
        self.arm.set_joints(self.all_joints)
        self.all_joints[:7] = self.arm.solve_inverse_kinematics(HAND, HAND_START, DOWN)[:7]

    def reset(self, rng: np.random.Generator) -> None:
        """Start above the tray, the block somewhere in it."""
        self.arm.set_joints(self.all_joints)
        x, y = rng.uniform(*self.block_x), rng.uniform(*self.block_y)
        yaw = math.pi / 2 + rng.uniform(0.0, math.pi)
        self.block.set_base((x, y, -0.15), (0.0, 0.0, math.sin(yaw / 2), math.cos(yaw / 2)))
        self.target, self.turn, self.opening = HAND_START.copy(), 0.0, OPEN
        self.descending, self.held_steps, self.steps = True, 0, 0
        self.last_action = self.action_change = np.zeros(3, np.float32)
        self.update()

    def act(self, action: np.ndarray) -> None:
        """Move the hand by the action and down; once it is at the tray, close the gripper, then lift."""
        self.steps += 1
        self.action_change, self.last_action = action - self.last_action, action
        self.descending = self.descending and self.gripper[2] > GRASP_HEIGHT
        if self.descending:
            self.target[:2] = np.clip(self.target[:2] + STEP * action[:2], HAND_LOW, HAND_HIGH)
            self.target[2] -= DESCENT
            self.turn += TURN * float(action[2])
        elif self.opening > 0:
            self.opening = max(0.0, self.opening - OPEN / CLOSING_STEPS)
        else:
            self.target[2] = min(self.target[2] + LIFT, TOP)
        joints = self.arm.solve_inverse_kinematics(HAND, self.target, DOWN)[:7]
        self.arm.drive_to(joints, max_speed=[10.0] * 7, max_force=ARM_FORCE, gain=0.3, joints=ARM)
        self.arm.drive_to(np.array([self.turn]), max_speed=[10.0], max_force=[200.0], joints=WRIST)
        fingers = np.array([-self.opening, 0.0, self.opening, 0.0])
        self.arm.drive_to(fingers, max_speed=[10.0] * 4, max_force=FINGER_FORCE, joints=FINGERS)

    def update(self) -> None:
        """Read what rewards and observations share, once per step."""
        self.gripper = self.arm.link_position(GRIPPER)
        self.gripper_attitude = angles_from_down(self.arm.link_orientation(GRIPPER))
        block = self.block.mass_state(self.block.base_name)
        # The gripper points down: its x axis is turned by yaw, its y axis is mirrored.
        yaw = self.gripper_yaw()
        (x, y), (sin, cos) = np.array(block.position[:2]) - self.gripper[:2], (math.sin(yaw), math.cos(yaw))
        self.block_in_gripper = np.array([cos * x + sin * y, sin * x - cos * y])
        self.block_yaw = wrap(block.roll_pitch_yaw[2] - yaw)
        self.block_height = block.position[2]

    def gripper_yaw(self) -> float:
        """Direction of the line between the fingers [rad], from the world's x axis."""
        x, y, z, w = self.arm.link_orientation(GRIPPER).tolist()
        return math.atan2(2 * (x * y + w * z), 1 - 2 * (y * y + z * z))

    def observe(self) -> dict[str, np.ndarray]:
        """Return the gripper's pose, and where the block is, seen from it."""
        seen = {
            "gripper": self.gripper,
            "gripper_attitude": self.gripper_attitude,
            "block_in_gripper": self.block_in_gripper,
            "block_yaw": np.array([self.block_yaw]),
        }
        if self.observe_height:
            seen["block_height"] = np.array([self.block_height])
            seen["fingers"] = self.arm.joint_positions[self.finger_joints]
            seen["descending"] = np.array([float(self.descending)])
        return seen

    def rewards(self, action: np.ndarray) -> dict[str, float]:
        """Return how well the gripper is placed, and what became of the block."""
        self.update()
        grasped = self.is_grasped()
        distance, misaligned = float(np.hypot(*self.block_in_gripper)), math.cos(self.block_yaw) ** 2
        height = self.block_height - BLOCK_REST
        self.held_steps = self.held_steps + 1 if grasped and height > LIFTED else 0
        return {
            "distance": distance,
            "misaligned": misaligned,  # 0 where the fingers close on the block's narrow side
            "aligned": rewards.closeness(distance, ALIGNED) * (1 - misaligned),
            "grasp": float(grasped),
            "lift": min(max(height, 0.0), LIFTED) / LIFTED if grasped else 0.0,
            "held": float(self.is_success()),
            "action": rewards.squared(action),
            "smoothness": rewards.squared(self.action_change),
            "original": self.original_reward(),
        }

    def original_reward(self) -> float:
        """Return what KukaBulletEnv pays at the end: -10 per metre from hand to block, 10,000 for one above 0.2 m."""
        if self.steps < self.max_steps:
            return 0.0
        return -10.0 * self.arm.distance_to(self.block, HAND) + 10_000.0 * (self.block_height > 0.2)

    def is_grasped(self) -> bool:
        """Both finger tips touch the block."""
        return self.arm.links_touching(self.block) >= TIPS

    def is_success(self) -> bool:
        """The block has been held above the tray for half a second."""
        return self.held_steps * self.control_dt >= HOLD_S


def angles_from_down(orientation: np.ndarray) -> np.ndarray:
    """Return by what roll, pitch and yaw [rad], shape (3,), a quaternion is turned from DOWN, in world axes.

    The Euler angles of the orientation itself, which KukaBulletEnv observes, are of no use: of a hand that points down
    the roll is pi or -pi at random, and so is the yaw that it starts with.
    """
    x, y, z, w = orientation.tolist()
    x, y, z, w = z, -w, -x, y  # times the inverse of DOWN
    return np.array(
        [
            math.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y)),
            math.asin(min(max(2 * (w * y - z * x), -1.0), 1.0)),
            math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)),
        ]
    )


def wrap(angle: float) -> float:
    """Return an angle [rad] in (-pi, pi]."""
    return math.pi - (math.pi - angle) % (2 * math.pi)
