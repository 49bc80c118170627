"""A policy's actor in numpy, one observation at a time: fast enough to act inside a worker, and without torch.

The layers are read from the names of the policy file's tensors, which are those of SB3's `state_dict`. Arrays are used
where they lie: if they are in shared memory, new numbers written there act from the next step on.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from rlctl.dict_spaces import split_space
from rlctl.errors import UsageError
from rlctl.run.policy import PolicyInfo

Array = NDArray[Any]
Layer = Callable[[Array], Array]
Tensors = Mapping[str, Array]

NORMALIZE_EPSILON = 1e-8
"""What SB3's VecNormalize adds to the variance."""
_BATCH_RENORM_EPSILON = 1e-3
_SQUASHED_GAUSSIAN = ("sac", "tqc", "crossq")
_DETERMINISTIC = ("td3", "ddpg")
_RELU_BY_DEFAULT = (*_SQUASHED_GAUSSIAN, *_DETERMINISTIC, "dqn")


def select_actor_tensors(info: PolicyInfo, tensors: Tensors) -> dict[str, Array]:
    """Return the tensors of a policy file that acting needs: the actor's and the normalisation's."""
    prefixes = ["normalize/", *(f"policy/{prefix}" for prefix in _prefixes(info.algo))]
    return {name: value for name, value in tensors.items() if name.startswith(tuple(prefixes))}


def _prefixes(algo: str) -> tuple[str, ...]:
    if algo in (*_SQUASHED_GAUSSIAN, *_DETERMINISTIC):
        return ("actor.",)
    if algo == "dqn":
        return ("q_net.",)
    return ("pi_features_extractor.", "mlp_extractor.policy_net.", "action_net.", "log_std", "lstm_actor.")


class NumpyNetwork:
    """The network that acts: from one raw observation to the parameters of the action's distribution.

    Raises `UsageError` for a layer that numpy cannot play.
    """

    def __init__(self, info: PolicyInfo, tensors: Tensors) -> None:
        self.info = info
        observation_space, _ = info.env.spaces()
        get = _Tensors(info, tensors)
        shared = "pi_features_extractor" if info.algo in ("ppo", "a2c", "recurrent_ppo") else ""
        extractor = shared or ("q_net.features_extractor" if info.algo == "dqn" else "actor.features_extractor")
        self._parts = [
            (key, _feature_layers(get, key, space, f"{extractor}.extractors.{key}" if key else extractor))
            for key, space in split_space(observation_space).items()
        ]
        self.lstm = _Lstm(get, "lstm_actor") if info.algo == "recurrent_ppo" else None
        self._trunk, self._head = _actor_layers(info.algo, get)
        self.log_std: Array | None = None
        """Parameter of PPO's and gSDE's noise; None where there is none, or a layer computes it."""
        self._log_std_layers: list[Layer] = []
        name = "actor.log_std" if info.algo in _SQUASHED_GAUSSIAN else "log_std"
        if name in get:
            self.log_std = get[name]
        elif f"{name}.weight" in get:
            self._log_std_layers = [get.linear(name)]

    def features(self, observation: Any) -> Array:
        """Return the features of a raw observation, shape (features,)."""
        parts = self._parts
        if len(parts) == 1 and parts[0][0] == "":
            return _apply(parts[0][1], observation)
        return np.concatenate([_apply(layers, observation[key]) for key, layers in parts])

    def latent(self, observation: Any) -> Array:
        """Return what the last layer starts from; a recurrent network goes one step on."""
        value = self.features(observation)
        if self.lstm is not None:
            value = self.lstm.step(value)
        return _apply(self._trunk, value)

    def head(self, latent: Array) -> Array:
        """Return mean, logits, values or action, as the algorithm has it."""
        return _apply(self._head, latent)

    def compute_log_std(self, latent: Array) -> Array:
        """Return the logarithm of the standard deviation: of a layer, or the parameter."""
        if self._log_std_layers:
            return np.clip(_apply(self._log_std_layers, latent), -20.0, 2.0)
        assert self.log_std is not None  # only Gaussian heads ask
        return self.log_std


def _actor_layers(algo: str, get: _Tensors) -> tuple[list[Layer], list[Layer]]:
    if algo in _SQUASHED_GAUSSIAN:
        mean = "actor.mu" if "actor.mu.weight" in get else "actor.mu.0"  # with gSDE the mean is clipped after it
        head: list[Layer] = [get.linear(mean)]
        if mean == "actor.mu.0":
            limit = float(get.info.policy_kwargs.get("clip_mean", 2.0))
            head.append(lambda value: np.clip(value, -limit, limit))
        return get.sequence("actor.latent_pi", end=get.activation), head
    if algo in _DETERMINISTIC:
        return [], get.sequence("actor.mu", end=np.tanh)
    if algo == "dqn":
        return [], get.sequence("q_net.q_net")
    return get.sequence("mlp_extractor.policy_net", end=get.activation), [get.linear("action_net")]


