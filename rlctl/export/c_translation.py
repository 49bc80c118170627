"""The graph of a policy, node by node, as the statements of a C function for one observation."""

from __future__ import annotations

import itertools
import re
from collections import Counter
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import helper, numpy_helper

from rlctl.errors import UsageError
from rlctl.export.c_expressions import ELEMENTWISE, HELPERS, NEEDED_BY, UNCHANGED, Value, literal, name_array

_PER_LINE = 8
_RESERVED = {"action", "observation", "state", "i", *HELPERS}


class Translation:
    """Statements and constants of the nodes of a graph, for a batch of one.

    `inputs` are the values of the graph's inputs. Raises `UsageError` for a node that has no translation.
    """

    def __init__(self, graph: onnx.GraphProto, inputs: Mapping[str, Value]) -> None:
        self.statements: list[str] = []
        self._texts: list[str] = []
        self._values = dict(inputs)
        self._arrays: dict[str, str] = {}
        self._names = set(_RESERVED)
        self._uses = Counter(name for node in graph.node for name in node.input)
        self._uses.update(each.name for each in graph.output)
        for tensor in graph.initializer:
            self._values[tensor.name] = self._make_constant(tensor.name, numpy_helper.to_array(tensor))
        for node in graph.node:
            self._translate(node)

    def __getitem__(self, name: str) -> Value:
        """Return the value of a name in the graph."""
        return self._values[name]

    @property
    def constants(self) -> list[str]:
        """The definitions of the arrays that the statements use."""
        return self._texts

    def find_helpers(self) -> list[str]:
        """Return the functions that the statements call."""
        text = "\n".join(self.statements)
        called = {name for name in HELPERS if re.search(rf"\b{name}\(", text)}
        called |= {needed for name in called for needed in NEEDED_BY.get(name, ())}
        return [HELPERS[name] for name in HELPERS if name in called]

    def assign(self, target: str, value: Value, offset: int = 0) -> None:
        """Write the elements of a value into an array that exists."""
        place = f"{offset} + i" if offset else "i"
        if value.size == 1:
            self.statements.append(f"{target}[{offset}] = {value.element('0')};")
            return
        self.statements += [
            f"for (int i = 0; i < {value.size}; ++i) {{",
            f"    {target}[{place}] = {value.element('i')};",
            "}",
        ]

    def _translate(self, node: onnx.NodeProto) -> None:
        attributes = {each.name: helper.get_attribute_value(each) for each in node.attribute}
        inputs = [self._values[name] if name else None for name in node.input]
        kind = node.op_type
        if kind in ELEMENTWISE:
            outputs = [self._apply_elementwise(kind, inputs, attributes)]
        elif kind in UNCHANGED:
            outputs = [self._values[node.input[0]]]
        elif kind in _TRANSLATIONS:
            outputs = _TRANSLATIONS[kind](self, node, inputs, attributes)
        else:
            what = "images" if kind in ("Conv", "Transpose") else f"a network with {kind}"
            raise UsageError(f"export --c: {what} cannot be written as C; rlctl export --onnx can")
        for name, value in zip(node.output, outputs, strict=False):
            shared = self._uses[name] > 1 and not value.name and value.constant is None
            self._values[name] = self._store(value, "value") if shared else value

    def _apply_elementwise(self, kind: str, inputs: list[Any], attributes: dict[str, Any]) -> Value:
        write, size = ELEMENTWISE[kind], max(each.size for each in inputs)

        def element(index: str) -> str:
            operands = [each.element("0" if each.size == 1 else index) for each in inputs]
            return write(inputs[0].type, *operands, **attributes)

        return Value(element, inputs[0].dtype, size)

    def _make_constant(self, name: str, values: NDArray[Any]) -> Value:
        flat = values.ravel()

        def element(index: str) -> str:
            if (flat == flat[0]).all():
                return literal(flat[0], flat.dtype)
            return f"{self._write_array(name, flat)}[{index}]"

        return Value(element, flat.dtype, flat.size, constant=values)

    def _write_array(self, name: str, values: NDArray[Any]) -> str:
        """Define a constant array, once, and return its name."""
        if name not in self._arrays:
            self._arrays[name] = self._find_free_name(name)
            value = Value(str, values.dtype, values.size)
            numbers = [literal(each, values.dtype).strip("()") for each in values.ravel()]
            rows = [", ".join(numbers[low : low + _PER_LINE]) for low in range(0, len(numbers), _PER_LINE)]
            body = ",\n    ".join(rows)
            text = f"static const {value.type} {self._arrays[name]}[{values.size}] = {{\n    {body},\n}};\n"
            self._texts.append(text)
        return self._arrays[name]

    def _find_free_name(self, name: str) -> str:
        """Return a C name like one of the graph, which may have any characters."""
        plain = re.sub(r"\W", "_", name, flags=re.ASCII).strip("_") or "array"
        plain = f"p_{plain}" if plain[0].isdigit() else plain
        free, number = plain, 2
        while free in self._names:
            free, number = f"{plain}_{number}", number + 1
        self._names.add(free)
        return free

    def _declare(self, name: str, dtype: Any, size: int) -> Value:
        number = next(each for each in itertools.count(1) if f"{name}_{each}" not in self._names)
        array = name_array(self._find_free_name(f"{name}_{number}"), dtype, size)
        self.statements.append(f"{array.type} {array.name}[{size}];")
        return array

    def _store(self, value: Value, name: str) -> Value:
        """Return a value as an array of its own."""
        if value.name:
            return value
        array = self._declare(name, value.dtype, value.size)
        self.assign(array.name, value)
        return array

    def _add_linear(self, weight: str, transposed: NDArray[Any], source: Value, target: Value) -> None:
        constant = self._write_array(f"{weight}", np.ascontiguousarray(transposed))
        self.statements.append(f"apply_linear({constant}, {source.name}, {source.size}, {target.name}, {target.size});")

    def _gemm(self, node: onnx.NodeProto, inputs: list[Any], attributes: dict[str, Any]) -> list[Value]:
        weight = inputs[1].constant  # (outputs, inputs)
        source = self._store(inputs[0], "input")
        target = self._declare("layer", np.float32, len(weight))
        zeros = Value(lambda _: "0.0f", np.dtype(np.float32), len(weight))
        self.assign(target.name, inputs[2] if len(inputs) > 2 else zeros)
        self._add_linear(node.input[1], weight.T, source, target)
        return [target]

    def _lstm(self, node: onnx.NodeProto, inputs: list[Any], attributes: dict[str, Any]) -> list[Value]:
        source, of_input, of_hidden, biases, _, hidden_before, cell_before = inputs
        count = attributes["hidden_size"]
        source = self._store(source, "input")
        hidden, cell = (self._declare(name, np.float32, count) for name in ("hidden", "cell"))
        for target, before in ((hidden, hidden_before), (cell, cell_before)):
            self.assign(target.name, before)
        gates = self._declare("gates", np.float32, 4 * count)
        both = biases.constant.reshape(2, -1).sum(axis=0, dtype=np.float32)
        self.assign(gates.name, self._make_constant(f"{node.input[3]}", both))
        self._add_linear(node.input[1], of_input.constant[0].T, source, gates)
        self._add_linear(node.input[2], of_hidden.constant[0].T, hidden, gates)
        self.statements.append(f"apply_gates({gates.name}, {count}, {hidden.name}, {cell.name});")
        return [hidden, hidden, cell]

    def _concat(self, node: onnx.NodeProto, inputs: list[Any], attributes: dict[str, Any]) -> list[Value]:
        array = self._declare("joined", inputs[0].dtype, sum(each.size for each in inputs))
        offset = 0
        for each in inputs:
            self.assign(array.name, each, offset)
            offset += each.size
        return [array]

    def _split(self, node: onnx.NodeProto, inputs: list[Any], attributes: dict[str, Any]) -> list[Value]:
        whole, count = inputs[0], len(node.output)
        sizes = inputs[1].constant.tolist() if len(inputs) > 1 else [whole.size // count] * count
        if not whole.name and len(inputs) > 1:
            whole = self._store(whole, "value")
        return [_take(whole, sum(sizes[:index]), size) for index, size in enumerate(sizes)]

    def _argmax(self, node: onnx.NodeProto, inputs: list[Any], attributes: dict[str, Any]) -> list[Value]:
        # Elements are of one array: what is split off another is copied, which names it.
        array = self._store(inputs[0], "logits")
        return [Value(lambda _: f"find_largest({array.name}, {array.size})", np.dtype(np.int64), 1)]

    def _cast(self, node: onnx.NodeProto, inputs: list[Any], attributes: dict[str, Any]) -> list[Value]:
        (value,), dtype = inputs, helper.tensor_dtype_to_np_dtype(attributes["to"])
        target = Value(value.element, dtype, value.size, constant=value.constant)
        if target.type == value.type:
            return [Value(value.element, dtype, value.size, value.name)]
        return [Value(lambda i: f"({target.type}){value.element(i)}", dtype, value.size)]

    def _greater(self, node: onnx.NodeProto, inputs: list[Any], attributes: dict[str, Any]) -> list[Value]:
        left, right = inputs
        return [Value(lambda i: f"({left.element(i)} > {right.element('0')})", np.dtype(bool), left.size)]

    def _one_hot(self, node: onnx.NodeProto, inputs: list[Any], attributes: dict[str, Any]) -> list[Value]:
        choice, depth, _ = inputs
        return [
            Value(lambda i: f"({choice.element('0')} == {i} ? 1.0f : 0.0f)", np.dtype(np.float32), int(depth.constant))
        ]

    def _gather(self, node: onnx.NodeProto, inputs: list[Any], attributes: dict[str, Any]) -> list[Value]:
        return [_take(inputs[0], int(inputs[1].constant), 1)]


def _take(value: Value, offset: int, size: int) -> Value:
    def element(index: str) -> str:
        if index.isdigit():
            return value.element(str(offset + int(index)))
        return value.element(f"{offset} + {index}" if offset else index)

    return Value(element, value.dtype, size)


_TRANSLATIONS = {
    "Gemm": Translation._gemm,
    "LSTM": Translation._lstm,
    "Concat": Translation._concat,
    "Split": Translation._split,
    "ArgMax": Translation._argmax,
    "Cast": Translation._cast,
    "Greater": Translation._greater,
    "OneHot": Translation._one_hot,
    "Gather": Translation._gather,
}


def count_weights(graph: onnx.GraphProto) -> int:
    """Return how many numbers the constants of a graph hold."""
    return sum(_count(each.dims) for each in graph.initializer)


def _count(dims: Iterable[int]) -> int:
    return int(np.prod(list(dims), dtype=np.int64))
