"""Nodes of a graph as expressions in C: the elements of arrays, one by one, so that loops can be written over them."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

_NUMBERS = {"float32": "float", "float64": "double"}


def c_type(dtype: Any) -> str:
    """Return the C type of a numpy dtype; whole numbers and truth values are int."""
    return _NUMBERS.get(np.dtype(dtype).name, "int")


def literal(value: Any, dtype: Any) -> str:
    """Return a number as C reads it back, bit for bit."""
    kind = c_type(dtype)
    if kind == "int":
        return str(int(value))
    if np.isinf(value):
        return "INFINITY" if value > 0 else "(-INFINITY)"
    text = str(np.float32(value)) if kind == "float" else repr(float(value))
    text = f"{text}f" if kind == "float" else text
    return f"({text})" if text.startswith("-") else text


@dataclasses.dataclass(frozen=True)
class Value:
    """An array: `element` writes the element at an index."""

    element: Callable[[str], str]
    dtype: np.dtype[Any]
    size: int
    name: str = ""
    """Name of the C array that holds it; empty while it is an expression."""
    constant: NDArray[Any] | None = None

    @property
    def type(self) -> str:
        return c_type(self.dtype)


def name_array(name: str, dtype: Any, size: int, offset: int = 0) -> Value:
    """Return the value of a C array, or of a part of it."""
    return Value(lambda i: f"{name}[{add_offset(offset, i)}]", np.dtype(dtype), size, "" if offset else name)


def add_offset(offset: int, index: str) -> str:
    """Return an index further on."""
    if offset == 0:
        return index
    return str(offset + int(index)) if index.isdigit() else f"{offset} + {index}"


HELPERS = {
    # expf is several times as fast as tanhf; the difference of the two is below 2e-7.
    "hyperbolic_tangent": "static float hyperbolic_tangent(float x)\n{\n"
    "    return 1.0f - 2.0f / (expf(2.0f * x) + 1.0f);\n}\n",
    "sigmoid": "static float sigmoid(float x)\n{\n    return 1.0f / (1.0f + expf(-x));\n}\n",
    "relu": "static float relu(float x)\n{\n    return x < 0.0f ? 0.0f : x;\n}\n",
    "leaky_relu": "static float leaky_relu(float x, float slope)\n{\n    return x < 0.0f ? slope * x : x;\n}\n",
    "elu": "static float elu(float x, float scale)\n{\n    return x < 0.0f ? scale * expm1f(x) : x;\n}\n",
    # Comparisons that are false for NaN, so that it is passed on and not turned into a bound.
    "at_least": "static float at_least(float x, float low)\n{\n    return x < low ? low : x;\n}\n",
    "at_most": "static float at_most(float x, float high)\n{\n    return x > high ? high : x;\n}\n",
    "at_least_double": "static double at_least_double(double x, double low)\n{\n    return x < low ? low : x;\n}\n",
    "at_most_double": "static double at_most_double(double x, double high)\n{\n    return x > high ? high : x;\n}\n",
    "find_largest": """static int find_largest(const float *values, int count)
{
    int largest = 0;
    for (int i = 1; i < count; ++i) {
        if (values[i] > values[largest]) {
            largest = i;
        }
    }
    return largest;
}
""",
    # Weights lie input by input: the inner loop has independent sums, which compilers make SIMD instructions of.
    "apply_linear": """static void apply_linear(const float *restrict weight, const float *restrict input, int inputs,
                         float *restrict output, int outputs)
{
    int i = 0;
    for (; i + 4 <= inputs; i += 4) {
        const float *row = weight + (long)i * outputs;
        const float a = input[i], b = input[i + 1], c = input[i + 2], d = input[i + 3];
        for (int j = 0; j < outputs; ++j) {
            output[j] += (a * row[j] + b * row[outputs + j]) + (c * row[2 * outputs + j] + d * row[3 * outputs + j]);
        }
    }
    for (; i < inputs; ++i) {
        const float *row = weight + (long)i * outputs;
        for (int j = 0; j < outputs; ++j) {
            output[j] += input[i] * row[j];
        }
    }
}
""",
    # Gates in the order input, output, forget, cell.
    "apply_gates": """static void apply_gates(const float *gates, int count, float *hidden, float *cell)
{
    for (int i = 0; i < count; ++i) {
        const float kept = sigmoid(gates[2 * count + i]) * cell[i];
        cell[i] = kept + sigmoid(gates[i]) * hyperbolic_tangent(gates[3 * count + i]);
        hidden[i] = sigmoid(gates[count + i]) * hyperbolic_tangent(cell[i]);
    }
}
""",
}
"""Functions that a source file gets if it calls them, in the order in which they stand there."""
NEEDED_BY = {"apply_gates": ("sigmoid", "hyperbolic_tangent")}

Expression = Callable[..., str]
Attributes = Mapping[str, Any]


def _of_type(name: str) -> Expression:
    return lambda kind, x, y, **_: f"{name}{'_double' if kind == 'double' else ''}({x}, {y})"


ELEMENTWISE: dict[str, Expression] = {
    "Add": lambda kind, x, y: f"({x} + {y})",
    "Sub": lambda kind, x, y: f"({x} - {y})",
    "Mul": lambda kind, x, y: f"({x} * {y})",
    "Div": lambda kind, x, y: f"({x} / {y})",
    "Max": _of_type("at_least"),
    "Min": _of_type("at_most"),
    "Clip": lambda kind, x, low, high: _of_type("at_most")(kind, _of_type("at_least")(kind, x, low), high),
    "Tanh": lambda kind, x: f"hyperbolic_tangent({x})",
    "Relu": lambda kind, x: f"relu({x})",
    "Sigmoid": lambda kind, x: f"sigmoid({x})",
    "Erf": lambda kind, x: f"erff({x})",
    "Elu": lambda kind, x, alpha: f"elu({x}, {literal(alpha, np.float32)})",
    "LeakyRelu": lambda kind, x, alpha: f"leaky_relu({x}, {literal(alpha, np.float32)})",
}
"""Operators on every element; each gets the C type, its operands and its attributes."""
UNCHANGED = ("Flatten", "Reshape", "Squeeze", "Unsqueeze")
"""Operators that change the shape of one observation's array, and not its elements."""
