"""Clips to a range."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING

import numpy as np

from rlctl.policy.layers.layer import Array, Layer

if TYPE_CHECKING:
    from rlctl.policy.c_writer import CWriter
    from rlctl.policy.onnx_graph import Graph

_ENDS = {"low": -1, "high": 1}


@dataclasses.dataclass(slots=True)
class Clip(Layer):
    """Clips to [-limit, limit]."""

    limit: float

    def __call__(self, value: Array) -> Array:
        return np.clip(value, -self.limit, self.limit)

    def write_onnx(self, graph: Graph, value: str) -> str:
        """Add it to a graph."""
        low, high = (graph.constant(f"{self.name}.{end}", np.float32(at * self.limit)) for end, at in _ENDS.items())
        return graph.add("Clip", value, low, high)

    def write_c_element(self, writer: CWriter, x: str) -> str:
        """Return the C expression of an output."""
        return f"(float)bound({x}, {-self.limit!r}, {self.limit!r})"


# These comparisons are false for NaN: the result is NaN, not a bound.
C_FUNCTIONS = {
    "bound": """\
static double bound(double x, double low, double high)
{
    return x < low ? low : x > high ? high : x;
}
"""
}
