"""A policy as one ONNX graph: from raw observations to the action the environment takes."""

from __future__ import annotations

from typing import Any

import numpy as np
import onnx
from gymnasium import spaces

from rlctl.dict_spaces import SINGLE, split_space
from rlctl.export.graph import BATCH, Graph, unsupported
from rlctl.export.layers import concatenate, emit, emit_lstm
from rlctl.export.metadata import describe, metadata
from rlctl.run.layers import Lstm, Normalize, OneHot
from rlctl.run.network import Network, Tensors
from rlctl.run.onnx_policy import ACTION, SINGLE_INPUT, STATE_INPUTS, STATE_OUTPUTS
from rlctl.run.policy import PolicyInfo

_STATE_MEANING = "LSTM state; zeros when an episode begins, then the output of the step before"


def build(info: PolicyInfo, tensors: Tensors) -> onnx.ModelProto:
    """Write a policy file as ONNX: normalisation, the deterministic actor, and SB3's clip or unscaling of its action.

    Raises `UsageError` for what has no translation.
    """
    graph, network = Graph(), Network(info, tensors)
    observation_space, action_space = info.env.spaces()
    inputs = {key: _add_input(graph, info, key, part) for key, part in split_space(observation_space).items()}
    value = concatenate(graph, [_emit_part(graph, inputs[key], network, key) for key in network.parts])
    state: tuple[str, ...] = ()
    if (lstm := network.lstm) is not None:
        hidden, cell = (graph.input(name, np.float32, _find_state_shape(lstm), _STATE_MEANING) for name in STATE_INPUTS)
        value, state = emit_lstm(graph, value, (hidden, cell), lstm)
    value = emit(graph, value, [*network.trunk, *network.head])
    if isinstance(action_space, spaces.Box):
        # Where tanh ends the network there was noise before it, of which a deterministic action has none.
        value = graph.add("Tanh", value) if network.ends_with_tanh else value
        value, dtype = _emit_continuous(graph, value, action_space, network.is_squashed)
    else:
        value, dtype = _emit_discrete(graph, value, action_space), np.dtype(np.int64)
    shape: tuple[int | str, ...] = (BATCH, *(action_space.shape or ()))
    graph.output(value, ACTION, dtype, shape, info.env.action_meaning or "action, as the environment takes it")
    for name, part in zip(STATE_OUTPUTS, state, strict=False):
        assert lstm is not None  # which has the state
        graph.output(part, name, np.float32, _find_state_shape(lstm), "LSTM state for the next step")
    return graph.model(metadata(info), describe(info))


def _find_state_shape(lstm: Lstm) -> tuple[int, str, int]:
    return len(lstm.layers), BATCH, lstm.state.shape[2]


def _add_input(graph: Graph, info: PolicyInfo, key: str, space: spaces.Space[Any]) -> tuple[str, Any]:
    """Add the input of a part of the observation; return its name and dtype."""
    name = SINGLE_INPUT if key == SINGLE else key
    if space.shape is None or space.dtype is None:
        raise unsupported(f"observation {name!r}, a {type(space).__name__} space,")
    meaning = _describe_input(info) if key == SINGLE else f"observation {key!r}"
    return graph.input(name, space.dtype, (BATCH, *space.shape), meaning), space.dtype


def _describe_input(info: PolicyInfo) -> str:
    sizes, units = info.env.observation_sizes, info.env.observation_units
    parts = [
        f"{name} ({size}) [{units[name]}]" if name in units else f"{name} ({size})" for name, size in sizes.items()
    ]
    return ", ".join(parts) or "observation"


def _emit_part(graph: Graph, source: tuple[str, Any], network: Network, key: str) -> str:
    """From a part of the observation to its features."""
    (value, dtype), layers = source, network.parts[key]
    if dtype != np.float32 and not isinstance(layers[0], Normalize | OneHot):
        value = graph.cast(value, np.float32)
    return emit(graph, value, layers)


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
