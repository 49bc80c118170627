"""Policy files that act with NumPy, in workers and in this process, bit for bit the same. Imports no torch.

The noise of an action depends only on the episode's seed and the step.
"""

import math
from typing import Any

import numpy as np
from gymnasium import spaces

from rlctl.errors import DivergedError, in_world, short_repr
from rlctl.policy.actor import Array, Exploration, Rows, as_stored
from rlctl.policy.file import DETERMINISTIC, PolicyFile
from rlctl.policy.layers import apply, as_row
from rlctl.policy.network import Network
from rlctl.policy.noise import StepNoise, draw_matrix
from rlctl.policy.policy import FileActor


class NumpyActor(FileActor):
    """Acts with a policy whose weights may change between segments, in `count` environments."""

    def __init__(self, policy: PolicyFile, count: int = 1) -> None:
        info = self.info = policy.info
        self.network = Network(policy)
        self._exploration = Exploration()
        self._algo = info.algo
        _, self._space = info.env.spaces()
        self._shape = self._space.shape or ()
        self._is_box = isinstance(self._space, spaces.Box)
        self._is_vector = self._is_box and len(self._shape) == 1 and self._space.dtype == np.float32
        if isinstance(self._space, spaces.Box):
            self._low, self._high = as_row(self._space.low.ravel()), as_row(self._space.high.ravel())
        self._noise = StepNoise(count, max(1, math.prod(self._shape)))
        self._matrices = _Matrices(count) if info.policy_kwargs.get("use_sde") else None
        self._state = None if self.network.lstm is None else self.network.lstm.make_state(count)

    @property
    def state(self) -> Array | None:
        """Hidden and cell states, shape (n, 2, layers, hidden); None without an LSTM."""
        return self._state

    def explore(self, exploration: Exploration) -> None:
        """Use this exploration from the next action on."""
        self._exploration = exploration

    def prepare(self) -> None:
        """Use the present weights; gSDE draws new matrices."""
        self.network.prepare()
        if self._matrices is not None:
            self._matrices.forget()

    def begin(self, rows: Rows) -> None:
        """Forget the recurrent states."""
        if self._state is not None:
            self._state[rows.index] = 0.0

    def act(self, observations: Any, rows: Rows) -> tuple[Array, Array]:
        """Return the actions to store and those for the environments; advances an LSTM's states.

        Raises `DivergedError` for an action that is not finite.
        """
        exploration, network = self._exploration, self.network
        if exploration.warmup:
            return self._act_uniform(self._noise.uniform.draw(rows))
        if self._state is None:
            latent = network.compute_latent(observations)
        else:
            states = self._state[rows.index]
            latent = network.compute_latent(observations, states)
            self._state[rows.index] = states
        value = apply(network.head, latent)
        if not self._is_box:
            return self._act_discrete(value, rows)
        if exploration.stochastic and self._algo not in DETERMINISTIC:
            value = value + self._sample(latent, rows)
        _check_finite(value, rows)
        if not network.is_squashed:
            action = np.minimum(np.maximum(value, self._low), self._high)  # a third of np.clip's time
            return value, self._shape_actions(action)
        if network.ends_with_tanh:
            value = np.tanh(value)
        if exploration.action_noise:
            noise = np.float32(exploration.action_noise) * self._noise.disturb.draw(rows)
            value = np.clip(value + noise, -1.0, 1.0)
        return value, self._unscale(value)

    def _sample(self, latent: Array, rows: Rows) -> Array:
        """Return the noise of the policy's distribution, shape (k, elements)."""
        if self._matrices is None:
            return self.network.compute_std(latent) * self._noise.sample.draw(rows)
        if self.network.std is None:  # of gSDE's parameter
            raise ValueError("log_std is missing")
        period = self._exploration.sde_every
        return self._matrices.multiply(latent, rows, self.network.std, self._low.size, period)

    def _shape_actions(self, values: Array) -> Array:
        if self._is_vector and values.dtype == np.float32:
            return values
        return values.astype(self._space.dtype, copy=False).reshape(len(values), *self._shape)

    def _unscale(self, value: Array) -> Array:
        """Return actions of the environment from those in [-1, 1]."""
        low, high = self._low, self._high
        return self._shape_actions(low + np.float32(0.5) * (value + np.float32(1.0)) * (high - low))

    def _act_uniform(self, uniform: Array) -> tuple[Array, Array]:
        if self._is_box:
            value = (2.0 * uniform[:, :-1] - 1.0).astype(np.float32)
            return value, self._unscale(value)
        choice = np.floor(uniform[:, :-1] * _count_choices(self._space)).astype(np.int64)
        return choice, choice.reshape(len(choice), *self._shape)

    def _act_discrete(self, values: Array, rows: Rows) -> tuple[Array, Array]:
        exploration, space = self._exploration, self._space
        needs_numbers = exploration.stochastic or exploration.epsilon
        uniform = self._noise.uniform.draw(rows) if needs_numbers else None
        sampled = None if uniform is None or self._algo == "dqn" else uniform[:, :-1]
        if isinstance(space, spaces.MultiBinary):
            probability = 1.0 / (1.0 + np.exp(-values))
            choice = (probability > 0.5 if sampled is None else sampled < probability).astype(np.int64)
        elif isinstance(space, spaces.MultiDiscrete):
            parts = np.split(values, np.cumsum(space.nvec.ravel())[:-1], axis=1)
            choice = np.stack([_choose(part, sampled, index) for index, part in enumerate(parts)], axis=1)
        else:
            choice = _choose(values, sampled, 0)
        choice = choice.reshape(len(values), *self._shape)
        if uniform is not None and exploration.epsilon:
            is_uniform = uniform[:, -1] < exploration.epsilon
            choice[is_uniform] = self._act_uniform(uniform[is_uniform])[1]
        return as_stored(choice), choice


