"""Reads the network of an ONNX graph of another project; the graph is not executed before it is understood."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from rlctl.errors import ArtifactError, short_repr
from rlctl.importing.foreign.network import (
    LARGEST_FILE,
    Array,
    ForeignLayer,
    ForeignLinear,
    ForeignLstm,
    ForeignNetwork,
    NotImportable,
    assemble,
)
from rlctl.policy.layers import ACTIVATIONS
from rlctl.policy.onnx_policy import check, open_session
from rlctl.storage import untrusted

if TYPE_CHECKING:
    import onnx

_PASSED_ON = ("Identity", "Flatten", "Cast", "Squeeze", "Unsqueeze", "Dropout")
_ACTIVATIONS = {"Elu": "elu", "Relu": "relu", "Tanh": "tanh"}
_SIGMOID = "sigmoid"
_RECURRENT = ("LSTM", "GRU", "RNN")
_LSTM = "lstm"
_STATES_AT = 5  # of the inputs of an LSTM node: the hidden state, then the cell state
_GATES = (0, 2, 3, 1)  # ONNX has input, output, forget, cell; torch input, forget, cell, output
_ROW = "time_step"  # input that chooses the row of a clip in the graph
_WEIGHTS_SUFFIX = ".onnx.data"
_MOST_NODES = 2000
_COMPARED, _TOLERANCE = 16, 1e-4  # random observations with which the network is compared with the graph


def read_onnx(path: Path) -> tuple[ForeignNetwork, dict[str, str]]:
    """Return the network of a graph and the graph's metadata; raises `ArtifactError` for one that is not imported."""
    content = untrusted.read_bytes(path, LARGEST_FILE)
    try:
        content = _embed_weights(content, path.parent)
        check(content)
        network, metadata = _read(content)
        _compare(content, network)
    except ValueError as error:
        raise ArtifactError(f"{path}: {short_repr(str(error), 300)}") from None
    return network, metadata


def read_tables(path: Path) -> dict[str, Array]:
    """Return the constant tables from which a graph's other outputs take a row: the clip of a policy that follows one.

    whole_body_tracking and mjlab write them, with the input `time_step` that chooses the row.
    """
    import onnx

    content = _embed_weights(untrusted.read_bytes(path, LARGEST_FILE), path.parent)
    graph = onnx.ModelProto.FromString(content).graph
    constants = {tensor.name: tensor for tensor in graph.initializer}
    for node in graph.node:
        if node.op_type == "Constant" and node.attribute and node.attribute[0].name == "value":
            constants[node.output[0]] = node.attribute[0].t
    outputs = {value.name for value in graph.output}
    return {
        node.output[0]: onnx.numpy_helper.to_array(constants[node.input[0]]).astype(np.float64)
        for node in graph.node
        if node.op_type == "Gather" and node.output[0] in outputs and node.input[0] in constants
    }


def _embed_weights(content: bytes, folder: Path) -> bytes:
    """Return a graph with the weights that torch wrote into a file next to it, `NAME.onnx.data`.

    Only such a file is read: any other place would be a path that the sender chose.
    """
    import onnx

    try:
        model = onnx.ModelProto.FromString(content)
    except Exception:  # protobuf's own error; `check` says what is wrong
        return content
    outside = [tensor for tensor in model.graph.initializer if tensor.external_data]
    if not outside:
        return content
    read: dict[str, bytes] = {}
    for tensor in outside:
        entries = {entry.key: entry.value for entry in tensor.external_data}
        name = entries.get("location", "")
        if Path(name).name != name or not name.endswith(_WEIGHTS_SUFFIX):
            raise NotImportable(f"its weights are in {name!r}; only a file NAME{_WEIGHTS_SUFFIX} next to it is read")
        if name not in read:
            read[name] = untrusted.read_bytes(folder / name, LARGEST_FILE)
        start, length = (int(entries.get(key, 0)) for key in ("offset", "length"))
        if start < 0 or length <= 0 or start + length > len(read[name]):
            raise NotImportable(f"{name} is too short: it lacks the weights {tensor.name!r}")
        tensor.raw_data = read[name][start : start + length]
        tensor.data_location = onnx.TensorProto.DEFAULT
        tensor.ClearField("external_data")
    return model.SerializeToString()


