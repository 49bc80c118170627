"""Normalisation of observations, the same when acting, when learning and in exported files."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING

import numpy as np

from rlctl.policy.layers.layer import Array, Layer, as_row

if TYPE_CHECKING:
    from rlctl.policy.c_writer import CWriter
    from rlctl.policy.onnx_graph import Graph

_ENDS = {"low": -1, "high": 1}


def standardize(values: Array, mean: Array, deviation: Array, low: Array | float, high: Array | float) -> None:
    """Turn values into their difference from the mean in standard deviations, clipped to [low, high]; in place."""
    values -= mean
    values /= deviation
    np.minimum(values, high, out=values)
    np.maximum(values, low, out=values)


@dataclasses.dataclass(slots=True)
class Normalize(Layer):
    """Normalisation of an observation by its running mean and variance.

    In float64 as VecNormalize: an element with little variance is multiplied by up to 10,000.
    """

    mean: Array
    variance: Array
    clip: float
    epsilon: float = 1e-8  # what SB3's VecNormalize adds to the variance
    _mean: Array = dataclasses.field(init=False)
    _deviation: Array = dataclasses.field(init=False)
    _high: Array = dataclasses.field(init=False)
    _low: Array = dataclasses.field(init=False)

    def __post_init__(self) -> None:
        self._mean = as_row(self.mean)
        # Arrays, because NumPy takes twice as long for a scalar and so few elements.
        self._high = np.full(self._mean.shape, self.clip)
        self._low = -self._high
        self.prepare()

    def prepare(self) -> None:
        """Compute the standard deviation from the variance."""
        self._deviation = as_row(np.sqrt(self.variance + self.epsilon))

    def __call__(self, value: Array) -> Array:
        normalized: Array = value.astype(np.float64)  # a subtraction of two types takes longer
        standardize(normalized, self._mean, self._deviation, self._low, self._high)
        return normalized.astype(np.float32)

    def write_onnx(self, graph: Graph, value: str) -> str:
        """Add it to a graph."""
        value = graph.cast(value, np.float64)
        value = graph.add("Sub", value, graph.constant(f"{self.name}/mean", np.float64(self.mean)))
        deviation = np.sqrt(np.float64(self.variance) + self.epsilon)
        value = graph.add("Div", value, graph.constant(f"{self.name}/deviation", deviation))
        low, high = (graph.constant(f"{self.name}/{end}", np.float64(at * self.clip)) for end, at in _ENDS.items())
        return graph.cast(graph.add("Clip", value, low, high), np.float32)

    def write_c_element(self, writer: CWriter, x: str) -> str:
        """Return the C expression of an output."""
        deviation = writer.constant("deviation", np.sqrt(self.variance + self.epsilon), "double")
        value = f"((double){x} - {writer.constant('mean', self.mean, 'double')}) / {deviation}"
        if np.isfinite(self.clip):
            low, high = (writer.number(at * self.clip, "double") for at in _ENDS.values())
            value = f"bound({value}, {low}, {high})"
        return f"(float)({value})"
