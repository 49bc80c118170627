"""Place: the arm of pick.py carries a block to a goal on the table and lets go of it, in many worlds at once."""

from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np

from rlctl.task import CommandTerm, WorldRngs, rewards, terms
from rlctl.task.rotations import from_axis
from rlctl_manipulation.pick import BLOCK, LIFTED, RIGHT, TURN, Pick

NEAREST = 0.1  # [m], from the block's start to the goal
FREE = 0.005  # [m], between each finger and a block that is released
RESTING = 0.05  # [m/s], speed of a block at rest
LOW = 0.01  # [m], above the table: a block that falls from there stays where it is
CLOSE_UP = 0.05  # [m], from the goal, where the block is seen at a larger scale

# Starts of levels below 1.
FROM_HOME = 0.5  # part of the episodes of level 0 that begin as those of level 1
WHOLE_WAY = 0.3  # level from which starts are on the whole way; at level 0 all are at the goal
CARRY_HEIGHT = 0.1  # [m], above the table, of a block in the hand at the far end of its way

# The arm seen from its side, with joints 3 and 5 at 0. [m]
SHOULDER = 0.333  # height
UPPER, FOREARM = np.array([0.0825, 0.316]), np.array([-0.0825, 0.384])  # forwards and up, where joints 2 and 4 are at 0
WRIST_AHEAD, WRIST_UP = -0.088, 0.207  # of the wrist, from the grasp frame of a hand that points down


@dataclass
class Place(Pick):
    """Set the block down at the goal on the table and let go of it."""

    carried: np.ndarray = field(init=False, repr=False)  # 1 where the block has been lifted

    goal_low: ClassVar[np.ndarray] = np.array([0.4, -0.2, BLOCK[2]])  # [m], of the area that goals are drawn from
    goal_high: ClassVar[np.ndarray] = np.array([0.65, 0.2, BLOCK[2]])  # [m]
    reward_weights = {
        **Pick.reward_weights,
        "approach": 1.0,
        "grasp": 0.5,
        "lift": 0.3,
        "lower": 0.3,
        "release": 0.3,
    }
    per_world = {**Pick.per_world, "carried": ()}
    observation_units = {**Pick.observation_units, "left": "m"}
    observation_terms = {
        **Pick.observation_terms,
        # Normalised, 1 cm of the whole area is hardly anything.
        "close_up": terms.Scaled("left", scale=(1 / CLOSE_UP,), clip=(-1.0, 1.0)),
    }

    def reset(self, rng: WorldRngs, worlds: np.ndarray) -> None:
        """Start as `Pick` does; a goal that is near the block moves by half of the area, around its edges.

        At level 0 every second episode begins with the block in the hand, at the goal. At higher levels fewer do, from
        level 0.3 on anywhere on the way to the goal.
        """
        super().reset(rng, worlds)
        goal, size = self.goal[worlds], self.goal_high - self.goal_low
        moved = self.goal_low + np.fmod(goal - self.goal_low + size / 2, np.maximum(size, 1e-9))
        near = rewards.distance(goal, self.block.base_position[worlds]) < NEAREST
        self.goal[worlds] = np.where(near[:, None], moved, goal)
        luck, share, yaw = rng.uniform((0.0, 0.0, -TURN), (1.0, 1.0, TURN)).T
        level = self.level[worlds]
        share *= np.minimum(level / WHOLE_WAY, 1.0)
        held = luck >= FROM_HOME + (1.0 - FROM_HOME) * level
        if held.any():
            self.begin_in_hand(worlds[held], share[held], yaw[held])

    def begin_in_hand(self, worlds: np.ndarray, share: np.ndarray, yaw: np.ndarray) -> None:
        """Close the hand about the block at a `share` of the straight way from the goal back to above its start.

        Both are turned by `yaw` [rad]; each of shape (k,).
        """
        goal = self.goal[worlds]
        start = self.block.base_position[worlds] + (0.0, 0.0, CARRY_HEIGHT)
        point = goal + share[:, None] * (start - goal)
        joints, finger = point_down(point, yaw), np.full(len(worlds), BLOCK[1])
        self.arm.set_joints(np.column_stack([joints, finger, finger]), worlds=worlds)
        self.target[worlds] = np.column_stack([joints, np.zeros_like(finger)])
        self.block.set_base(point, from_axis((0, 0, 1), yaw), worlds=worlds)
        self.carried[worlds] = 1.0

    def measure(self) -> None:
        """Compute what rewards and success share, once per step."""
        super().measure()
        x, y, height = (self.block_position - self.goal).T
        self.carried = np.where(self.grasped & (height > LIFTED), 1.0, self.carried)
        self.distance, self.height = np.hypot(x, y), np.maximum(height, 0.0)  # [m], along the table and above it
        self.above = self.distance < self.tolerance
        # How high it has to be carried falls to 0 where it may be set down.
        clearance = np.clip(self.distance - self.tolerance, 0.0, LIFTED)
        self.lifted = np.clip((self.height + 0.001) / (clearance + 0.001), 0.0, 1.0)
        self.arrived = self.above & (self.height < LOW) & (self.carried > 0)
        gap = self.arm.joint_positions[:, RIGHT:].min(axis=1) - BLOCK[1]  # [m]
        self.released = gap > FREE

    def observe(self) -> dict[str, Any]:
        """Return what `Pick` does, and how far the block is from the goal, at a larger scale."""
        return {**super().observe(), "close_up": self.goal - self.block.base_position}

    def is_done(self) -> np.ndarray:
        """Return where the block rests at the goal, free of the fingers."""
        resting = np.linalg.norm(self.block.base_velocity, axis=1) < RESTING
        return self.arrived & self.released & resting

    def rewards(self, action: np.ndarray) -> dict[str, np.ndarray]:
        """Return the stages of `Pick`, and between `carry` and `done` how low the block is and how open the fingers."""
        lower = self.above & (self.grasped | self.arrived)
        # The action is paid too: where it closes the fingers as hard as it can, their targets do not change with it.
        opening = 0.5 * np.clip(self.target[:, RIGHT] / (BLOCK[1] + FREE), 0.0, 1.0) + 0.25 * (1.0 + action[:, RIGHT])
        return {
            **super().rewards(action),
            "lower": lower * (1.0 - np.tanh(10.0 * self.height)),
            "release": self.arrived * opening,
        }

    def commands(self) -> dict[str, CommandTerm]:
        """Return the positions of the goals on the table."""
        return {name: term for name, term in super().commands().items() if name != "goal_z"}


def point_down(points: np.ndarray, yaw: np.ndarray) -> np.ndarray:
    """Return joint positions [rad], shape (k, 7), at which the grasp frame is at `points` [m] and the hand points down.

    `yaw` [rad], shape (k,), turns the hand about the vertical; at 0 its fingers close along y.
    """
    x, y, z = points.T
    ahead, up = np.hypot(x, y) + WRIST_AHEAD, z + WRIST_UP - SHOULDER
    upper, forearm = np.hypot(*UPPER), np.hypot(*FOREARM)
    bend = np.arccos((ahead**2 + up**2 - upper**2 - forearm**2) / (2 * upper * forearm))
    lean = np.arctan2(ahead, up) - np.arctan2(forearm * np.sin(bend), upper + forearm * np.cos(bend))
    turn = np.arctan2(y, x)
    shoulder = lean - np.arctan2(*UPPER)
    elbow = shoulder - (lean + bend - np.arctan2(*FOREARM))
    none = np.zeros(len(points))
    return np.column_stack([turn, shoulder, none, elbow, none, shoulder - elbow, np.pi / 4 + turn - yaw])
