"""One-hot encoding of discrete values."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING, Any

import numpy as np

from rlctl.policy.layers.layer import Array, Layer

if TYPE_CHECKING:
    from rlctl.policy.c_writer import CVector, CWriter
    from rlctl.policy.onnx_graph import Graph


@dataclasses.dataclass(slots=True)
class OneHot(Layer):
    """One-hot encoding of discrete values."""

    sizes: Array  # number of choices of each discrete value; shape () for a single one
    _offsets: Array = dataclasses.field(init=False)
    _total: int = dataclasses.field(init=False)

    def __post_init__(self) -> None:
        sizes = self.sizes.ravel()
        self._offsets, self._total = np.cumsum(sizes) - sizes, int(sizes.sum())

    def __call__(self, value: Any) -> Array:
        count = len(value)
        result = np.zeros((count, self._total), np.float32)
        result[np.arange(count)[:, None], self._offsets + np.reshape(value, (count, -1))] = 1.0
        return result

    def write_onnx(self, graph: Graph, value: str) -> str:
        """Add it to a graph."""
        levels = graph.constant(f"{self.name}/levels", np.array([0.0, 1.0], np.float32))
        if self.sizes.ndim == 0:
            return graph.add("OneHot", value, graph.constant(f"{self.name}/depth", np.int64(self.sizes)), levels)
        parts = []
        for index, size in enumerate(self.sizes.tolist()):
            column = graph.add("Gather", value, graph.constant(f"{self.name}/{index}", np.int64(index)), axis=1)
            depth = graph.constant(f"{self.name}/{index}/depth", np.int64(size))
            parts.append(graph.add("OneHot", column, depth, levels))
        return graph.concatenate(parts)

    def count_outputs(self, inputs: int) -> int:
        """Return the number of choices of all values."""
        return self._total

    def write_c(self, writer: CWriter, source: CVector, target: CVector) -> None:
        """Write it as C; the two vectors must differ."""
        for number, count in enumerate(self.sizes.ravel().tolist()):
            chosen = f"(int){source.name}[{source.start + number}] == i"
            writer.loop(count, f"{target.element} = {chosen} ? 1.0f : 0.0f;")
            target = target.skip(count)
