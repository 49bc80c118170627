"""Policy files that act with NumPy, in workers and in this process, bit for bit the same. Imports no torch.

The noise of an action depends only on the episode's seed and the step.
"""

import math
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from rlctl.environments.dict_spaces import join, split_space
from rlctl.errors import ArtifactError, DivergedError, UsageError, short_repr
from rlctl.policy.file import DETERMINISTIC, PolicyFile
from rlctl.policy.layers import Array, apply
from rlctl.policy.network import Network
from rlctl.policy.players.player import Exploration, Noise, Player, draw_matrix
from rlctl.policy.policy import Policy

_MEAN, _SAMPLE = Exploration(), Exploration(stochastic=True)


class PolicyPlayer(Player):
    """Plays a policy whose weights may change between segments."""

    def __init__(self, policy: PolicyFile) -> None:
        info = policy.info
        self.exploration = Exploration()
        self._network = Network(policy)
        _, self._space = info.env.spaces()
        self._uses_sde = bool(info.policy_kwargs.get("use_sde"))
        self._algo = info.algo
        self._noise = Noise(max(1, math.prod(self._space.shape or ())))
        self._matrix: Array | None = None
        if isinstance(self._space, spaces.Box):
            self._low, self._high = self._space.low.ravel(), self._space.high.ravel()

    @property
    def state(self) -> Array | None:
        """Hidden and cell state, shape (2, layers, hidden); None without an LSTM."""
        return None if self._network.lstm is None else self._network.lstm.state

    def explore(self, exploration: Exploration) -> None:
        """Use this exploration from the next action on."""
        self.exploration = exploration

    def begin_segment(self, seed: int, step: int) -> None:
        """Use the present weights; gSDE draws its matrix for this step."""
        self._network.prepare()
        if self._uses_sde and self.exploration.stochastic:
            self._draw_matrix(seed, step)

    def _draw_matrix(self, seed: int, step: int) -> None:
        assert self._network.std is not None  # of gSDE's parameter
        self._matrix = draw_matrix(self._network.std, seed, step, len(self._low))

    def act(self, observation: Any, seed: int, step: int) -> tuple[Any, Any]:
        """Return the action to store, shape (elements,), and the action for the environment; advances an LSTM's state.

        Raises `DivergedError` for an action that is not finite.
        """
        exploration = self.exploration
        if exploration.warmup:
            return self._act_uniform(self._noise.draw(seed, step)[1])
        period = exploration.sde_every
        if period and step % period == 0 and self._uses_sde and exploration.stochastic:
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
            return latent.dot(self._matrix)  # half the time of `@`
        return self._network.compute_std(latent) * self._noise.draw(seed, step)[0][0]

    def _unscale(self, value: Array) -> Array:
        """Return an action of the environment from one in [-1, 1]."""
        low, high = self._low, self._high
        action: Array = low + np.float32(0.5) * (value + np.float32(1.0)) * (high - low)
        return action.astype(self._space.dtype, copy=False).reshape(self._space.shape or ())

    def _act_uniform(self, uniform: Array) -> tuple[Any, Any]:
        space = self._space
        if isinstance(space, spaces.Box):
            value = (2.0 * uniform[:-1] - 1.0).astype(np.float32)
            return value, self._unscale(value)
        choice = np.floor(uniform[:-1] * _count_choices(space)).astype(np.int64).reshape(space.shape or ())
        return choice, choice

    def _act_discrete(self, values: Array, seed: int, step: int) -> tuple[Any, Any]:
        exploration, space = self.exploration, self._space
        uniform = self._noise.draw(seed, step)[1] if exploration.stochastic or exploration.epsilon else None
        if uniform is not None and uniform[-1] < exploration.epsilon:
            return self._act_uniform(uniform)
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
    """Return the choice with the largest logit or, for uniform numbers, a sampled one."""
    if uniform is None:
        return int(values.argmax())
    cumulative = np.cumsum(np.exp(values.astype(np.float64) - values.max()))
    return min(int(np.searchsorted(cumulative, uniform[index] * cumulative[-1], side="right")), len(values) - 1)


def _count_choices(space: spaces.Space[Any]) -> Array:
    if isinstance(space, spaces.Discrete):
        return np.array([space.n])
    if isinstance(space, spaces.MultiDiscrete):
        return space.nvec.ravel()
    return np.full(math.prod(space.shape or ()), 2)


class NumpyPolicy(Policy):
    """A policy file that acts in this process, bit for bit as in workers."""

    def __init__(self, policy: PolicyFile) -> None:
        super().__init__(policy.info)
        self.player = PolicyPlayer(policy)
        self.reset()

    def predict(self, observation: Any, *, deterministic: bool = True) -> NDArray[Any]:
        """Return the action for one observation; `deterministic=False` samples it, with new noise in every episode."""
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


def check_playable(policy: PolicyFile) -> PolicyFile:
    """Act once on an observation of zeros, and return the policy.

    Raises `ArtifactError` if the tensors do not fit their description.
    """
    info, tensors = policy.info, policy.tensors
    try:
        shapes = {key: space.shape for key, space in split_space(info.env.spaces()[0]).items()}
        for key in info.normalized_keys:
            for name in (f"normalize/{key}/mean", f"normalize/{key}/var"):
                if tensors[name].shape != shapes[key]:
                    raise ValueError(f"{name} has shape {tensors[name].shape}, the observation {shapes[key]}")
        player = NumpyPolicy(policy)
        player.try_once()
        player.try_once(deterministic=False)
    except UsageError:
        raise
    except Exception as error:  # any exception from NumPy: the description is unchecked until here
        text = short_repr(str(error), 200)
        raise ArtifactError(f"{policy.path}: its tensors do not fit its description: {text}") from None
    return policy


def load_policy(path: Path) -> Policy:
    """Load a `.safetensors` or an exported `.onnx` file, without torch; raises `ArtifactError` if it is not one."""
    if path.suffix == ".onnx":
        from rlctl.policy.onnx_policy import OnnxPolicy

        return OnnxPolicy.load(path)
    return NumpyPolicy(check_playable(PolicyFile.read(path)).actor_only())
