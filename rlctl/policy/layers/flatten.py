"""Flattens what is observed."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING, Any

import numpy as np

from rlctl.policy.layers.layer import Array, Layer

if TYPE_CHECKING:
    from rlctl.policy.c_writer import CWriter
    from rlctl.policy.onnx_graph import Graph


@dataclasses.dataclass(slots=True)
class Flatten(Layer):
    """Flattens each row to one dimension, in float32."""

    def __call__(self, value: Any) -> Array:
        flat = np.asarray(value, np.float32)
        return flat if flat.ndim == 2 else flat.reshape(len(flat), -1)

    def write_onnx(self, graph: Graph, value: str) -> str:
        """Add it to a graph."""
        return graph.add("Flatten", value, axis=1)

    def write_c_element(self, writer: CWriter, x: str) -> str:
        """Return the element itself."""
        return x
