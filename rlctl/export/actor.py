"""A policy as one ONNX graph: from raw observations to the action the environment takes."""

from __future__ import annotations

from typing import Any

import numpy as np
import onnx
from gymnasium import spaces

from rlctl.export.graph import BATCH, Graph, unsupported
from rlctl.export.layers import emit, emit_lstm
from rlctl.export.metadata import describe, metadata
from rlctl.export.observation import Observations, Tensors
from rlctl.run.onnx_policy import ACTION, STATE_INPUTS, STATE_OUTPUTS
from rlctl.run.policy import PolicyInfo

_STATE_MEANING = "LSTM state; zeros when an episode begins, then the output of the step before"


def build(info: PolicyInfo, network: Any, tensors: Tensors) -> onnx.ModelProto:
    """Write a policy as ONNX: normalisation, the deterministic actor, and SB3's clip or unscaling of its action.

    `network` is the SB3 policy with the weights of `tensors`. Raises `UsageError` for what has no translation.
    """
    graph = Graph()
    _, action_space = info.env.spaces()
    value, *state = _ACTORS[info.algo](graph, Observations(graph, info, tensors), network)
    if isinstance(action_space, spaces.Box):
        value, dtype = _emit_continuous(graph, value, action_space, bool(network.squash_output))
    else:
        value, dtype = _emit_discrete(graph, value, action_space), np.dtype(np.int64)
    shape: tuple[int | str, ...] = (BATCH, *(action_space.shape or ()))
    graph.output(value, ACTION, dtype, shape, info.env.action_meaning or "action, as the environment takes it")
    for name, part in zip(STATE_OUTPUTS, state, strict=False):
        graph.output(part, name, np.float32, _find_state_shape(network), "LSTM state for the next step")
    return graph.model(metadata(info), describe(info))


def _emit_actor_critic(graph: Graph, observations: Observations, network: Any) -> list[str]:
    """PPO, A2C: the mean of the distribution, or the logits."""
    value = observations.features(network.pi_features_extractor, scale_images=network.normalize_images)
    return [_emit_action_net(graph, value, network)]


def _emit_recurrent(graph: Graph, observations: Observations, network: Any) -> list[str]:
    value = observations.features(network.pi_features_extractor, scale_images=network.normalize_images)
    hidden, cell = (graph.input(name, np.float32, _find_state_shape(network), _STATE_MEANING) for name in STATE_INPUTS)
    value, after = emit_lstm(graph, value, (hidden, cell), network.lstm_actor, "lstm_actor")
    return [_emit_action_net(graph, value, network), *after]


def _find_state_shape(network: Any) -> tuple[int, str, int]:
    return network.lstm_actor.num_layers, BATCH, network.lstm_actor.hidden_size


def _emit_action_net(graph: Graph, value: str, network: Any) -> str:
    value = emit(graph, value, network.mlp_extractor.policy_net, "mlp_extractor.policy_net")
    value = emit(graph, value, network.action_net, "action_net")
    # gSDE with bounded actions; the noise itself has no part in a deterministic action.
    return graph.add("Tanh", value) if network.squash_output else value


def _emit_squashed_gaussian(graph: Graph, observations: Observations, network: Any) -> list[str]:
    """SAC, TQC, CrossQ, with gSDE or without: tanh of the mean."""
    actor = network.actor
    value = observations.features(actor.features_extractor, scale_images=actor.normalize_images)
    value = emit(graph, value, actor.latent_pi, "actor.latent_pi")
    return [graph.add("Tanh", emit(graph, value, actor.mu, "actor.mu"))]


def _emit_deterministic(graph: Graph, observations: Observations, network: Any) -> list[str]:
    """TD3, DDPG: the network ends with its own tanh."""
    actor = network.actor
    value = observations.features(actor.features_extractor, scale_images=actor.normalize_images)
    return [emit(graph, value, actor.mu, "actor.mu")]


def _emit_q_values(graph: Graph, observations: Observations, network: Any) -> list[str]:
    q_net = network.q_net
    value = observations.features(q_net.features_extractor, scale_images=q_net.normalize_images)
    return [emit(graph, value, q_net.q_net, "q_net.q_net")]


# Each returns the end of the network's own computation and, if recurrent, the next state.
_ACTORS = {
    "ppo": _emit_actor_critic,
    "a2c": _emit_actor_critic,
    "recurrent_ppo": _emit_recurrent,
    "sac": _emit_squashed_gaussian,
    "tqc": _emit_squashed_gaussian,
    "crossq": _emit_squashed_gaussian,
    "td3": _emit_deterministic,
    "ddpg": _emit_deterministic,
    "dqn": _emit_q_values,
}


def _emit_continuous(graph: Graph, value: str, space: spaces.Box, squashed: bool) -> tuple[str, np.dtype[Any]]:
    if not np.issubdtype(space.dtype, np.floating):
        raise unsupported(f"an action of type {space.dtype}")
    # As numpy promotes it in SB3: float32 stays, bounds in float64 make the action float64.
    dtype = np.result_type(np.float32, space.dtype)
    if len(space.shape) != 1:
        value = graph.add("Reshape", value, graph.constant("action/shape", np.array([-1, *space.shape])))
    if squashed:
        one, half = graph.constant("action/one", np.float32(1.0)), graph.constant("action/half", np.float32(0.5))
        value = graph.add("Mul", graph.add("Add", value, one), half)
    if dtype != np.float32:
        value = graph.cast(value, dtype)
    low, high = space.low.astype(dtype), space.high.astype(dtype)
    if squashed:
        value = graph.add("Mul", value, graph.constant("action/range", (space.high - space.low).astype(dtype)))
        return graph.add("Add", value, graph.constant("action/low", low)), dtype
    value = graph.add("Max", value, graph.constant("action/low", low))
    return graph.add("Min", value, graph.constant("action/high", high)), dtype


def _emit_discrete(graph: Graph, value: str, space: spaces.Space[Any]) -> str:
    """The most likely, or most valuable, choice. Counted from 0: SB3 takes no notice of a space's `start`."""
    if isinstance(space, spaces.Discrete):
        return graph.add("ArgMax", value, axis=1, keepdims=0)
    if isinstance(space, spaces.MultiDiscrete) and space.nvec.ndim == 1:
        sizes = graph.constant("action/sizes", space.nvec.astype(np.int64))
        parts = graph.add_with_outputs("Split", [value, sizes], len(space.nvec), axis=1)
        chosen = [graph.add("ArgMax", part, axis=1, keepdims=1) for part in parts]
        return graph.add("Concat", *chosen, axis=1)
    if isinstance(space, spaces.MultiBinary):
        # SB3 rounds the probability, which is one half where the logit is zero, and rounds halves to zero.
        return graph.cast(graph.add("Greater", value, graph.constant("action/zero", np.float32(0.0))), np.int64)
    raise unsupported(f"an action of {space}")
