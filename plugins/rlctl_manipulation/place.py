"""Place: the arm of pick.py carries a block to a goal on the table and lets go of it, in many worlds at once."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from rlctl.task import CommandTerm, WorldRngs, rewards
from rlctl_manipulation.pick import BLOCK, LIFTED, RIGHT, Pick

NEAREST = 0.1  # [m], from the block's start to the goal
FREE = 0.005  # [m], between each finger and a block that is released
RESTING = 0.05  # [m/s], speed of a block at rest


@dataclass
class Place(Pick):
    """Set the block down at the goal on the table and let go of it."""

    goal_low: ClassVar[np.ndarray] = np.array([0.4, -0.2, BLOCK[2]])  # [m], of the area that goals are drawn from
    goal_high: ClassVar[np.ndarray] = np.array([0.65, 0.2, BLOCK[2]])  # [m]

    def reset(self, rng: WorldRngs, worlds: np.ndarray) -> None:
        """Start as `Pick` does; a goal that is near the block moves by half of the area, around its edges."""
        super().reset(rng, worlds)
        goal, size = self.goal[worlds], self.goal_high - self.goal_low
        moved = self.goal_low + np.fmod(goal - self.goal_low + size / 2, np.maximum(size, 1e-9))
        near = rewards.distance(goal, self.block.base_position[worlds]) < NEAREST
        self.goal[worlds] = np.where(near[:, None], moved, goal)

    reward_weights = {**Pick.reward_weights, "lower": 0.3, "release": 0.3}

    def measure(self) -> None:
        """Compute what rewards and success share, once per step."""
        super().measure()
        x, y, height = (self.block_position - self.goal).T
        self.distance, self.height = np.hypot(x, y), np.maximum(height, 0.0)  # [m], along the table and above it
        self.above = self.distance < self.tolerance
        # How high it has to be carried falls to 0 where it may be set down.
        clearance = np.clip(self.distance - self.tolerance, 0.0, LIFTED)
        self.lifted = np.clip((self.height + 0.001) / (clearance + 0.001), 0.0, 1.0)
        self.arrived = self.above & (self.height < 0.01)
        gap = self.arm.joint_positions[:, RIGHT:].min(axis=1) - BLOCK[1]  # [m]
        self.released = np.clip(gap / FREE, 0.0, 1.0)

    def is_done(self) -> np.ndarray:
        """Return where the block rests at the goal, free of the fingers."""
        resting = np.linalg.norm(self.block.base_velocity, axis=1) < RESTING
        return self.arrived & (self.released == 1.0) & resting

    def rewards(self, action: np.ndarray) -> dict[str, np.ndarray]:
        """Return the stages of `Pick`, and between `carry` and `done` how low the block is and how open the fingers."""
        lower = self.above & (self.grasped | self.arrived)
        return {
            **super().rewards(action),
            "lower": lower * (1.0 - np.tanh(10.0 * self.height)),
            "release": self.arrived * self.released,
        }

    def commands(self) -> dict[str, CommandTerm]:
        """Return the positions of the goals on the table."""
        return {name: term for name, term in super().commands().items() if name != "goal_z"}
