"""Builds an ONNX graph node by node, from layers with their present weights."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import helper, numpy_helper

from rlctl.policy import layers
from rlctl.policy.file import OPSET
from rlctl.version import __version__

IR_VERSION = 8  # the version of this opset; the onnx package would write its newest one, which older runtimes refuse
BATCH = "batch"  # name of the dynamic dimension


class Graph:
    """A graph under construction; values are identified by their names.

    Names of inner values start with a slash, so they differ from the names of inputs and outputs.
    """

    def __init__(self) -> None:
        self._nodes: list[onnx.NodeProto] = []
        self._constants: dict[str, onnx.TensorProto] = {}
        self._inputs: list[onnx.ValueInfoProto] = []
        self._outputs: list[onnx.ValueInfoProto] = []

    def input(self, name: str, dtype: Any, shape: Sequence[int | str], meaning: str) -> str:
        """Add an input and return its name."""
        self._inputs.append(helper.make_tensor_value_info(name, _find_type(dtype), list(shape), meaning))
        return name

    def constant(self, name: str, value: Any) -> str:
        """Add a constant array and return its name."""
        name = f"/{name}"
        self._constants[name] = numpy_helper.from_array(np.array(value, order="C"), name)
        return name

    def count_constants(self) -> int:
        """Return the number of constants, for the name of the next one."""
        return len(self._constants)

    def add(self, operator: str, *inputs: str, **attributes: Any) -> str:
        """Add a node with one output and return the output's name."""
        return self.add_with_outputs(operator, inputs, 1, **attributes)[0]

    def add_with_outputs(self, operator: str, inputs: Sequence[str], count: int, **attributes: Any) -> list[str]:
        """Add a node and return the names of its outputs; an input named "" is an omitted one."""
        name = f"/{operator}_{len(self._nodes)}"
        outputs = [name if count == 1 else f"{name}.{index}" for index in range(count)]
        self._nodes.append(helper.make_node(operator, list(inputs), outputs, name=name, **attributes))
        return outputs

    def inline(self, graph: onnx.GraphProto, values: Mapping[str, str]) -> str:
        """Add the nodes of another graph and return its first output; `values` maps its inputs to our values."""
        names = dict(values)
        for tensor in graph.initializer:
            names[tensor.name] = self.constant(f"own/{tensor.name}", numpy_helper.to_array(tensor))
        for node in graph.node:
            copied = onnx.NodeProto()
            copied.CopyFrom(node)
            copied.name = f"/own/{node.name or node.output[0]}"
            names |= {output: f"/own/{output}" for output in node.output if output}
            copied.input[:] = [names[value] if value else "" for value in node.input]
            copied.output[:] = [names[value] if value else "" for value in node.output]
            self._nodes.append(copied)
        return names[graph.output[0].name]

    def cast(self, value: str, dtype: Any) -> str:
        """Add a conversion to a numpy dtype."""
        return self.add("Cast", value, to=_find_type(dtype))

    def output(self, value: str, name: str, dtype: Any, shape: Sequence[int | str], meaning: str) -> None:
        """Make a value an output with a name."""
        for node in self._nodes:
            for names in (node.input, node.output):
                names[:] = [name if other == value else other for other in names]
        self._outputs.append(helper.make_tensor_value_info(name, _find_type(dtype), list(shape), meaning))

    def model(self, metadata: Mapping[str, str], meaning: str) -> onnx.ModelProto:
        """Return the checked model; raises onnx's `ValidationError` for an invalid graph."""
        constants = list(self._constants.values())
        graph = helper.make_graph(self._nodes, "policy", self._inputs, self._outputs, constants, meaning)
        opset, producer = helper.make_opsetid("", OPSET), {"producer_name": "rlctl", "producer_version": __version__}
        model = helper.make_model(graph, **producer, opset_imports=[opset], ir_version=IR_VERSION)
        helper.set_model_props(model, dict(metadata))
        onnx.checker.check_model(model, full_check=True)
        return model


def _find_type(dtype: Any) -> int:
    return int(helper.np_dtype_to_tensor_dtype(np.dtype(dtype)))


def emit(graph: Graph, value: str, chain: Iterable[layers.Layer]) -> str:
    """Apply layers one after the other to a value of shape (batch, ...) and return the result."""
    for layer in chain:
        value = _EMIT[type(layer)](graph, value, layer)
    return value


def concatenate(graph: Graph, parts: list[str]) -> str:
    """Join values of shape (batch, size)."""
    return graph.add("Concat", *parts, axis=1) if len(parts) > 1 else parts[0]


def _emit_linear(graph: Graph, value: str, layer: layers.Linear) -> str:
    weight, bias = (graph.constant(f"{layer.name}.{part}", getattr(layer, part)) for part in ("weight", "bias"))
    return graph.add("Gemm", value, weight, bias, transB=1)


def _emit_convolution(graph: Graph, value: str, layer: layers.Convolution) -> str:
    weight, bias = (graph.constant(f"{layer.name}.{part}", getattr(layer, part)) for part in ("weight", "bias"))
    shape, strides = list(layer.weight.shape[2:]), [layer.stride, layer.stride]
    return graph.add("Conv", value, weight, bias, kernel_shape=shape, strides=strides)


