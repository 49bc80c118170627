"""Choosing actions with NumPy: a policy's network, and noise that follows from the episode's seed and the step."""

from __future__ import annotations

import abc
import dataclasses
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from rlctl.environments.dict_spaces import join, split_space
from rlctl.errors import ArtifactError, DivergedError, UsageError, short_repr
from rlctl.policy.c_policy import LIBRARY_SUFFIX, CPolicy
from rlctl.policy.file import Policy, PolicyInfo, load_policy, read_policy
from rlctl.policy.layers import Array, apply
from rlctl.policy.network import DETERMINISTIC, Network, Tensors, select_actor_tensors

_BLOCK = 64
"""Steps whose random numbers are drawn together."""
_STEP_NOISE, _MATRIX = 0, 1


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
        """Differ from the deterministic actions so from now on."""

    def close(self) -> None:  # noqa: B027
        """Give back what it holds."""

    def report(self) -> dict[str, Any]:
        """Return what there is to say of the episode that ended, as plain data."""
        return {}

    def begin_segment(self, seed: int, step: int) -> None:  # noqa: B027 (most players have nothing to do)
        """Begin to play on at a step of an episode."""

    @property
    def state(self) -> Array | None:
        """Recurrent state that the next step starts from, to be read and written; None if there is none."""
        return None


class PolicyPlayer(Player):
    """Plays a policy whose numbers are in `tensors`, which may change between segments."""

    def __init__(self, info: PolicyInfo, tensors: Tensors) -> None:
        self.exploration = Exploration()
        self._network = Network(info, tensors)
        _, self._space = info.env.spaces()
        self._settings: Mapping[str, Any] = info.policy_kwargs
        self._uses_sde = bool(info.policy_kwargs.get("use_sde"))
        self._algo = info.algo
        self._noise = Noise(max(1, math.prod(self._space.shape or ())))
        self._matrix: Array | None = None
        if isinstance(self._space, spaces.Box):
            self._low, self._high = self._space.low.ravel(), self._space.high.ravel()

    @property
    def state(self) -> Array | None:
        return None if self._network.lstm is None else self._network.lstm.state

    def explore(self, exploration: Exploration) -> None:
        self.exploration = exploration

    def begin_segment(self, seed: int, step: int) -> None:
        self._network.prepare()
        if self._uses_sde and self.exploration.stochastic:
            self._draw_matrix(seed, step)

    def _draw_matrix(self, seed: int, step: int) -> None:
        """Draw gSDE's exploration matrix, shape (latent, actions); with reduced parameters a column serves all."""
        log_std = self._network.log_std
        assert log_std is not None  # gSDE has it as a parameter
        std = _expln(log_std) if self._settings.get("use_expln") else np.exp(log_std)
        size = (log_std.shape[0], len(self._low))
        self._matrix = std * make_generator(seed, _MATRIX, step).standard_normal(size, np.float32)

    def act(self, observation: Any, seed: int, step: int) -> tuple[Any, Any]:
        exploration = self.exploration
        if exploration.warmup:
            return self._act_uniform(*self._noise.draw(seed, step))
        every = exploration.sde_every
        if every and step % every == 0 and self._uses_sde and exploration.stochastic:
            self._draw_matrix(seed, step)
        network = self._network
        latent = network.compute_latent(observation)
        value = apply(network.head, latent)
        if not isinstance(self._space, spaces.Box):
            return self._act_discrete(value, seed, step)
        if exploration.stochastic and self._algo not in DETERMINISTIC:
            value = value + self._sample(latent, seed, step)
        if not math.isfinite(sum(value.tolist())):  # faster than any function of arrays
            raise DivergedError(f"the policy's action is not finite: {short_repr(value.tolist())}")
        if not network.is_squashed:
            action = np.minimum(np.maximum(value, self._low), self._high)  # a third of np.clip's time
            return value, action.astype(self._space.dtype, copy=False).reshape(self._space.shape)
        if network.ends_with_tanh:
            value = np.tanh(value)
        if exploration.action_noise:
            noise = self._noise.draw(seed, step)[0][1]
            value = np.clip(value + np.float32(exploration.action_noise) * noise, -1.0, 1.0)
        return value, self._unscale(value)

    def _sample(self, latent: Array, seed: int, step: int) -> Array:
        if self._uses_sde:
            if self._matrix is None:
                self._draw_matrix(seed, step)
            assert self._matrix is not None
            result: Array = latent.dot(self._matrix)  # half the time of `@`
            return result
        noise: Array = self._network.compute_std(latent) * self._noise.draw(seed, step)[0][0]
        return noise

    def _unscale(self, value: Array) -> Array:
        """Return an action of the environment from one in [-1, 1]."""
        low, high = self._low, self._high
        action: Array = low + np.float32(0.5) * (value + np.float32(1.0)) * (high - low)
        return action.astype(self._space.dtype, copy=False).reshape(self._space.shape or ())

    def _act_uniform(self, normal: Array, uniform: Array) -> tuple[Any, Any]:
        space = self._space
        if isinstance(space, spaces.Box):
            value = (2.0 * uniform[:-1] - 1.0).astype(np.float32)
            return value, self._unscale(value)
        choice = np.floor(uniform[:-1] * _choices(space)).astype(np.int64).reshape(space.shape or ())
        return choice, choice

    def _act_discrete(self, values: Array, seed: int, step: int) -> tuple[Any, Any]:
        exploration, space = self.exploration, self._space
        normal, uniform = (
            self._noise.draw(seed, step) if exploration.stochastic or exploration.epsilon else (None, None)
        )
        if exploration.epsilon and uniform is not None and normal is not None and uniform[-1] < exploration.epsilon:
            return self._act_uniform(normal, uniform)
        sampled = None if uniform is None or self._algo == "dqn" else uniform[:-1]
        choice: Any
        if isinstance(space, spaces.MultiBinary):
            probability = 1.0 / (1.0 + np.exp(-values))
            choice = (probability > 0.5 if sampled is None else sampled < probability).astype(np.int64)
        elif isinstance(space, spaces.MultiDiscrete):
            parts = np.split(values, np.cumsum(space.nvec.ravel())[:-1])
            choice = np.array([_choose(part, sampled, index) for index, part in enumerate(parts)], np.int64)
        else:
            choice = np.int64(_choose(values, sampled, 0))
        choice = choice.reshape(space.shape or ())
        return choice, choice