class _Matrices:
    """gSDE's exploration matrix of each row."""

    def __init__(self, count: int) -> None:
        self._is_drawn = [False] * count
        self._matrices: Array = np.zeros((count, 0, 0), np.float32)

    def forget(self) -> None:
        """Draw new ones for the next actions."""
        self._is_drawn = [False] * len(self._is_drawn)

    def multiply(self, latent: Array, rows: Rows, std: Array, actions: int, period: int) -> Array:
        """Return the noise of rows, shape (k, actions); each has a new matrix every `period` steps of an episode."""
        if not self._matrices.size:
            self._matrices = np.zeros((len(self._is_drawn), len(std), actions), np.float32)
        for k, row in enumerate(rows.index.tolist()):
            if not self._is_drawn[row] or (period and rows.step[k] % period == 0):
                self._matrices[row] = draw_matrix(std, int(rows.seed[k]), int(rows.step[k]), actions)
                self._is_drawn[row] = True
        if len(latent) == 1:
            one: Array = latent.dot(self._matrices[row])  # the same bits in a third of the time
            return one
        return np.matmul(latent[:, None, :], self._matrices[rows.index])[:, 0]


def _check_finite(values: Array, rows: Rows) -> None:
    """Raise `DivergedError` for the first row that is not finite."""
    total = sum(values[0].tolist()) if len(values) == 1 else values.sum()  # Python is faster with few numbers
    if math.isfinite(total):
        return
    # The sum of finite numbers may overflow.
    for k in np.flatnonzero(~np.isfinite(values).all(axis=1)).tolist():
        with in_world(int(rows.index[k])):
            raise DivergedError(f"the policy's action is not finite: {short_repr(values[k].tolist())}")


def _choose(values: Array, uniform: Array | None, index: int) -> Array:
    """Return the choices with the largest logits or, for uniform numbers, sampled ones; shape (k,)."""
    if uniform is None:
        return values.argmax(axis=1)
    cumulative = np.cumsum(np.exp(values.astype(np.float64) - values.max(axis=1, keepdims=True)), axis=1)
    below = cumulative <= uniform[:, index, None] * cumulative[:, -1:]
    choice: Array = np.minimum(below.sum(axis=1), values.shape[1] - 1)
    return choice


def _count_choices(space: spaces.Space[Any]) -> Array:
    if isinstance(space, spaces.Discrete):
        return np.array([space.n])
    if isinstance(space, spaces.MultiDiscrete):
        return space.nvec.ravel()
    return np.full(math.prod(space.shape or ()), 2)