def _read(content: bytes) -> tuple[ForeignNetwork, dict[str, str]]:
    import onnx

    model = onnx.ModelProto.FromString(content)
    graph = model.graph
    constants = {tensor.name: onnx.numpy_helper.to_array(tensor) for tensor in graph.initializer}
    _check_form(graph, constants)
    reader = _ChainReader(constants)
    reader.of_clip |= {value.name for value in graph.input if value.name == _ROW}
    reader.values[_list_inputs(graph, constants)[0].name] = []
    for node in graph.node:
        reader.read(node)
    if graph.output[0].name in reader.of_clip:
        raise NotImportable(f"its actions depend on {_ROW}, not only on the observation")
    layers = reader.values.get(graph.output[0].name)
    if layers is None:
        raise NotImportable("its output does not depend on its input")
    metadata = {str(entry.key): str(entry.value) for entry in model.metadata_props}
    lstm = None
    if layers and layers[0][0] == _LSTM:
        lstm = layers[0][1]
        layers = layers[1:]
    return assemble(layers, ACTIVATIONS, lstm), metadata


def _list_inputs(graph: onnx.GraphProto, constants: dict[str, Any]) -> list[onnx.ValueInfoProto]:
    """Return the inputs of a graph, without weights, the states of an LSTM, and the row of a clip."""
    states = {name for node in graph.node if node.op_type == "LSTM" for name in node.input[_STATES_AT:]}
    own = [value for value in graph.input if value.name not in constants and value.name not in states]
    if len(own) > 1 and any(node.op_type == "Gather" for node in graph.node):
        own = [value for value in own if value.name != _ROW]
    return own


def _check_form(graph: onnx.GraphProto, constants: dict[str, Any]) -> None:
    """Raise `NotImportable` for a graph that is not from one vector to one other."""
    if len(graph.node) > _MOST_NODES:
        raise NotImportable(f"its graph has {len(graph.node):,} nodes; the limit is {_MOST_NODES:,}")
    own = [node.op_type for node in graph.node if node.domain not in ("", "ai.onnx")]
    if own:
        raise NotImportable(f"its graph has the custom operator {own[0]}; export it with standard operators")
    recurrent = [node.op_type for node in graph.node if node.op_type in _RECURRENT]
    inputs = _list_inputs(graph, constants)
    names = ", ".join(value.name for value in inputs)
    if recurrent not in ([], ["LSTM"]):
        raise NotImportable(f"its graph has hidden states ({', '.join(recurrent)}); one layer of LSTM is imported")
    if len(inputs) != 1:
        raise NotImportable(f"its graph has {len(inputs)} inputs ({names}), expected one: the observation")
    shape = [dimension.dim_value or 0 for dimension in inputs[0].type.tensor_type.shape.dim]
    if len(shape) not in (1, 2):
        raise NotImportable(f"its input {names} has {len(shape)} axes, expected (batch, size)")
    if not shape[-1]:
        raise NotImportable(f"the size of its input {names} is dynamic; export it with a fixed observation size")


