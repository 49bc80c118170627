"""The network of an actor, read from a policy file: from raw observations to the parameters of the actions.

The tensors have the names of SB3's `state_dict`; the layers are derived from these names.
"""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Any

import numpy as np
from gymnasium import spaces

from rlctl.environments.dict_spaces import is_image, split_space
from rlctl.errors import UsageError
from rlctl.policy import layers
from rlctl.policy.file import ACTOR_CRITIC, DETERMINISTIC, GRAPH, SQUASHED_GAUSSIAN, PolicyFile
from rlctl.policy.layers import Activation, Array, Layer, Linear, apply, as_row

if TYPE_CHECKING:
    from rlctl.policy.onnx_policy import OwnGraph

_BATCH_RENORM_EPSILON = 1e-3
_RELU_BY_DEFAULT = (*ACTOR_CRITIC, "dqn")
_NATURE_STRIDES = {"0": 4, "2": 2, "4": 1}
"""Strides of the convolutions of SB3's NatureCNN by their index. No other CNN is supported."""


class Network:
    """The layers of an actor: features of each part of the observation, an LSTM if it has one, trunk and head.

    Raises `UsageError` for an unsupported layer.
    """

    def __init__(self, policy: PolicyFile) -> None:
        info = policy.info
        algo, read = info.algo, _Reader(policy)
        owner = "q_net." if algo == "dqn" else "pi_"
        if algo in ACTOR_CRITIC:
            owner = "actor."
        extractor = f"{owner}features_extractor"
        self.own = read.own_graph()
        """A user's own network. It replaces `parts`, and without an LSTM also `trunk`; None for SB3's networks."""
        self.parts = {
            key: read.features(key, space, f"{extractor}.extractors.{key}" if key else extractor)
            for key, space in split_space(info.env.spaces()[0]).items()
            if self.own is None
        }
        """Layers from each part of a raw observation to its features."""
        self.lstm = read.lstm("lstm_actor") if algo == "recurrent_ppo" else None
        self.trunk, self.head = _read_actor(algo, read, graph_is_trunk=self.own is not None and self.lstm is None)
        """The head's output: the mean of the action, for TD3 and DDPG the action, logits, or DQN's values."""
        self.is_squashed = algo in ACTOR_CRITIC or bool(info.policy_kwargs.get("squash_output"))
        """Whether the network's actions are in [-1, 1] and are scaled to the bounds of the Box."""
        self.ends_with_tanh = self.is_squashed and algo not in DETERMINISTIC  # heads of TD3 and DDPG contain it
        """Whether tanh is applied to the head's output plus noise."""
        name = "actor.log_std" if algo in SQUASHED_GAUSSIAN else "log_std"
        self.log_std = read.tensors.get(name)
        """The noise parameter of PPO and gSDE; None if there is none, or if a layer computes it."""
        self._uses_expln = bool(info.policy_kwargs.get("use_sde") and info.policy_kwargs.get("use_expln"))
        self.std: Array | None = None
        """Standard deviations of the present `log_std`."""
        self._std_row: Array | None = None
        self._log_std_layer = read.linear(name) if f"{name}.weight" in read.tensors else None
        self.prepare()

    def prepare(self) -> None:
        """Compute values that depend only on the weights; call it again when the weights have changed."""
        if self.own is not None:
            self.own.prepare()
        for part in self.parts.values():
            for layer in part:
                layer.prepare()
        if self.log_std is not None:
            self.std = _expln(self.log_std) if self._uses_expln else np.exp(self.log_std)
            self._std_row = as_row(self.std)

    def compute_latent(self, observations: Any, states: Array | None = None) -> Array:
        """Return the head's input, shape (k, size); advances the states of an LSTM by one step."""
        parts = self.parts
        if self.own is not None:
            value = self.own(observations)
        elif "" in parts:
            value = apply(parts[""], observations)
        else:
            value = np.concatenate([apply(part, observations[key]) for key, part in parts.items()], axis=1)
        if self.lstm is not None:
            assert states is not None
            value = self.lstm.step(value, states)
        return apply(self.trunk, value)

    def compute_std(self, latent: Array) -> Array:
        """Return the standard deviations of Gaussian actions, shape (k, elements); (1, elements) if all are equal.

        Raises `ValueError` if the policy has none.
        """
        if self._log_std_layer is not None:
            return np.exp(np.clip(self._log_std_layer(latent), -20.0, 2.0))
        if self._std_row is None:  # called for Gaussian heads only
            raise ValueError("log_std is missing")
        return self._std_row


def _expln(log_std: Array) -> Array:
    """Return SB3's alternative to exp for gSDE; it grows more slowly above 0."""
    return np.where(log_std <= 0, np.exp(np.minimum(log_std, 0)), np.log1p(np.maximum(log_std, 0) + 1e-6) + 1.0)


def _read_actor(algo: str, read: _Reader, *, graph_is_trunk: bool) -> tuple[list[Layer], list[Layer]]:
    """Return trunk and head; a user's graph contains the trunk, for deterministic actors and DQN the head too."""
    if graph_is_trunk and algo in (*DETERMINISTIC, "dqn"):
        return [], []
    if algo in SQUASHED_GAUSSIAN:
        trunk = [] if graph_is_trunk else read.sequence("actor.latent_pi", end=read.activation)
        if "actor.mu.weight" in read.tensors:
            return trunk, [read.linear("actor.mu")]
        limit = float(read.info.policy_kwargs.get("clip_mean", 2.0))
        return trunk, [read.linear("actor.mu.0"), layers.Clip("actor.mu.1", limit)]
    if algo in DETERMINISTIC:
        return [], read.sequence("actor.mu", end=Activation("tanh"))
    if algo == "dqn":
        return [], read.sequence("q_net.q_net")
    trunk = [] if graph_is_trunk else read.sequence("mlp_extractor.policy_net", end=read.activation)
    return trunk, [read.linear("action_net")]


