"""Torch layers as ONNX nodes, with their present weights."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from rlctl.export.graph import Graph, unsupported

if TYPE_CHECKING:
    import torch

Emit = Callable[[Graph, str, Any, str], str]


def emit(graph: Graph, value: str, module: torch.nn.Module, name: str) -> str:
    """Apply a layer, or layers in a row, to a value of shape (batch, ...) and return the result.

    `name` is the layer's place in the policy; its constants are named after it. Raises `UsageError` for a layer
    that has no translation.
    """
    kind = type(module).__name__
    if kind == "Sequential":
        for index, each in module.named_children():
            value = emit(graph, value, each, f"{name}.{index}")
        return value
    if kind not in _LAYERS:
        raise unsupported(f"layer {name}, a {kind},")
    return _LAYERS[kind](graph, value, module, name)


def array(tensor: torch.Tensor) -> NDArray[Any]:
    """Return a tensor's numbers as numpy."""
    result: NDArray[Any] = tensor.detach().cpu().numpy()
    return result


def _emit_linear(graph: Graph, value: str, module: Any, name: str) -> str:
    inputs = [value, graph.constant(f"{name}.weight", array(module.weight))]
    if module.bias is not None:
        inputs.append(graph.constant(f"{name}.bias", array(module.bias)))
    return graph.add("Gemm", *inputs, transB=1)


def _emit_conv(graph: Graph, value: str, module: Any, name: str) -> str:
    if module.padding_mode != "zeros" or isinstance(module.padding, str):
        raise unsupported(f"layer {name}, which pads with {module.padding_mode!r},")
    inputs = [value, graph.constant(f"{name}.weight", array(module.weight))]
    if module.bias is not None:
        inputs.append(graph.constant(f"{name}.bias", array(module.bias)))
    return graph.add(
        "Conv",
        *inputs,
        kernel_shape=list(module.kernel_size),
        strides=list(module.stride),
        pads=[*module.padding, *module.padding],
        dilations=list(module.dilation),
        group=module.groups,
    )


def _emit_batch_renorm(graph: Graph, value: str, module: Any, name: str) -> str:
    # Step by step as sb3-contrib computes it: folded into one multiplication and addition, a mean that is large
    # against its deviation would cost digits.
    deviation = (module.ra_var + module.eps).sqrt()
    value = graph.add("Sub", value, graph.constant(f"{name}.ra_mean", array(module.ra_mean)))
    value = graph.add("Div", value, graph.constant(f"{name}.deviation", array(deviation)))
    if not module.affine:
        return value
    value = graph.add("Mul", value, graph.constant(f"{name}.scale", array(module.scale)))
    return graph.add("Add", value, graph.constant(f"{name}.bias", array(module.bias)))


def _emit_silu(graph: Graph, value: str, module: Any, name: str) -> str:
    return graph.add("Mul", value, graph.add("Sigmoid", value))


def _emit_gelu(graph: Graph, value: str, module: Any, name: str) -> str:
    # 0.5 x (1 + erf(x / sqrt(2))); ONNX has an operator for it from opset 20 only.
    if module.approximate != "none":
        raise unsupported(f"layer {name}, GELU with approximate={module.approximate!r},")
    root = graph.constant(f"{name}.root2", np.float32(math.sqrt(2.0)))
    one, half = graph.constant(f"{name}.one", np.float32(1.0)), graph.constant(f"{name}.half", np.float32(0.5))
    erf = graph.add("Erf", graph.add("Div", value, root))
    return graph.add("Mul", graph.add("Mul", value, graph.add("Add", erf, one)), half)


def _emit_hard_tanh(graph: Graph, value: str, module: Any, name: str) -> str:
    low = graph.constant(f"{name}.low", np.float32(module.min_val))
    return graph.add("Clip", value, low, graph.constant(f"{name}.high", np.float32(module.max_val)))


def _emit_flatten(graph: Graph, value: str, module: Any, name: str) -> str:
    return graph.add("Flatten", value, axis=1)


def _emit_operator(operator: str) -> Emit:
    return lambda graph, value, module, name: graph.add(operator, value)


# By the name of the class: every layer here is torch's or sb3-contrib's own, and neither needs to be imported.
_LAYERS: dict[str, Emit] = {
    "Linear": _emit_linear,
    "Conv2d": _emit_conv,
    "BatchRenorm1d": _emit_batch_renorm,
    "Flatten": _emit_flatten,
    "FlattenExtractor": _emit_flatten,
    "Tanh": _emit_operator("Tanh"),
    "ReLU": _emit_operator("Relu"),
    "ELU": lambda graph, value, module, name: graph.add("Elu", value, alpha=float(module.alpha)),
    "LeakyReLU": lambda graph, value, module, name: graph.add("LeakyRelu", value, alpha=float(module.negative_slope)),
    "SiLU": _emit_silu,
    "GELU": _emit_gelu,
    "Hardtanh": _emit_hard_tanh,
}


def emit_lstm(
    graph: Graph, value: str, state: tuple[str, str], module: torch.nn.LSTM, name: str
) -> tuple[str, tuple[str, str]]:
    """Apply one step of an LSTM to a value of shape (batch, size).

    `state` names the hidden and the cell state, each of shape (layers, batch, hidden). Returns the value, of shape
    (batch, hidden), and the next state.
    """
    for option in ("bidirectional", "batch_first", "proj_size"):
        if getattr(module, option):
            raise unsupported(f"{name} with {option}={getattr(module, option)}")
    time, layers = graph.constant(f"{name}.time", np.array([0])), module.num_layers
    before = [graph.add_with_outputs("Split", [part], layers, axis=0) if layers > 1 else [part] for part in state]
    sequence = graph.add("Unsqueeze", value, time)
    after: list[list[str]] = [[], []]
    for layer in range(layers):
        constants = _add_lstm_constants(graph, module, layer, name)
        outputs, hidden, cell = graph.add_with_outputs(
            "LSTM",
            [sequence, *constants, "", before[0][layer], before[1][layer]],
            3,
            hidden_size=module.hidden_size,
        )
        sequence = graph.add("Squeeze", outputs, graph.constant(f"{name}.direction", np.array([1])))
        after[0].append(hidden)
        after[1].append(cell)
    joined = [graph.add("Concat", *parts, axis=0) if layers > 1 else parts[0] for parts in after]
    return graph.add("Squeeze", sequence, time), (joined[0], joined[1])


def _add_lstm_constants(graph: Graph, module: torch.nn.LSTM, layer: int, name: str) -> list[str]:
    """Input weights, recurrent weights and biases of a layer, with a leading dimension for ONNX's directions."""
    parameters = dict(module.named_parameters())
    weights = [_reorder_gates(array(parameters[f"weight_{part}_l{layer}"])) for part in ("ih", "hh")]
    if module.bias:
        biases = [_reorder_gates(array(parameters[f"bias_{part}_l{layer}"])) for part in ("ih", "hh")]
    else:
        biases = [np.zeros(4 * module.hidden_size, np.float32)] * 2
    return [
        graph.constant(f"{name}.{layer}.weight_ih", weights[0][None]),
        graph.constant(f"{name}.{layer}.weight_hh", weights[1][None]),
        graph.constant(f"{name}.{layer}.bias", np.concatenate(biases)[None]),
    ]


def _reorder_gates(values: NDArray[Any]) -> NDArray[Any]:
    """From torch's order of gates, input forget cell output, to ONNX's, input output forget cell."""
    i, f, c, o = np.split(values, 4)
    return np.concatenate([i, o, f, c])
