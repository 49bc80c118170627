"""What every player has: an action per step, and noise that depends only on the episode's seed and the step."""

import abc
import dataclasses
from typing import Any

import numpy as np

from rlctl.policy.layers import Array

NOISE_BLOCK = 64
"""Number of steps whose random numbers are drawn together."""
_STEP_NOISE, _MATRIX = 0, 1  # random streams: noise of steps, gSDE's matrices


@dataclasses.dataclass(frozen=True)
class Exploration:
    """How a policy explores; plain data that is sent to workers with each segment."""

    stochastic: bool = False  # sample from the policy's distribution
    warmup: bool = False  # take uniform actions instead of the policy's
    epsilon: float = 0.0  # DQN's probability of a uniform action
    action_noise: float = 0.0
    """Standard deviation of the Gaussian noise of off-policy algorithms, on the action in [-1, 1]."""
    sde_every: int = 0  # steps between gSDE's matrices; 0: a new one for each segment


class Noise:
    """Random numbers of the steps of one episode; they do not depend on which steps were drawn before."""

    def __init__(self, size: int) -> None:
        self._size = size
        self._seed = -1
        self._block = -1
        self._normal: Array = np.zeros(0)
        self._uniform: Array = np.zeros(0)

    def draw(self, seed: int, step: int) -> tuple[Array, Array]:
        """Return standard normal numbers, shape (2, size), and uniform numbers in [0, 1), shape (size + 1,), of a step.

        Steps count from 0.
        """
        block, row = divmod(step, NOISE_BLOCK)
        if block != self._block or seed != self._seed:
            self._seed, self._block = seed, block
            self._normal, self._uniform = draw_noise(seed, block, self._size)
        return self._normal[row], self._uniform[row]


def draw_noise(seed: int, block: int, size: int) -> tuple[Array, Array]:
    """Return the random numbers of a block of steps of an episode.

    Standard normal ones of shape (NOISE_BLOCK, 2, size), and uniform ones in [0, 1) of shape (NOISE_BLOCK, size + 1).
    """
    generator = make_generator(seed, _STEP_NOISE, block)
    normal = generator.standard_normal((NOISE_BLOCK, 2, size), np.float32)
    return normal, generator.random((NOISE_BLOCK, size + 1))


def draw_matrix(std: Array, seed: int, step: int, actions: int) -> Array:
    """Return gSDE's exploration matrix of a step, shape (latent, actions).

    `std` has a column for each action, or one for all: shape (latent, actions) or (latent, 1).
    """
    matrix: Array = std * make_generator(seed, _MATRIX, step).standard_normal((len(std), actions), np.float32)
    return matrix


def make_generator(seed: int, use: int, counter: int) -> np.random.Generator:
    """Return the generator of a step or block (`counter`) of an episode, in the random stream `use`."""
    # A counter-based generator can start anywhere without drawing the numbers before.
    return np.random.Generator(np.random.Philox(key=np.array([seed, use], np.uint64), counter=[0, counter, 0, 0]))


class Player(abc.ABC):
    """Chooses the actions of environments, one at a time."""

    @abc.abstractmethod
    def act(self, observation: Any, seed: int, step: int) -> tuple[Any, Any]:
        """Return the action to store and the action for the environment; `step` counts from 0."""

    def explore(self, exploration: Exploration) -> None:  # noqa: B027 (most players cannot)
        """Use this exploration from now on."""

    def close(self) -> None:  # noqa: B027
        """Release resources such as a connection."""

    def report(self) -> dict[str, Any]:
        """Return plain data about the finished episode, for its result."""
        return {}

    def begin_segment(self, seed: int, step: int) -> None:  # noqa: B027 (most players have nothing to do)
        """Continue at a step of an episode; the policy's weights may have changed."""

    @property
    def state(self) -> Array | None:
        """Recurrent state before the next step, for reading and writing; None if there is none."""
        return None