def _emit_batch_renorm(graph: Graph, value: str, layer: layers.BatchRenorm) -> str:
    # The same steps as in sb3-contrib: as one multiplication and addition, a mean much larger than its deviation
    # would lose digits.
    value = graph.add("Sub", value, graph.constant(f"{layer.name}.ra_mean", layer.mean))
    deviation = graph.constant(f"{layer.name}.deviation", np.sqrt(layer.variance + layer.epsilon))
    value = graph.add("Mul", graph.add("Div", value, deviation), graph.constant(f"{layer.name}.scale", layer.scale))
    return graph.add("Add", value, graph.constant(f"{layer.name}.bias", layer.bias))


def _emit_normalize(graph: Graph, value: str, layer: layers.Normalize) -> str:
    # In float64, as `Normalize` computes it.
    value = graph.cast(value, np.float64)
    value = graph.add("Sub", value, graph.constant(f"{layer.name}/mean", np.float64(layer.mean)))
    deviation = np.sqrt(np.float64(layer.variance) + layer.epsilon)
    value = graph.add("Div", value, graph.constant(f"{layer.name}/deviation", deviation))
    low, high = (graph.constant(f"{layer.name}/{end}", np.float64(at * layer.clip)) for end, at in _ENDS.items())
    return graph.cast(graph.add("Clip", value, low, high), np.float32)


_ENDS = {"low": -1, "high": 1}


def _emit_one_hot(graph: Graph, value: str, layer: layers.OneHot) -> str:
    levels = graph.constant(f"{layer.name}/levels", np.array([0.0, 1.0], np.float32))
    if layer.sizes.ndim == 0:
        return graph.add("OneHot", value, graph.constant(f"{layer.name}/depth", np.int64(layer.sizes)), levels)
    parts = []
    for index, size in enumerate(layer.sizes.tolist()):
        column = graph.add("Gather", value, graph.constant(f"{layer.name}/{index}", np.int64(index)), axis=1)
        depth = graph.constant(f"{layer.name}/{index}/depth", np.int64(size))
        parts.append(graph.add("OneHot", column, depth, levels))
    return concatenate(graph, parts)


def _emit_scale_image(graph: Graph, value: str, layer: layers.ScaleImage) -> str:
    if layer.channels_last:
        value = graph.add("Transpose", value, perm=[0, 3, 1, 2])
    return graph.add("Div", value, graph.constant(layer.name, np.float32(255.0)))


def _emit_clip(graph: Graph, value: str, layer: layers.Clip) -> str:
    low, high = (graph.constant(f"{layer.name}.{end}", np.float32(at * layer.limit)) for end, at in _ENDS.items())
    return graph.add("Clip", value, low, high)


def _emit_activation(graph: Graph, value: str, layer: layers.Activation) -> str:
    if layer.name == "silu":
        return graph.add("Mul", value, graph.add("Sigmoid", value))
    return graph.add(layer.name.capitalize(), value)  # Tanh, Relu or Elu


_EMIT: dict[type[layers.Layer], Callable[[Graph, str, Any], str]] = {
    layers.Linear: _emit_linear,
    layers.Convolution: _emit_convolution,
    layers.BatchRenorm: _emit_batch_renorm,
    layers.Normalize: _emit_normalize,
    layers.OneHot: _emit_one_hot,
    layers.ScaleImage: _emit_scale_image,
    layers.Flatten: lambda graph, value, layer: graph.add("Flatten", value, axis=1),
    layers.Clip: _emit_clip,
    layers.Activation: _emit_activation,
}


def emit_lstm(graph: Graph, value: str, state: tuple[str, str], lstm: layers.Lstm) -> tuple[str, tuple[str, str]]:
    """Apply one step of an LSTM to a value of shape (batch, size).

    `state` names the hidden and the cell state, each of shape (layers, batch, hidden). Returns the value, of shape
    (batch, hidden), and the next state.
    """
    time, count = graph.constant(f"{lstm.name}.time", np.array([0])), len(lstm.layers)
    before = [graph.add_with_outputs("Split", [part], count, axis=0) if count > 1 else [part] for part in state]
    sequence = graph.add("Unsqueeze", value, time)
    after: list[list[str]] = [[], []]
    for number, layer in enumerate(lstm.layers):
        constants = _add_lstm_constants(graph, layer, f"{lstm.name}.{number}")
        inputs = [sequence, *constants, "", *(part[number] for part in before)]
        outputs, hidden, cell = graph.add_with_outputs("LSTM", inputs, 3, hidden_size=lstm.hidden_size)
        sequence = graph.add("Squeeze", outputs, graph.constant(f"{lstm.name}.direction", np.array([1])))
        after[0].append(hidden)
        after[1].append(cell)
    joined = [graph.add("Concat", *parts, axis=0) if count > 1 else parts[0] for parts in after]
    return graph.add("Squeeze", sequence, time), (joined[0], joined[1])


def _add_lstm_constants(graph: Graph, layer: layers.LstmLayer, name: str) -> list[str]:
    """Add input weights, recurrent weights and biases of a layer, with ONNX's leading dimension of directions."""
    weights = [_reorder_gates(weight) for weight in (layer.of_input, layer.of_hidden)]
    biases = [_reorder_gates(bias) for bias in layer.biases] or [np.zeros(len(weights[0]), np.float32)] * 2
    arrays = {"weight_ih": weights[0], "weight_hh": weights[1], "bias": np.concatenate(biases)}
    return [graph.constant(f"{name}.{part}", array[None]) for part, array in arrays.items()]


def _reorder_gates(values: NDArray[Any]) -> NDArray[Any]:
    """Change torch's order of gates (input, forget, cell, output) to ONNX's (input, output, forget, cell)."""
    i, f, c, o = np.split(values, 4)
    return np.concatenate([i, o, f, c])
