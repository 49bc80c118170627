"""Builds an ONNX graph node by node."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import onnx
from onnx import helper, numpy_helper

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

    def concatenate(self, parts: Sequence[str]) -> str:
        """Join values of shape (batch, size)."""
        return self.add("Concat", *parts, axis=1) if len(parts) > 1 else parts[0]

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
