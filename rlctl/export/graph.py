"""Builds one ONNX graph, node by node."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import helper, numpy_helper

import rlctl
from rlctl.errors import UsageError

OPSET = 17
"""Read by onnxruntime 1.12 and newer."""
IR_VERSION = 8
"""The one that belongs to the opset; the onnx package would write its newest, which older runtimes refuse."""
BATCH = "batch"
"""Name of the dynamic dimension."""


class Graph:
    """A graph that grows by `add`; values are known by their names.

    Inputs and outputs have the names a caller sees. Everything inside starts with a slash, so the two never meet.
    """

    def __init__(self) -> None:
        self._nodes: list[onnx.NodeProto] = []
        self._constants: dict[str, onnx.TensorProto] = {}
        self._inputs: list[onnx.ValueInfoProto] = []
        self._outputs: list[onnx.ValueInfoProto] = []

    def input(self, name: str, dtype: Any, shape: Sequence[int | str], meaning: str) -> str:
        """Add an input; raises `UsageError` if its name is taken, as a dict observation may have any key."""
        if not name or name.startswith("/") or name in (each.name for each in self._inputs):
            raise UsageError(f"export: an observation cannot be named {name!r} in an ONNX file")
        self._inputs.append(helper.make_tensor_value_info(name, _find_type(dtype), list(shape), meaning))
        return name

    def constant(self, name: str, value: Any) -> str:
        """Add a constant array and return its name."""
        array: NDArray[Any] = np.asarray(value)
        name = f"/{name}"
        self._constants[name] = numpy_helper.from_array(np.array(array, order="C"), name)
        return name

    def add(self, operator: str, *inputs: str, **attributes: Any) -> str:
        """Add a node with one output and return the output's name."""
        return self.add_with_outputs(operator, inputs, 1, **attributes)[0]

    def add_with_outputs(self, operator: str, inputs: Sequence[str], count: int, **attributes: Any) -> list[str]:
        """Add a node and return the names of its outputs; an input named "" is left out."""
        name = f"/{operator}_{len(self._nodes)}"
        outputs = [name if count == 1 else f"{name}.{index}" for index in range(count)]
        self._nodes.append(helper.make_node(operator, list(inputs), outputs, name=name, **attributes))
        return outputs

    def cast(self, value: str, dtype: Any) -> str:
        """Add a conversion to a numpy dtype."""
        return self.add("Cast", value, to=_find_type(dtype))

    def output(self, value: str, name: str, dtype: Any, shape: Sequence[int | str], meaning: str) -> None:
        """Make a value an output, under a name."""
        if name in (each.name for each in self._inputs):
            raise UsageError(f"export: an observation cannot be named {name!r} in an ONNX file, an output is")
        for node in self._nodes:
            for names in (node.input, node.output):
                names[:] = [name if each == value else each for each in names]
        self._outputs.append(helper.make_tensor_value_info(name, _find_type(dtype), list(shape), meaning))

    def model(self, metadata: Mapping[str, str], meaning: str) -> onnx.ModelProto:
        """Return the checked model; raises onnx's `ValidationError` if the graph makes no sense."""
        graph = helper.make_graph(
            self._nodes, "policy", self._inputs, self._outputs, list(self._constants.values()), meaning
        )
        model = helper.make_model(
            graph,
            producer_name="rlctl",
            producer_version=rlctl.__version__,
            opset_imports=[helper.make_opsetid("", OPSET)],
            ir_version=IR_VERSION,
        )
        helper.set_model_props(model, dict(metadata))
        onnx.checker.check_model(model, full_check=True)
        return model


def unsupported(what: str) -> UsageError:
    """Return the error for a part of a policy that has no translation."""
    return UsageError(f"export: {what} cannot be written as ONNX yet")


def _find_type(dtype: Any) -> int:
    return int(helper.np_dtype_to_tensor_dtype(np.dtype(dtype)))
