"""Writes a policy as one ONNX graph, from raw observations to actions of the environment's action space."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import onnx
from gymnasium import spaces

from rlctl.environments.dict_spaces import SINGLE, split_space
from rlctl.errors import UsageError
from rlctl.policy import onnx_policy
from rlctl.policy.file import PolicyFile, PolicyInfo
from rlctl.policy.layers import Layer, Normalize, OneHot
from rlctl.policy.network import Network
from rlctl.policy.onnx_graph import BATCH, Graph
from rlctl.policy.onnx_policy import OwnGraph
from rlctl.task.joints import Joints

_TAKEN = (onnx_policy.ACTION, *onnx_policy.STATE_INPUTS, *onnx_policy.STATE_OUTPUTS)
_STATE_MEANING = "LSTM state; zeros when an episode begins, then the output of the step before"


def build(policy: PolicyFile) -> onnx.ModelProto:
    """Write a policy file as ONNX: normalisation, the deterministic actor, and SB3's clipping or scaling of the action.

    Raises `UsageError` for a part that cannot be written as ONNX.
    """
    info, graph = policy.info, Graph()
    parts = split_space(info.env.spaces()[0])
    inputs = {key: _add_input(graph, info, key, part) for key, part in parts.items()}
    emit_policy(graph, policy, inputs)
    description = (
        f"{info.algo} policy for {info.spec.task} after {info.training_steps} steps: raw observations in, "
        "deterministic action out; normalisation and the action's bounds are inside"
    )
    return graph.model(make_metadata(info), description)


def emit_policy(graph: Graph, policy: PolicyFile, inputs: Mapping[str, tuple[str, Any]]) -> None:
    """Add a policy, from the parts of a raw observation, each a value and its dtype, to the output `action`.

    The state of an LSTM becomes inputs and outputs of the graph.
    """
    network, action_space = Network(policy), policy.info.env.spaces()[1]
    state: tuple[str, ...] = ()
    if network.own is None:
        value = graph.concatenate([_emit_part(graph, inputs[key], network, key) for key in network.parts])
    else:
        value = _emit_own(graph, inputs, network.own)
    if (lstm := network.lstm) is not None:
        names, shape = onnx_policy.STATE_INPUTS, (len(lstm.layers), BATCH, lstm.hidden_size)
        hidden, cell = (graph.input(name, np.float32, shape, _STATE_MEANING) for name in names)
        value, state = lstm.write_onnx(graph, value, (hidden, cell))
    value = _emit(graph, value, [*network.trunk, *network.head])
    if isinstance(action_space, spaces.Box):
        # Exploration adds noise before this tanh; the deterministic action has none.
        value = graph.add("Tanh", value) if network.ends_with_tanh else value
        value, dtype = _emit_continuous(graph, value, action_space, network.is_squashed)
    else:
        value, dtype = _emit_discrete(graph, value, action_space), np.dtype(np.int64)
    meaning = policy.info.env.action_meaning or "action of the environment"
    graph.output(value, onnx_policy.ACTION, dtype, (BATCH, *(action_space.shape or ())), meaning)
    for name, part in zip(onnx_policy.STATE_OUTPUTS, state, strict=False):
        graph.output(part, name, np.float32, shape, "LSTM state for the next step")


def _add_input(graph: Graph, info: PolicyInfo, key: str, space: spaces.Space[Any]) -> tuple[str, Any]:
    """Add the input of a part of the observation; return its name and dtype."""
    name = key or onnx_policy.SINGLE_INPUT
    if name.startswith("/") or name in _TAKEN:
        raise UsageError(f"export: an observation named {name!r} cannot be written as ONNX; rename it in the task")
    meaning = _describe_input(info) if key == SINGLE else f"observation {key!r}"
    return graph.input(name, space.dtype, (BATCH, *(space.shape or ())), meaning), space.dtype


def _describe_input(info: PolicyInfo) -> str:
    sizes, units = info.env.observation_sizes, info.env.observation_units
    parts = (f"{name} ({size})" + (f" [{units[name]}]" if name in units else "") for name, size in sizes.items())
    return ", ".join(parts) or "observation"


def _emit(graph: Graph, value: str, layers: Iterable[Layer]) -> str:
    for layer in layers:
        value = layer.write_onnx(graph, value)
    return value


def _emit_part(graph: Graph, source: tuple[str, Any], network: Network, key: str) -> str:
    (value, dtype), layers = source, network.parts[key]
    if dtype != np.float32 and not isinstance(layers[0], Normalize | OneHot):
        value = graph.cast(value, np.float32)
    return _emit(graph, value, layers)


def _emit_own(graph: Graph, inputs: Mapping[str, tuple[str, Any]], own: OwnGraph) -> str:
    """Add a user's network, from all parts of the observation to its last hidden layer."""
    values = {f"{onnx_policy.OWN_INPUT}{key}": value for key, (value, _) in inputs.items()}
    for key, layer in own.normalize.items():
        values[f"{onnx_policy.OWN_INPUT}{key}"] = _emit(graph, inputs[key][0], [layer])
    values |= {name: graph.constant(name, weight) for name, weight in own.weights.items()}
    return graph.inline(onnx.ModelProto.FromString(own.content).graph, values)


