"""What chooses actions: one interface for networks, files, functions, remote programs and recordings."""

import abc
import dataclasses
from collections.abc import Callable
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from rlctl.environments.dict_spaces import map_parts, take_row
from rlctl.errors import in_world

Array = NDArray[Any]


@dataclasses.dataclass(frozen=True)
class Exploration:
    """How a policy explores; plain data that is sent to workers with each segment."""

    stochastic: bool = False  # sample from the policy's distribution
    warmup: bool = False  # take uniform actions instead of the policy's
    epsilon: float = 0.0  # DQN's probability of a uniform action
    action_noise: float = 0.0
    """Standard deviation of the Gaussian noise of off-policy algorithms, on the action in [-1, 1]."""
    sde_every: int = 0  # steps between gSDE's matrices; 0: a new one for each segment


@dataclasses.dataclass(slots=True)
class Rows:
    """The k environments that act: where they are among those of an actor, and where each is in its episode."""

    index: NDArray[np.int64]  # shape (k,); the row of each in the actor, from 0
    seed: NDArray[np.int64]  # shape (k,); the seed of its episode
    step: NDArray[np.int64]  # shape (k,); the number of steps of its episode so far

    @classmethod
    def one(cls, seed: int = 0, step: int = 0, index: int = 0) -> Self:
        """Return a single row."""
        return cls(np.array([index], np.int64), np.array([seed], np.int64), np.array([step], np.int64))

    @classmethod
    def first(cls, count: int) -> Self:
        """Return the first `count` rows, at the begin of episodes with seed 0."""
        return cls(np.arange(count), np.zeros(count, np.int64), np.zeros(count, np.int64))

    def select(self, chosen: Any) -> "Rows":
        """Return some of the rows; `chosen` is an index of NumPy."""
        return Rows(self.index[chosen], self.seed[chosen], self.step[chosen])

    def __len__(self) -> int:
        return len(self.index)


class Actor(abc.ABC):
    """Chooses the actions of a fixed number of environments, its rows; any of them may act at a time.

    An action depends on the row's observations since `begin`, on the seed and on the step: never on the other rows.
    """

    @abc.abstractmethod
    def act(self, observations: Any, rows: Rows) -> tuple[Array, Array]:
        """Return the actions to store, shape (k, elements), and those for the environments, shape (k, ...).

        `observations` are an array of shape (k, ...), or a dict of such arrays by key.
        """

    def prepare(self) -> None:  # noqa: B027 (most actors have nothing to do)
        """Begin a segment: the weights may have changed since the last one."""

    def explore(self, exploration: Exploration) -> None:  # noqa: B027 (most actors cannot)
        """Explore this way from now on."""

    def begin(self, rows: Rows) -> None:  # noqa: B027
        """Begin episodes in these rows: forget everything about the last ones."""

    def report(self, row: int) -> dict[str, Any]:
        """Return plain data about the episode of a row that has just ended, for its result."""
        return {}

    @property
    def state(self) -> Array | None:
        """Recurrent states before the next step, shape (n, 2, layers, hidden), for reading and writing; or None."""
        return None

    def close(self) -> None:  # noqa: B027
        """Release resources such as a connection."""


ActOne = Callable[[Any, int, int, int], Any]
"""Returns an action for an observation, a row, a seed and a step."""


def act_one_by_one(observations: Any, rows: Rows, act: ActOne) -> tuple[Array, Array]:
    """Return what `Actor.act` does, with a function that acts on one row; errors know the row, see `in_world`."""
    actions = []
    places = zip(rows.index.tolist(), rows.seed.tolist(), rows.step.tolist(), strict=True)
    for k, (row, seed, step) in enumerate(places):
        with in_world(row):
            actions.append(act(take_row(observations, k), row, seed, step))
    return as_stored(stacked := np.stack(actions)), stacked


def as_stored(actions: Array) -> Array:
    """Return actions of environments, shape (k, ...), in the shape of those that are stored, (k, elements)."""
    return actions.reshape(len(actions), -1)


def as_rows(observation: Any) -> Any:
    """Return one observation as a batch of one row."""
    return map_parts(lambda part: np.asarray(part)[None], observation)