def _apply(layers: Iterable[Layer], value: Any) -> Array:
    for layer in layers:
        value = layer(value)
    result: Array = value
    return result


class _Tensors:
    """Makes layers of the tensors of a policy file."""

    def __init__(self, info: PolicyInfo, tensors: Tensors) -> None:
        self.info = info
        self._tensors = tensors
        name = info.policy_kwargs.get("activation_fn", "relu" if info.algo in _RELU_BY_DEFAULT else "tanh")
        if name not in _ACTIVATIONS:
            raise UsageError(f"a network with activation {name!r} cannot be played; known: {', '.join(_ACTIVATIONS)}")
        self.activation = _ACTIVATIONS[name]

    def __contains__(self, name: str) -> bool:
        return f"policy/{name}" in self._tensors

    def __getitem__(self, name: str) -> Array:
        return self._tensors[f"policy/{name}"]

    def statistics(self, key: str) -> tuple[Array, Array]:
        """Return mean and variance of a normalised observation."""
        return self._tensors[f"normalize/{key}/mean"], self._tensors[f"normalize/{key}/var"]

    def linear(self, name: str) -> Layer:
        weight, bias = self[f"{name}.weight"], self[f"{name}.bias"]

        def apply(value: Array) -> Array:
            result: Array = weight.dot(value)
            result += bias
            return result

        return apply

    def sequence(self, prefix: str, end: Layer | None = None, activation: Layer | None = None) -> list[Layer]:
        """Return the layers of a `torch.nn.Sequential`; `end` follows its last linear layer.

        Layers without tensors have no names: between two that have some there is an activation.
        """
        pattern = re.compile(rf"policy/{re.escape(prefix)}\.(\d+)\.")
        indices = sorted({int(found[1]) for name in self._tensors if (found := pattern.match(name))})
        layers: list[Layer] = []
        before = -1
        for index in indices:
            if index > before + 1:
                layers.append(activation or self.activation)
            layers.append(self._layer(f"{prefix}.{index}"))
            before = index
        if end is not None and indices and f"{prefix}.{indices[-1]}.weight" in self:
            layers.append(end)
        return layers

    def _layer(self, name: str) -> Layer:
        if f"{name}.ra_mean" in self:
            return self._batch_renorm(name)
        dimensions = self[f"{name}.weight"].ndim if f"{name}.weight" in self else 0
        if dimensions == 2:
            return self.linear(name)
        if dimensions == 4:
            return self._convolution(name)
        raise UsageError(f"layer {name} of this network cannot be played: neither linear, convolution nor batch renorm")

    def _batch_renorm(self, name: str) -> Layer:
        mean, variance = self[f"{name}.ra_mean"], self[f"{name}.ra_var"]
        scale, bias = self[f"{name}.scale"], self[f"{name}.bias"]
        epsilon = np.float32(self.info.policy_kwargs.get("batch_norm_eps", _BATCH_RENORM_EPSILON))
        return lambda value: scale * ((value - mean) / np.sqrt(variance + epsilon)) + bias

    def _convolution(self, name: str) -> Layer:
        weight, bias = self[f"{name}.weight"], self[f"{name}.bias"]
        count, channels, height, width = weight.shape
        stride = _NATURE_STRIDES[name.rpartition(".")[2]]

        def apply(value: Array) -> Array:
            windows = np.lib.stride_tricks.sliding_window_view(value, (height, width), axis=(1, 2))
            windows = windows[:, ::stride, ::stride]
            rows, columns = windows.shape[1:3]
            patches = windows.transpose(0, 3, 4, 1, 2).reshape(channels * height * width, rows * columns)
            result: Array = (weight.reshape(count, -1) @ patches + bias[:, None]).reshape(count, rows, columns)
            return result

        return apply


_NATURE_STRIDES = {"0": 4, "2": 2, "4": 1}
"""Strides of the convolutions of SB3's NatureCNN, the only one here, by their index."""