def _choose(values: Array, uniform: Array | None, index: int) -> int:
    """Return the most likely choice of some logits, or with a uniform number a sample."""
    if uniform is None:
        return int(values.argmax())
    cumulative = np.cumsum(np.exp(values.astype(np.float64) - values.max()))
    found = int(np.searchsorted(cumulative, uniform[index] * cumulative[-1], side="right"))
    return min(found, len(values) - 1)


def _choices(space: spaces.Space[Any]) -> Array:
    if isinstance(space, spaces.Discrete):
        return np.array([space.n])
    if isinstance(space, spaces.MultiDiscrete):
        return space.nvec.ravel()
    return np.full(math.prod(space.shape or ()), 2)


def _expln(log_std: Array) -> Array:
    """Return gSDE's smoother alternative to exp, which grows slower above 0."""
    return np.where(log_std <= 0, np.exp(np.minimum(log_std, 0)), np.log1p(np.maximum(log_std, 0) + 1e-6) + 1.0)


_MEAN, _SAMPLE = Exploration(), Exploration(stochastic=True)


class NumpyPolicy(Policy):
    """A policy file in this process: acts with the same bits as in workers, without torch."""

    def __init__(self, info: PolicyInfo, tensors: Tensors) -> None:
        super().__init__(info)
        self.player = PolicyPlayer(info, tensors)
        self.reset()

    @classmethod
    def load(cls, path: Path) -> NumpyPolicy:
        """Read a policy file; raises `ArtifactError` if it is not one or does not fit together."""
        info, tensors = read_policy(path)
        check_playable(info, tensors, path)
        return cls(info, select_actor_tensors(info, tensors))

    def predict(self, observation: Any, *, deterministic: bool = True) -> NDArray[Any]:
        """Return the action for one observation; `deterministic=False` samples it, otherwise in every episode."""
        self.player.explore(_MEAN if deterministic else _SAMPLE)
        if self._step == 0:
            self.player.begin_segment(self._seed, 0)
        action = self.player.act(join(self.read_observation(observation)), self._seed, self._step)[1]
        self._step += 1
        return np.asarray(action)

    def reset(self) -> None:
        """Begin an episode: forget the recurrent state."""
        self._seed, self._step = int(np.random.SeedSequence().generate_state(1)[0]), 0
        if self.player.state is not None:
            self.player.state[:] = 0.0


def check_playable(info: PolicyInfo, tensors: Tensors, file: Path) -> None:
    """Act once, on a made-up observation; raises `ArtifactError` if the tensors do not fit their description."""
    try:
        shapes = {key: space.shape for key, space in split_space(info.env.spaces()[0]).items()}
        for key in info.normalized_keys:
            for name in (f"normalize/{key}/mean", f"normalize/{key}/var"):
                if tensors[name].shape != shapes[key]:
                    raise ValueError(f"{name} has shape {tensors[name].shape}, the observation {shapes[key]}")
        policy = NumpyPolicy(info, tensors)
        policy.try_once()
        policy.try_once(deterministic=False)
    except UsageError:
        raise
    except Exception as error:  # whatever numpy raises for a description that nobody has checked
        text = short_repr(str(error), 200)
        raise ArtifactError(f"{file}: its tensors do not fit its description: {text}") from None


class ExportedPlayer(Player):
    """Plays an exported policy, an ONNX file or compiled C: its deterministic action."""

    def __init__(self, path: str) -> None:
        self._policy = CPolicy.load(Path(path)) if path.endswith(LIBRARY_SUFFIX) else load_policy(Path(path))

    def act(self, observation: Any, seed: int, step: int) -> tuple[Any, Any]:
        if step == 0:
            self._policy.reset()
        action = self._policy.predict(observation)
        return action, action