def _emit_continuous(graph: Graph, value: str, space: spaces.Box, squashed: bool) -> tuple[str, np.dtype[Any]]:
    if not np.issubdtype(space.dtype, np.floating):
        raise UsageError(f"export: an action of type {space.dtype} cannot be written as ONNX")
    # As in SB3, bounds in float64 make the action float64.
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
    """Add the choice of the largest logit or value. It counts from 0: SB3 ignores the `start` of a space."""
    if isinstance(space, spaces.Discrete):
        return graph.add("ArgMax", value, axis=1, keepdims=0)
    if isinstance(space, spaces.MultiDiscrete) and space.nvec.ndim == 1:
        sizes = graph.constant("action/sizes", space.nvec.astype(np.int64))
        parts = graph.add_with_outputs("Split", [value, sizes], len(space.nvec), axis=1)
        return graph.add("Concat", *(graph.add("ArgMax", part, axis=1, keepdims=1) for part in parts), axis=1)
    if isinstance(space, spaces.MultiBinary):
        # SB3 rounds the probability: 1 for a logit above 0, and 0 for a logit of exactly 0.
        return graph.cast(graph.add("Greater", value, graph.constant("action/zero", np.float32(0.0))), np.int64)
    raise UsageError(f"export: an action of {space} cannot be written as ONNX")


def make_metadata(info: PolicyInfo) -> dict[str, str]:
    """Return the metadata of a policy's ONNX file.

    The key `rlctl` has the whole description as JSON. The other keys are for programs without rlctl; lists are
    separated by commas, units by semicolons, in the order of the elements of the observation or the action.
    """
    env, action_space = info.env, info.env.spaces()[1]
    plain = {
        "task": info.spec.task,
        "algorithm": info.algo,
        "training_steps": str(info.training_steps),
        "observation_names": ",".join(env.observation_sizes),
        "observation_sizes": ",".join(str(size) for size in env.observation_sizes.values()),
        "observation_units": ";".join(env.observation_units.get(name, "") for name in env.observation_sizes),
        "observation_history": ",".join(f"{name}:{count}" for name, count in env.observation_history.items()),
        "frame_stack": str(info.spec.frame_stack),
        "action_meaning": env.action_meaning,
        "action_space": "" if isinstance(action_space, spaces.Box) else str(action_space),
        "joint_names": ",".join(env.joints.names) if env.joints else "",
        **{
            key: ",".join(f"{value:.9g}" for value in values)
            for key, values in _list_numbers(action_space, env.joints).items()
        },
        "control_dt": "" if env.control_dt is None else f"{env.control_dt!r} s",
        "robot": env.robot,
        "state": "state_h and state_c: zeros when an episode begins" if info.algo == "recurrent_ppo" else "",
        "versions": ", ".join(f"{name} {version}" for name, version in info.versions.items()),
    }
    used = {key: value for key, value in plain.items() if value.strip(",")}
    return {onnx_policy.METADATA_KEY: info.model_dump_json(), **used}


def _list_numbers(space: spaces.Space[Any], joints: Joints | None) -> dict[str, Sequence[float]]:
    """Return bounds of the action, and numbers of the joints by the keys that mjlab and BeyondMimic read."""
    numbers: dict[str, Sequence[float]] = {}
    if isinstance(space, spaces.Box):
        numbers = {"action_low": space.low.ravel().tolist(), "action_high": space.high.ravel().tolist()}
    if joints is not None:
        numbers |= {
            "default_joint_pos": joints.default_positions,
            "action_scale": joints.action_scale,
            "joint_stiffness": joints.stiffness,
            "joint_damping": joints.damping,
            "drive_gain": joints.drive_gain,
            "drive_voltage": joints.drive_voltage,
            "joint_pos_lower": joints.low,
            "joint_pos_upper": joints.high,
            "joint_max_velocity": joints.max_speed,
            "joint_max_effort": joints.max_torque,
        }
    return numbers