def _feature_layers(get: _Tensors, key: str, space: spaces.Space[Any], extractor: str) -> list[Layer]:
    """Return the layers from a raw observation to its features: normalised, one-hot, convolved or flat."""
    layers: list[Layer] = []
    if isinstance(space, spaces.Discrete | spaces.MultiDiscrete):
        return [_one_hot(space)]
    if key in get.info.normalized_keys:
        layers.append(_normalize(get, key))
    if not _is_image(space):
        return [*layers, _flatten]
    shape = space.shape or ()
    if min(range(3), key=lambda axis: shape[axis]) != 0:  # channels last, as SB3 decides
        layers.append(lambda value: np.asarray(value).transpose(2, 0, 1))
    layers.append(lambda value: np.asarray(value, np.float32) / np.float32(255.0))
    relu = _ACTIVATIONS["relu"]
    convolutions = get.sequence(f"{extractor}.cnn", end=relu, activation=relu)
    linear = get.sequence(f"{extractor}.linear", end=relu, activation=relu)
    return [*layers, *convolutions, _flatten, *linear]


def _normalize(get: _Tensors, key: str) -> Layer:
    mean, variance = get.statistics(key)
    clip = float(get.info.clip_observation or np.inf)

    def apply(value: Array) -> Array:
        # In float64 as VecNormalize: an element that hardly varies is multiplied by up to 10,000.
        normalized: Array = (value - mean) / np.sqrt(variance + NORMALIZE_EPSILON)
        np.minimum(normalized, clip, out=normalized)
        np.maximum(normalized, -clip, out=normalized)
        return normalized.astype(np.float32)

    return apply


def _one_hot(space: spaces.Discrete | spaces.MultiDiscrete) -> Layer:
    sizes = np.atleast_1d(np.asarray(space.n if isinstance(space, spaces.Discrete) else space.nvec)).ravel()
    offsets = np.concatenate([[0], np.cumsum(sizes)[:-1]])
    total = int(sizes.sum())

    def apply(value: Any) -> Array:
        result = np.zeros(total, np.float32)
        result[offsets + np.ravel(value)] = 1.0
        return result

    return apply


def _flatten(value: Any) -> Array:
    return np.asarray(value, np.float32).ravel()


def _is_image(space: spaces.Space[Any]) -> bool:
    """Return whether SB3 takes a space for an image."""
    if not isinstance(space, spaces.Box) or space.dtype != np.uint8 or len(space.shape) != 3:
        return False
    return bool((space.low == 0).all() and (space.high == 255).all())


class _Lstm:
    """The layers of an LSTM, and their state: hidden and cell, shape (2, layers, hidden)."""

    def __init__(self, get: _Tensors, name: str) -> None:
        self._layers: list[tuple[list[Array], list[Array]]] = []
        while f"{name}.weight_ih_l{len(self._layers)}" in get:
            number = len(self._layers)
            weights = [get[f"{name}.{kind}_l{number}"] for kind in ("weight_ih", "weight_hh")]
            names = [f"{name}.{kind}_l{number}" for kind in ("bias_ih", "bias_hh")]
            biases = [get[each] for each in names if each in get]
            self._layers.append((weights, biases))
        hidden = self._layers[0][0][1].shape[1]
        if f"{name}.weight_ih_l0_reverse" in get or f"{name}.weight_hr_l0" in get:
            raise UsageError("an LSTM with two directions or a projection cannot be played")
        self.state = np.zeros((2, len(self._layers), hidden), np.float32)

    def step(self, value: Array) -> Array:
        """Return the output of the last layer, shape (hidden,); the state goes one step on."""
        state = self.state
        for number, ((of_input, of_hidden), biases) in enumerate(self._layers):
            gates = of_input.dot(value) + of_hidden.dot(state[0, number])
            for bias in biases:
                gates += bias
            i, f, g, o = np.split(gates, 4)
            state[1, number] = _sigmoid(f) * state[1, number] + _sigmoid(i) * np.tanh(g)
            value = state[0, number] = _sigmoid(o) * np.tanh(state[1, number])
        return value


def _sigmoid(value: Array) -> Array:
    result: Array = np.float32(0.5) * (np.tanh(np.float32(0.5) * value) + np.float32(1.0))
    return result


def _elu(value: Array) -> Array:
    return np.where(value > 0, value, np.expm1(np.minimum(value, 0)))


def _gelu(value: Array) -> Array:
    from scipy.special import erf  # few networks need it

    result: Array = np.float32(0.5) * value * (np.float32(1.0) + erf(value / np.float32(np.sqrt(2.0))))
    return result


_ACTIVATIONS: dict[str, Layer] = {
    "tanh": np.tanh,
    "relu": lambda value: np.maximum(value, np.float32(0.0)),
    "elu": _elu,
    "leaky_relu": lambda value: np.where(value > 0, value, np.float32(0.01) * value),
    "silu": lambda value: value * _sigmoid(value),
    "gelu": _gelu,
}