def read_normalization(policy: PolicyFile) -> dict[str, layers.Normalize]:
    """Return the normalisation of the parts of an observation, by key."""
    clip, tensors = float(policy.info.clip_observation or np.inf), policy.tensors
    names = {key: f"normalize/{key}" for key in policy.info.normalized_keys}
    return {
        key: layers.Normalize(name, tensors[f"{name}/mean"], tensors[f"{name}/var"], clip)
        for key, name in names.items()
    }


class _Reader:
    def __init__(self, policy: PolicyFile) -> None:
        info = self.info = policy.info
        self.policy = policy
        self.normalize = read_normalization(policy)
        self.tensors = {name.removeprefix("policy/"): values for name, values in policy.tensors.items()}
        name = info.policy_kwargs.get("activation_fn", "relu" if info.algo in _RELU_BY_DEFAULT else "tanh")
        own = GRAPH in self.tensors and info.algo != "recurrent_ppo"
        if not own and (isinstance(name, dict) or name not in layers.ACTIVATIONS):
            known = ", ".join(layers.ACTIVATIONS)
            name = name["class"] if isinstance(name, dict) else name
            raise UsageError(f"a {info.algo} network with activation {name!r} is not supported; supported: {known}")
        self.activation = Activation("" if own else name)  # a user's graph contains its activations

    def own_graph(self) -> OwnGraph | None:
        if GRAPH not in self.tensors:
            return None
        from rlctl.policy.onnx_policy import OwnGraph  # only here: it imports onnxruntime

        return OwnGraph(self.policy.tensors, self.normalize)

    def features(self, key: str, space: spaces.Space[object], extractor: str) -> list[Layer]:
        """Return the layers from a part of a raw observation to its features."""
        if isinstance(space, spaces.Discrete | spaces.MultiDiscrete):
            sizes = space.n if isinstance(space, spaces.Discrete) else space.nvec
            return [layers.OneHot(f"one_hot/{key}", np.asarray(sizes))]
        result: list[Layer] = [self.normalize[key]] if key in self.normalize else []
        if result and len(space.shape or ()) == 1:
            return result
        if not is_image(space):
            return [*result, layers.Flatten("flatten")]
        shape, relu = space.shape or (), Activation("relu")
        # SB3 takes the smallest dimension for the channels.
        result.append(layers.ScaleImage(f"image/{key}", min(range(3), key=lambda axis: shape[axis]) != 0))
        result += self.sequence(f"{extractor}.cnn", end=relu, activation=relu)
        return [*result, layers.Flatten("flatten"), *self.sequence(f"{extractor}.linear", end=relu, activation=relu)]

    def sequence(self, prefix: str, end: Layer | None = None, activation: Layer | None = None) -> list[Layer]:
        """Return the layers of a `torch.nn.Sequential`; `end` follows its last linear layer.

        An index without tensors is an activation, unless it is the last.
        """
        pattern = re.compile(rf"{re.escape(prefix)}\.(\d+)\.")
        indices = sorted({int(match[1]) for name in self.tensors if (match := pattern.match(name))})
        result: list[Layer] = []
        before = -1
        for index in indices:
            if index > before + 1:
                result.append(activation or self.activation)
            result.append(self._layer(f"{prefix}.{index}"))
            before = index
        if end is not None and indices and f"{prefix}.{indices[-1]}.weight" in self.tensors:
            result.append(end)
        return result

    def linear(self, name: str) -> Linear:
        return Linear(name, self.tensors[f"{name}.weight"], self.tensors[f"{name}.bias"])

    def _layer(self, name: str) -> Layer:
        if f"{name}.ra_mean" in self.tensors:
            epsilon = np.float32(self.info.policy_kwargs.get("batch_norm_eps", _BATCH_RENORM_EPSILON))
            mean, variance = (self.tensors[f"{name}.{part}"] for part in ("ra_mean", "ra_var"))
            scale, bias = (self.tensors[f"{name}.{part}"] for part in ("scale", "bias"))
            return layers.BatchRenorm(name, mean, variance, scale, bias, epsilon)
        linear = self.linear(name)
        if linear.weight.ndim != 4:
            return linear
        return layers.Convolution(name, linear.weight, linear.bias, _NATURE_STRIDES[name.rpartition(".")[2]])

    def lstm(self, name: str) -> layers.Lstm:
        lstm_layers: list[layers.LstmLayer] = []
        while f"{name}.weight_ih_l{(index := len(lstm_layers))}" in self.tensors:
            of_input, of_hidden = (self.tensors[f"{name}.{kind}_l{index}"] for kind in ("weight_ih", "weight_hh"))
            names = [f"{name}.{kind}_l{index}" for kind in ("bias_ih", "bias_hh")]
            biases = [self.tensors[bias] for bias in names if bias in self.tensors]
            lstm_layers.append(layers.LstmLayer(of_input, of_hidden, biases))
        return layers.Lstm(name, lstm_layers)
