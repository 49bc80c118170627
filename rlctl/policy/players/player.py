"""What every player has: an action per step, and noise that depends only on the episode's seed and the step."""

import abc
import dataclasses
from typing import Any

import numpy as np

from rlctl.policy.layers import Array

_BLOCK = 64  # number of steps whose random numbers are drawn together
_STEP_NOISE = 0  # random stream of the noise of steps


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
        block, row = divmod(step, _BLOCK)
        if block != self._block or seed != self._seed:
            self._seed, self._block = seed, block
            generator = make_generator(seed, _STEP_NOISE, block)
            self._normal = generator.standard_normal((_BLOCK, 2, self._size), np.float32)
            self._uniform = generator.random((_BLOCK, self._size + 1))
        return self._normal[row], self._uniform[row]


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
