"""A block on the floor, which pushes move; loaded by path in workers."""

from dataclasses import dataclass

import gymnasium
import numpy as np

from rlctl.task import Box, Event, Sim, Task, events


@dataclass
class Block(Task):
    """Stay within `limit` of the start; actions do nothing."""

    limit: float = 0.1  # [m]

    control_dt, substeps, episode_s = 0.05, 8, 1.0  # [s], -, [s]
    action_space = Box(-1.0, 1.0, (1,), np.float32)
    reward_weights = {"distance": -1.0}
    events = {
        "mass": Event("reset", events.scale_mass, body="block", factor=(0.8, 1.2)),
        "friction": Event("reset", events.set_friction, body="floor", friction=(0.3, 1.5)),
        "push": Event("interval", events.push, every_s=0.3, body="block", force=(0.0, 1.0)),
    }

    def build(self, sim: Sim) -> None:
        """Load floor and block, with a friction of 0.5 between them."""
        self.floor = sim.load("floor", "plane.urdf", fixed=True)
        self.block = sim.load("block", "cube_small.urdf", position=(0.0, 0.0, 0.026))
        self.floor.set_friction(0.5)
        self.block.set_friction(1.0)

    def act(self, action: np.ndarray) -> None:
        """Do nothing."""

    def observe(self) -> dict[str, np.ndarray]:
        """Where the block is."""
        return {"position": self.block.base_position}

    def rewards(self, action: np.ndarray) -> dict[str, float]:
        """How far away it is."""
        return {"distance": self.distance()}

    def distance(self) -> float:
        """From the start [m]."""
        return float(np.linalg.norm(self.block.base_position[:2]))

    def is_success(self) -> bool:
        """It is near the start."""
        return self.distance() < self.limit


class Lost(Block):
    """Ends when the block is too far away, and reports no success."""

    is_success = Task.is_success

    def is_terminated(self) -> bool:
        """It is too far away."""
        return self.distance() >= self.limit


@dataclass
class Brittle(Block):
    """Its numbers are not finite above a stiffness, nor its world loadable below 0."""

    stiffness: float = 1.0

    def build(self, sim: Sim) -> None:
        """Load the world."""
        if self.stiffness < 0:
            raise ValueError("negative stiffness")
        super().build(sim)

    def distance(self) -> float:
        """As the block's, or infinite."""
        return float("inf") if self.stiffness > 2 else super().distance()


class Chain(gymnasium.Env):
    """A plain environment with parameters of several kinds."""

    def __init__(self, typed: int = 3, untyped=2, real: float = 1) -> None:
        self.links = list(range(typed))
