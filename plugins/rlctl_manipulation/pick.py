"""Pick: an arm with a gripper lifts a block from the table to a goal in the air, in many worlds at once."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from rlctl.task import BatchTask, Box, Camera, CommandTerm, Event, Joints, Sim, WorldRngs, events, rewards, terms
from rlctl.task.rotations import from_axis, rotate

MODELS = Path(__file__).with_name("models")
JOINTS = [*(f"joint{number}" for number in range(1, 8)), "left_finger"]  # that an action moves
RIGHT = 7  # the right finger's target is the left one's
HOME = np.array([0.0, 0.2, 0.0, -2.0, 0.0, 2.2, 0.785])  # [rad]; the hand points down, 0.25 m above the table
OPEN = 0.04  # [m], of each finger
MAX_TORQUE = [87.0, 87.0, 87.0, 87.0, 12.0, 12.0, 12.0, 20.0, 20.0]  # [N m], of the data sheet; fingers [N]
STIFFNESS = [1000.0, 1000.0, 750.0, 750.0, 300.0, 300.0, 300.0, 1000.0, 1000.0]  # [N m/rad], fingers [N/m]
DAMPING = [60.0, 60.0, 40.0, 40.0, 15.0, 15.0, 15.0, 30.0, 30.0]  # [N m s/rad], fingers [N s/m]
ARMATURE = [0.1] * 7 + [0.2, 0.2]  # [kg m^2], fingers [kg]: inertia of motors and gears
STEP = np.array([0.05] * 7 + [0.016])  # [rad] of the arm's joints, [m] of a finger, at action 1
GRASP = "grasp"  # a frame between the fingers' tips; z points away from the hand, y from finger to finger
BLOCK = np.array([0.02, 0.02, 0.025])  # [m], half of its sides
BLOCK_LOW, BLOCK_HIGH = np.array([0.4, -0.2]), np.array([0.65, 0.2])  # [m], x and y of where it starts
TURN = 0.7  # [rad], of the block at the start, to each side
SQUEEZED = 0.003  # [m], by which the fingers' target is beyond the block that they hold
LIFTED = 0.05  # [m], above the table


@dataclass
class Pick(BatchTask):
    """Lift the block to the goal and hold it there."""

    tolerance: float = 0.03  # [m], of the block's middle from the goal
    hold_s: float = 0.4  # [s], for which it has been there at the end of an episode that succeeds
    start_noise: float = 0.1  # [rad], of every joint of the arm, to each side of the home position
    episode_s: float = 4.0

    goal: np.ndarray = field(init=False, repr=False)  # [m]
    target: np.ndarray = field(init=False, repr=False)  # [rad] of the arm's joints and [m] of a finger
    held: np.ndarray = field(init=False, repr=False)  # steps for which the block has been at the goal
    last_action: np.ndarray = field(init=False, repr=False)
    action_change: np.ndarray = field(init=False, repr=False)

    goal_low: ClassVar[np.ndarray] = np.array([0.4, -0.2, 0.12])  # [m], of the box that goals are drawn from
    goal_high: ClassVar[np.ndarray] = np.array([0.65, 0.2, 0.35])  # [m]

    robot = "Arm of seven joints with a gripper"
    control_dt, substeps, solver_iterations = 0.04, 5, 4  # [s], -, -
    action_space = Box(-1.0, 1.0, (8,), np.float32)
    action_meaning = "steps of the joints' targets, 1 is 0.05 rad, and of the fingers', 1 is 16 mm"
    observation_units = {
        "joint_positions": "rad, the finger m",
        "joint_velocities": "rad/s",
        "target": "rad, the finger m",
        "grasp": "m",
        "to_block": "m",
        "to_goal": "m",
        "block": "m",
        "goal": "m",
    }
    observation_terms = {
        "to_block": terms.Displacement("block", "grasp"),
        "to_goal": terms.Displacement("goal", "grasp"),
    }
    cameras = {  # a student of `rlctl distill` may observe their pictures
        "camera": Camera(eye=(1.2, 0.0, 0.65), target=(0.5, 0.0, 0.08), field_of_view=40.0),
        "wrist_camera": Camera(
            eye=(0.08, 0.0, 0.0),
            target=(0.0, 0.0, 0.12),
            up=(-1.0, 0.0, 0.0),
            body="arm",
            link="hand",
            field_of_view=75.0,
        ),
    }
    reward_weights = {
        "approach": 0.1,
        "grasp": 0.2,
        "lift": 0.2,
        "carry": 0.4,
        "done": 0.6,
        "action": -0.01,
        "smoothness": -0.01,
    }
    per_world = {"goal": (3,), "target": (8,), "held": (), "last_action": (8,), "action_change": (8,)}
    events = {  # with `randomize: true`
        "mass": Event("reset", events.scale_mass, body="block", factor=(0.5, 1.5)),
        "friction": Event("reset", events.set_friction, body="block", friction=(0.6, 1.2)),
        "motor_strength": Event("reset", events.scale_motor_strength, body="arm", factor=(0.8, 1.0)),
        "position_noise": Event("observation", events.noise, of="joint_positions", std=(0.0, 0.001)),  # [rad], [m]
        "velocity_noise": Event("observation", events.noise, of="joint_velocities", std=(0.0, 0.05)),  # [rad/s]
        "block_noise": Event("observation", events.noise, of="to_block", std=(0.0, 0.003)),  # [m], of a camera
        "observation_delay": Event("observation", events.delay, steps=(0, 1)),  # of 40 ms
        "action_delay": Event("action", events.delay, steps=(0, 1)),
        # Of appearance, for cameras.
        "block_color": Event("reset", events.set_color, body="block", red=(0.6, 1), green=(0, 0.5), blue=(0, 0.4)),
        "arm_color": Event("reset", events.set_color, body="arm", red=(0.2, 1), green=(0.2, 1), blue=(0.2, 1)),
        "table_color": Event("reset", events.set_color, body="table", red=(0.3, 1), green=(0.3, 1), blue=(0.3, 1)),
        "light": Event("reset", events.set_light, brightness=(0.6, 1.3), azimuth=(-180, 180), elevation=(35, 90)),
        "camera_pose": Event("reset", events.move_camera, camera="camera", shift=(-0.02, 0.02), turn=(-2, 2)),
        "wrist_camera_pose": Event(
            "reset", events.move_camera, camera="wrist_camera", shift=(-0.005, 0.005), turn=(-2, 2)
        ),
        "distractors": Event(
            "reset",
            events.set_distractors,
            count=(0, 4),
            center=(0.52, 0.0, 0.0),
            distance=(0.3, 0.6),
            size=(0.015, 0.05),
        ),
    }
    rlctl_ignore = {
        "RL611": "a grasp takes a second of good steering; tests/manipulation has one by a script",
        "RL701": "episodes begin with open fingers, which cannot open further",
    }

    def build(self, sim: Sim) -> None:
        """Load the table, whose top is the ground, the arm and the block."""
        sim.load("table", "plane.urdf", fixed=True)
        self.arm = sim.load("arm", MODELS / "arm_gripper.xml")
        self.arm.set_drives(STIFFNESS, DAMPING, armature=ARMATURE)
        self.block = sim.load("block", MODELS / "block.xml")
        joints = self.arm.find_joints(JOINTS)
        self.low, self.high = self.arm.joint_low[joints], self.arm.joint_high[joints]

    def reset(self, rng: WorldRngs, worlds: np.ndarray) -> None:
        """Start above the table with open fingers, the block somewhere on it."""
        self.goal[worlds] = rng.uniform(self.goal_low, self.goal_high)
        joints = HOME + rng.uniform(-self.start_noise, self.start_noise, 7)
        finger = np.full(len(worlds), OPEN)
        self.target[worlds] = np.column_stack([joints, finger])
        self.arm.set_joints(np.column_stack([joints, finger, finger]), worlds=worlds)
        x, y, yaw = rng.uniform([*BLOCK_LOW, -TURN], [*BLOCK_HIGH, TURN]).T
        place = np.column_stack([x, y, np.full_like(x, BLOCK[2])])
        self.block.set_base(place, from_axis((0, 0, 1), yaw), worlds=worlds)

    def act(self, action: np.ndarray) -> None:
        """Move the targets of the joints by a step."""
        self.target = np.clip(self.target + STEP * action, self.low, self.high)
        self.arm.drive_to(self.target[:, [*range(8), RIGHT]], max_force=MAX_TORQUE)
        self.action_change = action - self.last_action
        self.last_action = action.astype(float)

    def measure(self) -> None:
        """Compute what rewards and success share, once per step."""
        grasp = self.arm.link_position(GRASP)
        self.block_position = self.block.base_position
        self.near = rewards.distance(self.block_position, grasp)  # [m]
        self.down = np.maximum(-self.look(0.0, 0.0, 1.0)[:, 2], 0.0)  # 1 where the hand points down
        squeezed = (self.arm.joint_positions[:, RIGHT:] - self.target[:, RIGHT:]).min(axis=1)  # [m]
        self.grasped = (self.near < 0.03) & (squeezed > SQUEEZED)
        self.distance = rewards.distance(self.block_position, self.goal)
        self.lifted = np.clip((self.block_position[:, 2] - BLOCK[2]) / LIFTED, 0.0, 1.0)
        self.arrived = self.grasped & (self.distance < self.tolerance)

    def look(self, *axis: float) -> np.ndarray:
        """Return the direction of an axis of the grasp frame, shape (worlds, 3)."""
        return rotate(self.arm.link_orientation(GRASP), axis)

    def is_done(self) -> np.ndarray:
        """Return where the block is as it shall be, shape (worlds,)."""
        return self.arrived

    def observe(self) -> dict[str, Any]:
        """Return the joints, the gripper's pose, and where the block and the goal are, seen from it."""
        grasp, block = self.arm.link_position(GRASP), self.block.base_position
        turn = self.block.base_orientation
        return {
            "joint_positions": self.arm.joint_positions[:, : RIGHT + 1],
            "joint_velocities": self.arm.joint_velocities[:, :RIGHT],
            "target": self.target,
            "grasp": grasp,
            "approach": self.look(0.0, 0.0, 1.0),
            "closing": self.look(0.0, 1.0, 0.0),
            "to_block": (block, grasp),
            "block_side": rotate(turn, (0.0, 1.0, 0.0)),
            "block_up": rotate(turn, (0.0, 0.0, 1.0)),
            "to_goal": (self.goal, grasp),
        }

    def is_terminated(self) -> np.ndarray:
        """Never: a block that fell can be grasped again."""
        self.measure()
        self.held = np.where(self.is_done(), self.held + 1, 0)
        return np.zeros(self.worlds, bool)

    def rewards(self, action: np.ndarray) -> dict[str, np.ndarray]:
        """Return how far the block is on its way, in stages of which each is worth more than those before."""
        lift = np.where(self.arrived, 1.0, self.grasped * self.lifted)
        approach = (1.0 - np.tanh(5.0 * self.near)) * (0.5 + 0.5 * self.down)
        return {
            "approach": np.where(self.arrived, 1.0, approach),
            "grasp": (self.grasped | self.arrived).astype(float),
            "lift": lift,
            "carry": lift * (1.0 - np.tanh(5.0 * self.distance)),
            "done": (self.held > 0).astype(float),
            "action": rewards.squared(action),
            "smoothness": rewards.squared(self.action_change),
        }

    def is_success(self) -> np.ndarray:
        """The block has been at the goal for `hold_s`."""
        return self.held * self.control_dt >= self.hold_s

    def markers(self) -> dict[str, np.ndarray]:
        """The goal."""
        return {"goal": self.goal}

    def commands(self) -> dict[str, CommandTerm]:
        """Return the positions of the goals."""
        rows = zip("xyz", self.goal.T, self.goal_low.tolist(), self.goal_high.tolist(), strict=True)
        return {f"goal_{axis}": CommandTerm(values, low, high, "m") for axis, values, low, high in rows}

    def set_commands(self, values: Mapping[str, np.ndarray]) -> None:
        """Move the goals."""
        for name, value in values.items():
            self.goal[:, "xyz".index(name[-1])] = value

    def describe_joints(self) -> Joints:
        """Return the arm's and the left finger's. Actions are steps of their targets."""
        return self.arm.describe_joints(
            JOINTS,
            default_positions=[*HOME.tolist(), OPEN],
            action_step=STEP.tolist(),
            measured="target",
            clips_target=True,
            max_torque=MAX_TORQUE[: RIGHT + 1],
        )
