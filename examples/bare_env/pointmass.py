"""A point that is pushed to the middle of a square: a whole Gymnasium environment, of which rlctl knows nothing.

rlctl train examples/bare_env/pointmass.py:PointMass
"""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces

DT = 0.1  # [s]
MAX_SPEED = 1.0  # [m/s] per axis
MAX_ACCELERATION = 2.0  # [m/s^2] per axis
MAX_STEPS = 50


class PointMass(gymnasium.Env[np.ndarray, np.ndarray]):
    """A mass on a square of 2 m x 2 m. It succeeds if it is within `tolerance` of the middle when the time is up."""

    def __init__(self, tolerance: float = 0.1) -> None:
        self.tolerance = tolerance  # [m]
        self.action_space = spaces.Box(-1.0, 1.0, (2,), np.float32)  # part of MAX_ACCELERATION
        self.observation_space = spaces.Box(-1.0, 1.0, (4,), np.float32)  # position [m], part of MAX_SPEED

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        super().reset(seed=seed)
        self.position = self.np_random.uniform(-1.0, 1.0, 2)
        self.velocity = np.zeros(2)
        self.steps = 0
        return self._observation(), {}

    def step(self, action: np.ndarray) -> Any:
        if not np.isfinite(action).all():
            raise ValueError(f"action {action}: a policy that diverged must not go unnoticed")
        acceleration = MAX_ACCELERATION * np.clip(action, -1.0, 1.0)
        self.velocity = np.clip(self.velocity + acceleration * DT, -MAX_SPEED, MAX_SPEED)
        self.position = np.clip(self.position + self.velocity * DT, -1.0, 1.0)
        self.steps += 1
        distance = float(np.linalg.norm(self.position))
        # Running out of time is `truncated`: the task itself does not end there.
        truncated = self.steps >= MAX_STEPS
        info = {"is_success": distance < self.tolerance, "distance": distance}
        return self._observation(), -distance, False, truncated, info

    def _observation(self) -> np.ndarray:
        return np.concatenate([self.position, self.velocity / MAX_SPEED]).astype(np.float32)
