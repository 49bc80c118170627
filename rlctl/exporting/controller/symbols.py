"""Values in code that is being written. A term computes with them as with arrays, so its formula is written once."""

import abc
from collections.abc import Sequence
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from rlctl.policy.onnx_graph import Graph

_C = {
    "add": "({} + {})",
    "subtract": "({} - {})",
    "multiply": "({} * {})",
    "divide": "({} / {})",
    "sqrt": "sqrt({})",
    "sin": "sin({})",
    "cos": "cos({})",
    "floor": "floor({})",
    "arctan": "atan({})",
    "minimum": "fmin({}, {})",
    "maximum": "fmax({}, {})",
}
_ONNX = {
    "subtract": "Sub",
    "multiply": "Mul",
    "divide": "Div",
    "arctan": "Atan",
    "minimum": "Min",
    "maximum": "Max",
}

_IN_SINGLE = ("arctan",)  # functions that onnxruntime has in float32 only


class Symbol(np.lib.mixins.NDArrayOperatorsMixin, abc.ABC):
    """A value of shape (..., size). Operators and functions of NumPy call `apply` with the function's name."""

    size: int

    @property
    def shape(self) -> tuple[int]:
        """The length of the last axis, as the shape of an array ends with it."""
        return (self.size,)

    def __array_ufunc__(self, ufunc: np.ufunc, method: str, *operands: Any, **options: Any) -> Any:
        if method != "__call__" or options:
            return NotImplemented
        return self.apply(ufunc.__name__, operands)

    def __getitem__(self, key: tuple[Any, slice]) -> Self:
        return self.take(range(*key[1].indices(self.size)))

    @abc.abstractmethod
    def apply(self, function: str, operands: Sequence[Any]) -> Self:
        """Return the result of a function of symbols and numbers, element by element."""

    @abc.abstractmethod
    def take(self, elements: range) -> Self:
        """Return some elements."""

    @abc.abstractmethod
    def look_up(self, table: NDArray[np.float64]) -> Self:
        """Return the row of a table, shape (rows, size), whose number this is: a whole number within it."""


class CSymbol(Symbol):
    """Expressions in C, of type double."""

    def __init__(self, elements: Sequence[str], tables: "CTables | None" = None) -> None:
        self.elements, self.size = elements, len(elements)
        self._tables = tables

    def apply(self, function: str, operands: Sequence[Any]) -> "CSymbol":
        """Return an expression per element."""
        columns = [
            operand.elements if isinstance(operand, CSymbol) else [repr(float(x)) for x in np.atleast_1d(operand)]
            for operand in operands
        ]
        size = max(map(len, columns))
        form = _C[function]
        tables = next((operand._tables for operand in operands if isinstance(operand, CSymbol)), None)
        return CSymbol([form.format(*(column[i % len(column)] for column in columns)) for i in range(size)], tables)

    def take(self, elements: range) -> "CSymbol":
        """Return some expressions."""
        return CSymbol([self.elements[index] for index in elements], self._tables)

    def look_up(self, table: NDArray[np.float64]) -> "CSymbol":
        """Return expressions that read a constant array."""
        assert self._tables is not None
        name, size = self._tables.add(table), table.shape[1]
        row = f"{name} + {size} * (int){self.elements[0]}"
        return CSymbol([f"({row})[{index}]" for index in range(size)], self._tables)


class CTables:
    """The constant arrays that expressions in C read; equal tables are one array."""

    def __init__(self) -> None:
        self.arrays: dict[bytes, tuple[str, NDArray[np.float64]]] = {}

    def add(self, table: NDArray[np.float64]) -> str:
        """Return the name of the array of a table."""
        key = table.tobytes()
        if key not in self.arrays:
            self.arrays[key] = f"table_{len(self.arrays) + 1}", table
        return self.arrays[key][0]


class GraphSymbol(Symbol):
    """A value of shape (batch, size) in an ONNX graph, in float64."""

    def __init__(self, graph: Graph, value: str, size: int) -> None:
        self.graph, self.value, self.size = graph, value, size

    def apply(self, function: str, operands: Sequence[Any]) -> "GraphSymbol":
        """Add a node."""
        graph, names, sizes = self.graph, [], [1]
        for operand in operands:
            if isinstance(operand, GraphSymbol):
                names.append(operand.value)
                sizes.append(operand.size)
            else:
                numbers = np.atleast_1d(np.asarray(operand, np.float64))
                names.append(graph.constant(f"term/{graph.count_constants()}", numbers))
                sizes.append(len(numbers))
        if function in _IN_SINGLE:
            names = [graph.cast(name, np.float32) for name in names]
        value = graph.add(_ONNX.get(function, function.capitalize()), *names)
        if function in _IN_SINGLE:
            value = graph.cast(value, np.float64)
        return GraphSymbol(graph, value, max(sizes))

    def take(self, elements: range) -> "GraphSymbol":
        """Add a node that selects elements."""
        indices = self.graph.constant(f"term/{self.graph.count_constants()}", np.array(elements, np.int64))
        return GraphSymbol(self.graph, self.graph.add("Gather", self.value, indices, axis=1), len(elements))

    def look_up(self, table: NDArray[np.float64]) -> "GraphSymbol":
        """Add nodes that select a row."""
        graph = self.graph
        first = graph.constant(f"term/{graph.count_constants()}", np.array(0, np.int64))
        rows = graph.add("Gather", graph.cast(self.value, np.int64), first, axis=1)  # shape (batch,)
        values = graph.constant(f"term/{graph.count_constants()}", table)
        return GraphSymbol(graph, graph.add("Gather", values, rows, axis=0), table.shape[1])
