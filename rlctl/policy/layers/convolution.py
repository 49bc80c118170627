"""A 2-D convolution, and what is before it: the bytes of an image as numbers from 0 to 1."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING, Any

import numpy as np

from rlctl.policy.layers.layer import Array, Layer

if TYPE_CHECKING:
    from rlctl.policy.onnx_graph import Graph


@dataclasses.dataclass(slots=True)
class Convolution(Layer):
    """A 2-D convolution without padding."""

    weight: Array  # shape (outputs, channels, height, width)
    bias: Array
    stride: int

    def __call__(self, value: Array) -> Array:
        count, channels, height, width = self.weight.shape
        windows = np.lib.stride_tricks.sliding_window_view(value, (height, width), axis=(2, 3))
        windows = windows[:, :, :: self.stride, :: self.stride]
        pictures, _, high, wide = windows.shape[:4]
        patches = windows.transpose(0, 1, 4, 5, 2, 3).reshape(pictures, channels * height * width, high * wide)
        # A product of matrices for each picture: its bits do not depend on the other pictures.
        result = self.weight.reshape(count, -1) @ patches + self.bias[:, None]
        return result.reshape(pictures, count, high, wide)

    def write_onnx(self, graph: Graph, value: str) -> str:
        """Add it to a graph."""
        weight, bias = (graph.constant(f"{self.name}.{part}", getattr(self, part)) for part in ("weight", "bias"))
        shape, strides = list(self.weight.shape[2:]), [self.stride, self.stride]
        return graph.add("Conv", value, weight, bias, kernel_shape=shape, strides=strides)


@dataclasses.dataclass(slots=True)
class ScaleImage(Layer):
    """Scales the bytes of an image to [0, 1], and moves the channels first."""

    channels_last: bool

    def __call__(self, value: Any) -> Array:
        pixels = np.asarray(value).transpose(0, 3, 1, 2) if self.channels_last else np.asarray(value)
        return np.asarray(pixels, np.float32) / np.float32(255.0)

    def write_onnx(self, graph: Graph, value: str) -> str:
        """Add it to a graph."""
        if self.channels_last:
            value = graph.add("Transpose", value, perm=[0, 3, 1, 2])
        return graph.add("Div", value, graph.constant(self.name, np.float32(255.0)))
