"""Writes the statements of a C function, and the constants that they use."""

import dataclasses
from collections import Counter
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

_PER_LINE = 8


@dataclasses.dataclass(frozen=True)
class CVector:
    """Elements of a C array that follow one another."""

    name: str  # of the array, or an expression that points to one
    start: int  # the first element
    size: int

    @property
    def element(self) -> str:
        """Element `i` of the vector as an expression."""
        return f"{self.name}[{self.start} + i]" if self.start else f"{self.name}[i]"

    def skip(self, count: int) -> "CVector":
        """Return what follows the first elements."""
        return dataclasses.replace(self, start=self.start + count, size=self.size - count)


class CWriter:
    """Collects statements, and definitions of constants."""

    def __init__(self) -> None:
        self.statements: list[str] = []
        self.constants: list[str] = []  # definitions of the arrays that the statements use
        self._numbers: Counter[str] = Counter()

    def loop(self, count: int, statement: str) -> None:
        """Add a loop of one statement over `i` below `count`."""
        self.statements += [f"for (int i = 0; i < {count}; ++i) {{", f"    {statement}", "}"]

    def declare(self, name: str, size: int) -> CVector:
        """Add an array of floats whose name begins with `name`."""
        name = self._number(name)
        self.statements.append(f"float {name}[{size}];")
        return CVector(name, 0, size)

    def point_to(self, array: str, start: int, size: int) -> CVector:
        """Return a vector whose name is a pointer to its first element."""
        return CVector(f"{array} + {start}", 0, size)

    def constant(self, name: str, values: NDArray[Any], kind: str = "float") -> str:
        """Return element `i` of a constant array; a number if all elements are equal."""
        flat = values.ravel()
        if (flat == flat[0]).all():
            return write_number(flat[0], kind)
        return f"{self._define(name, flat, kind)}[i]"

    def number(self, value: float, kind: str) -> str:
        """Return a C literal with exactly this value."""
        return write_number(value, kind)

    def add_product(self, weight: NDArray[Any], source: CVector, target: CVector) -> None:
        """Add the product of a matrix, shape (outputs, inputs), with a vector to another vector."""
        constant = self._define("weight", weight.T.ravel())
        self.statements.append(f"apply_linear({constant}, {source.name}, {source.size}, {target.name}, {len(weight)});")

    def _define(self, name: str, values: NDArray[Any], kind: str = "float") -> str:
        name = self._number(name)
        numbers = [write_number(value, kind) for value in values]
        self.constants.append(write_array(f"static const {kind} {name}", numbers))
        return name

    def _number(self, name: str) -> str:
        self._numbers[name] += 1
        return f"{name}_{self._numbers[name]}"


def write_array(declaration: str, values: Sequence[str]) -> str:
    """Return the definition of an array; `declaration` is its type and name."""
    body = ",\n    ".join(", ".join(values[low : low + _PER_LINE]) for low in range(0, len(values), _PER_LINE))
    return f"{declaration}[{len(values)}] = {{\n    {body},\n}};\n"


def write_number(value: Any, kind: str) -> str:
    """Return a C literal with exactly the value of a number."""
    if kind == "int":
        return str(int(value))
    if np.isinf(value):
        return "INFINITY" if value > 0 else "-INFINITY"
    return f"{np.float32(value)!s}f" if kind == "float" else repr(float(value))
