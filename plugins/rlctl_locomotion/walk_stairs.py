"""Walk on stairs that the robot does not see: `walk-rough` with steps of 10 cm, up and down."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from rlctl.task import Event, TaskError, events
from rlctl_locomotion.walk_rough import WalkRough

HIGHEST_STEP = 0.15  # [m]; above, the legs are too short
TREAD = 0.3  # [m], from edge to edge
FLIGHT = 5  # steps up; then as many down
PUSH = {"from": (0.0, 0.2), "to": (0.0, 0.5)}  # [m/s], at level 0 and at level 1


@dataclass
class WalkStairs(WalkRough):
    """Follow velocity commands up and down stairs that it does not see, with pushes, noise and delay."""

    step: float = 0.1  # [m], height of a step
    rough: float = 0.0
    episode_s: float = 10.0

    period_s: ClassVar[float] = 0.6
    swing: ClassVar[float] = 0.12
    lowest: ClassVar[np.ndarray] = np.array([-0.4, -0.3, -0.6])
    highest: ClassVar[np.ndarray] = np.array([0.7, 0.3, 0.6])
    cell: ClassVar[float] = 0.05  # [m]; an edge is as steep as two points of the ground are close
    size: ClassVar[tuple[float, float]] = (24.0, 44.0)  # [m]: in an episode at most 11 m are walked
    flat_y: ClassVar[float] = -18.0
    hardest_y: ClassVar[float] = 0.0
    reward_weights = {**WalkRough.reward_weights, "velocity_error": -0.2}
    events = {
        **WalkRough.events,
        "friction": Event("reset", events.set_friction, body="ground", friction=(0.5, 1.3), enabled=True),
        "push": Event("interval", events.kick, every_s=4.0, body="robot", speed=PUSH, enabled=True),
    }

    def draw_heights(self) -> np.ndarray:
        """Return flights of stairs along x, with bumps; raises `TaskError` for steps or bumps that are too high."""
        if not 0 <= self.step <= HIGHEST_STEP:
            raise TaskError(f"step: steps of {self.step:g} m; give a height from 0 to {HIGHEST_STEP:g} m")
        bumps = super().draw_heights()
        tread = np.arange(len(bumps)) // round(TREAD / self.cell) % (2 * FLIGHT)
        return bumps + self.step * np.minimum(tread, 2 * FLIGHT - tread)[:, None]

    def find_roughness(self, y: np.ndarray) -> np.ndarray:
        """Return how high steps are at y: of full height within 6 m of y = 0, as on the other side of it."""
        return (self.flat_y + np.abs(y)) / (self.flat_y + 6.0)
