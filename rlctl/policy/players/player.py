"""What every player has: one action after the other, and noise that follows from the episode's seed and the step."""

from __future__ import annotations

import abc
import dataclasses
from typing import Any

import numpy as np

from rlctl.policy.layers import Array

_BLOCK = 64
"""Steps whose random numbers are drawn together."""
_STEP_NOISE = 0
"""Use of random numbers: the steps' noise."""


@dataclasses.dataclass(frozen=True)
class Exploration:
    """How actions differ from the deterministic ones; plain data, sent to workers with each segment."""

    stochastic: bool = False
    """Sample from the policy's distribution."""
    warmup: bool = False
    """Ignore the policy: uniform actions."""
    epsilon: float = 0.0
    """Probability of a uniform action, of DQN."""
    action_noise: float = 0.0
    """Standard deviation of Gaussian noise on the scaled action, of off-policy algorithms."""
    sde_every: int = 0
    """Steps after which gSDE draws a matrix again; 0: only where a segment begins."""


class Noise:
    """Random numbers of the steps of one episode; those of a step do not depend on which steps came before."""

    def __init__(self, size: int) -> None:
        self._size = size
        self._seed = -1
        self._block = -1
        self._normal: Array = np.zeros(0)
        self._uniform: Array = np.zeros(0)

    def draw(self, seed: int, step: int) -> tuple[Array, Array]:
        """Return standard normal and uniform numbers in [0, 1) of a step, from 0: shapes (2, size) and (size + 1,)."""
        block, row = divmod(step, _BLOCK)
        if block != self._block or seed != self._seed:
            self._seed, self._block = seed, block
            generator = make_generator(seed, _STEP_NOISE, block)
            self._normal = generator.standard_normal((_BLOCK, 2, self._size), np.float32)
            self._uniform = generator.random((_BLOCK, self._size + 1))
        return self._normal[row], self._uniform[row]


def make_generator(seed: int, use: int, counter: int) -> np.random.Generator:
    """Return the generator of a step of the episode of a seed, for one use of random numbers."""
    # A counter-based generator begins anywhere without drawing what comes before.
    return np.random.Generator(np.random.Philox(key=np.array([seed, use], np.uint64), counter=[0, counter, 0, 0]))


class Player(abc.ABC):
    """Chooses the actions of one environment after the other."""

    @abc.abstractmethod
    def act(self, observation: Any, seed: int, step: int) -> tuple[Any, Any]:
        """Return the action that is stored and the one that the environment takes, for a step of an episode, from 0."""

    def explore(self, exploration: Exploration) -> None:  # noqa: B027 (most players cannot)
        """Explore this way from now on."""

    def close(self) -> None:  # noqa: B027
        """Release what it holds, such as a connection."""

    def report(self) -> dict[str, Any]:
        """Return plain data about the episode that ended, for its result."""
        return {}

    def begin_segment(self, seed: int, step: int) -> None:  # noqa: B027 (most players have nothing to do)
        """Continue at a step of an episode; the policy's numbers may have changed."""

    @property
    def state(self) -> Array | None:
        """Recurrent state that the next step starts from, to be read and written; None if there is none."""
        return None