class _ChainReader:
    """Reads nodes in a row: each value that depends on the input has the layers that compute it."""

    def __init__(self, constants: dict[str, NDArray[Any]]) -> None:
        self.constants = constants
        self.values: dict[str, list[ForeignLayer]] = {}
        self.of_clip: set[str] = set()  # values from which a row of a clip is read, which no action depends on

    def read(self, node: onnx.NodeProto) -> None:
        """Read a node; raises `NotImportable` for an operator that no perceptron has."""
        import onnx

        attributes = {attribute.name: onnx.helper.get_attribute_value(attribute) for attribute in node.attribute}
        if node.op_type == "Constant":
            value = attributes.get("value")
            self.constants[node.output[0]] = np.asarray(
                onnx.numpy_helper.to_array(value) if value is not None else next(iter(attributes.values()))
            )
            return
        if self.of_clip & set(node.input):
            self.of_clip |= set(node.output)
            return
        moving = [name for name in node.input if name in self.values]
        if not moving:
            self._fold(node)
            return
        layers = self.values[moving[0]]
        if node.op_type == "LSTM":
            self.values[node.output[0]] = [(_LSTM, _read_lstm(layers, node, self._get, attributes))]
            return
        if len(moving) == 2:
            self.values[node.output[0]] = self._join(node, moving)
            return
        self.values[node.output[0]] = [*layers, *self._describe(node, moving[0], attributes)]

    def _fold(self, node: onnx.NodeProto) -> None:
        """Compute a value that is constant, as far as exporters write such: transposed weights, reshaped sizes."""
        known = [self.constants.get(name) for name in node.input]
        if node.op_type in ("Identity", "Cast") and known[0] is not None:
            self.constants[node.output[0]] = known[0]
        elif node.op_type == "Transpose" and known[0] is not None:
            self.constants[node.output[0]] = known[0].T
        else:
            raise NotImportable(f"its graph has the operator {node.op_type} on constants")

    def _join(self, node: onnx.NodeProto, moving: list[str]) -> list[ForeignLayer]:
        one, other = (self.values[name] for name in moving)
        for plain, gate in ((one, other), (other, one)):
            if node.op_type == "Mul" and gate == [*plain, (_SIGMOID, None)]:
                return [*plain, ("silu", None)]
        raise NotImportable(f"its graph joins two branches with {node.op_type}")

    def _describe(self, node: onnx.NodeProto, given: str, attributes: dict[str, Any]) -> list[ForeignLayer]:
        kind = node.op_type
        others = [self._get(name) for name in node.input if name not in (given, "")]
        if kind in _PASSED_ON or (kind == "Reshape" and len(others) == 1):
            return []
        if kind in _ACTIVATIONS:
            if kind == "Elu" and attributes.get("alpha", 1.0) != 1.0:
                raise NotImportable("its Elu has an alpha other than 1")
            return [(_ACTIVATIONS[kind], None)]
        if kind == "Sigmoid":
            return [(_SIGMOID, None)]
        if kind == "Gemm":
            return [("linear", _read_gemm(others, attributes))]
        if kind == "MatMul" and node.input[0] == given:
            weight = np.asarray(others[0], float).T
            return [("linear", ForeignLinear(weight, np.zeros(len(weight))))]
        if kind in ("Add", "Sub", "Mul", "Div"):
            return [("affine", _read_affine(kind, np.ravel(others[0]).astype(float), is_first=node.input[0] == given))]
        if kind == "Split":
            if attributes.get("axis", 0) not in (-1, 1):
                raise NotImportable("its Split is along the batch")
            # What is read is the first output: the means of actions; standard deviations follow.
            sizes = attributes.get("split") or (np.ravel(others[0]).tolist() if others else [])
            if sizes:
                return [("first", int(sizes[0]))]
            return [("part", len(node.output))]
        raise NotImportable(
            f"its graph has the operator {kind}; only perceptrons are imported: linear layers, factors and shifts, "
            f"{', '.join(ACTIVATIONS)}"
        )

    def _get(self, name: str) -> NDArray[Any]:
        if name not in self.constants:
            raise NotImportable(f"its graph uses {name!r}, which it does not define")
        return self.constants[name]


def _read_gemm(others: list[NDArray[Any]], attributes: dict[str, Any]) -> ForeignLinear:
    if attributes.get("transA") or attributes.get("alpha", 1.0) != 1.0 or attributes.get("beta", 1.0) != 1.0:
        raise NotImportable("its Gemm is scaled or transposed")
    weight = np.asarray(others[0], float)
    weight = weight if attributes.get("transB") else weight.T
    bias = np.zeros(len(weight))
    if len(others) > 1:
        bias = np.broadcast_to(np.ravel(others[1]).astype(float), len(weight))
    return ForeignLinear(weight, bias)


