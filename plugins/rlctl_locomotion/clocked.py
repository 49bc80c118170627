"""Clocked: a robot that walks as it is commanded, and steps in time with a clock that it observes."""

from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from rlctl.task import WorldRngs
from rlctl_locomotion.walk import Walk

LEAST_SWING = 0.01  # [m]; a foot that is lower near the top of its swing has missed its step


@dataclass
class Clocked(Walk):
    """What tasks share in which a clock says which feet swing: one half of them, then the others."""

    must_step: bool = (
        True  # ends the episode at a missed step; standing is easier, and nothing else makes it lift a foot
    )

    phase: np.ndarray = field(init=False, repr=False)  # its sine and cosine

    period_s: ClassVar[float]  # [s], of two steps
    swing: ClassVar[float]  # [m], how high a foot is lifted
    first_half: ClassVar[tuple[float, ...]]  # 1 for each foot that swings while the sine is above 0, -1 for the others

    observation_units = {**Walk.observation_units, "phase": "sine and cosine"}
    per_world = {**Walk.per_world, "phase": (2,)}
    mirror = {**Walk.mirror, "phase": (-1, -2)}

    def reset(self, rng: WorldRngs, worlds: np.ndarray) -> None:
        """Stand, with a commanded velocity, about to lift either half of the feet."""
        super().reset(rng, worlds)
        self.phase[worlds, 1] = np.sign(rng.uniform(-1.0, 1.0))

    def act(self, action: np.ndarray) -> None:
        """Set the joints' target angles; the clock runs on."""
        super().act(action)
        turn = 2 * np.pi * self.control_dt / self.period_s
        sine, cosine = self.phase.T
        self.phase = np.stack(
            [sine * np.cos(turn) + cosine * np.sin(turn), cosine * np.cos(turn) - sine * np.sin(turn)], -1
        )

    def measure(self) -> None:
        """Compute what rewards, success and the end share, once per step."""
        super().measure()
        self.foot_heights = self.measure_feet()
        self.wanted = self.swing * np.maximum(self.phase[:, :1] * self.first_half, 0.0)  # [m], of the feet
        if self.must_step:
            missed = (self.wanted > 0.9 * self.swing) & (self.foot_heights < LEAST_SWING)
            self.fallen |= missed.any(axis=1)

    def measure_feet(self) -> np.ndarray:
        """Return the heights of the soles above the ground [m], shape (worlds, feet)."""
        raise NotImplementedError

    def observe_command(self) -> dict[str, np.ndarray]:
        """Return the commanded velocities, and the clock's phase."""
        return {**super().observe_command(), "phase": self.phase}

    def rewards(self, action: np.ndarray) -> dict[str, np.ndarray]:
        """Return how well command and clock are followed, and how calmly."""
        missing = np.abs(self.foot_heights - self.wanted).mean(axis=1)
        return {**super().rewards(action), "gait": 1.0 - missing / self.swing}
