"""sb3-contrib's batch renormalisation."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING

import numpy as np

from rlctl.policy.layers.layer import Array, Layer

if TYPE_CHECKING:
    from rlctl.policy.c_writer import CWriter
    from rlctl.policy.onnx_graph import Graph


@dataclasses.dataclass(slots=True)
class BatchRenorm(Layer):
    """sb3-contrib's batch renormalisation in evaluation mode."""

    mean: Array
    variance: Array
    scale: Array
    bias: Array
    epsilon: np.float32

    @property
    def deviation(self) -> Array:
        """The standard deviations by which it divides."""
        deviation: Array = np.sqrt(self.variance + self.epsilon)
        return deviation

    def __call__(self, value: Array) -> Array:
        # As one multiplication and addition, a mean much larger than its deviation would lose digits.
        return self.scale * ((value - self.mean) / self.deviation) + self.bias

    def write_onnx(self, graph: Graph, value: str) -> str:
        """Add it to a graph."""
        value = graph.add("Sub", value, graph.constant(f"{self.name}.ra_mean", self.mean))
        value = graph.add("Div", value, graph.constant(f"{self.name}.deviation", self.deviation))
        value = graph.add("Mul", value, graph.constant(f"{self.name}.scale", self.scale))
        return graph.add("Add", value, graph.constant(f"{self.name}.bias", self.bias))

    def write_c_element(self, writer: CWriter, x: str) -> str:
        """Return the C expression of an output."""
        deviation = writer.constant("deviation", self.deviation)
        centred = f"({x} - {writer.constant('mean', self.mean)}) / {deviation}"
        return f"{centred} * {writer.constant('scale', self.scale)} + {writer.constant('bias', self.bias)}"