def _read_lstm(
    layers: list[ForeignLayer],
    node: onnx.NodeProto,
    get: Callable[[str], NDArray[Any]],
    attributes: dict[str, Any],
) -> ForeignLstm:
    """Return the LSTM of a node; what normalises its input, `layers`, becomes part of it."""
    changed = set(attributes) - {"hidden_size", "layout"}
    if changed or attributes.get("layout"):
        raise NotImportable(f"its LSTM is of another kind than torch's ({', '.join(sorted(changed)) or 'layout'})")
    if len(node.input) != _STATES_AT + 2:
        raise NotImportable("the states of its LSTM are no inputs of the graph")
    weight, recurrent, biases = (get(name).astype(float) for name in node.input[1:4])
    if weight.ndim != len("dgi") or len(weight) != 1:
        raise NotImportable("its LSTM runs in two directions")
    of_input, of_state = np.split(biases[0], 2)
    first = ForeignLinear(_order_gates(weight[0]), _order_gates(of_input))
    for kind, content in reversed(layers):
        if kind != "affine":
            raise NotImportable(f"{kind} is in front of its LSTM")
        factor, shift = (number * np.ones(weight.shape[2]) for number in content)
        first = ForeignLinear(first.weight * factor, first.bias + first.weight @ shift)
    return ForeignLstm(((first.weight, _order_gates(recurrent[0]), first.bias, _order_gates(of_state)),))


def _order_gates(rows: Array) -> Array:
    """Return rows of ONNX's gates in torch's order."""
    gates = np.split(rows, len(_GATES))
    return np.concatenate([gates[number] for number in _GATES])


def _read_affine(kind: str, number: Any, *, is_first: bool) -> tuple[Any, Any]:
    if kind == "Add":
        return np.ones(1), number
    if kind == "Mul":
        return number, np.zeros(1)
    if kind == "Sub":
        return (np.ones(1), -number) if is_first else (-np.ones(1), number)
    if not is_first:
        raise NotImportable("its graph divides by what it has observed")
    return 1.0 / number, np.zeros(1)


def _compare(content: bytes, network: ForeignNetwork) -> None:
    """Raise `NotImportable` if the graph computes something else than the network that was read from it."""
    session = open_session(content)
    given, *states = (value for value in session.get_inputs() if value.name != _ROW)
    rows = np.random.default_rng(0).normal(size=(_COMPARED, network.observation_size)).astype(np.float32)
    size = 0 if network.lstm is None else network.lstm.hidden_size
    feed = {state.name: np.zeros((1, 1, size), np.float32) for state in states}
    if any(value.name == _ROW for value in session.get_inputs()):
        feed[_ROW] = np.zeros((1, 1), np.float32)
    own = np.zeros((2, size))  # hidden and cell state
    for row in rows:
        feed[given.name] = row[None] if len(given.shape) == 2 else row
        try:
            expected, *following = session.run(None, feed)
        except Exception as error:  # onnxruntime's own errors have no public base class
            raise NotImportable(f"its graph does not run: {short_repr(str(error), 150)}") from None
        feed.update(zip((state.name for state in states), following, strict=False))
        value = row
        if network.lstm is not None:
            own = step_lstm(network.lstm, row, own)
            value = own[0]
        value = compute(network, value)
        if np.shape(np.ravel(expected)) != value.shape or not np.allclose(
            value, np.ravel(expected), rtol=_TOLERANCE, atol=_TOLERANCE
        ):
            raise NotImportable("its graph computes something else than the layers that were read from it")


def step_lstm(lstm: ForeignLstm, row: NDArray[Any], states: Array) -> Array:
    """Return the hidden and the cell state, shape (2, size), of one layer after an observation."""
    ((weight_ih, weight_hh, bias_ih, bias_hh),) = lstm.layers
    hidden, cell = states
    gates = weight_ih @ row + bias_ih + weight_hh @ hidden + bias_hh
    enter, forget, candidate, leave = np.split(gates, len(_GATES))
    cell = _squash(forget) * cell + _squash(enter) * np.tanh(candidate)
    return np.stack([_squash(leave) * np.tanh(cell), cell])


def _squash(value: Array) -> Array:
    return np.asarray(1.0 / (1.0 + np.exp(-value)))


def compute(network: ForeignNetwork, row: NDArray[Any]) -> NDArray[Any]:
    """Return the action of the linear layers, shape (actions,), for an observation, or the state of an LSTM."""
    value = np.asarray(row, np.float64)
    for number, linear in enumerate(network.linears):
        if number:
            value = ACTIVATIONS[network.activation](value)
        value = linear.weight @ value + linear.bias
    return np.tanh(value) if network.ends_with_tanh else value
