"""What every layer has: a form in NumPy, one in ONNX and one in C."""

from __future__ import annotations

import abc
import dataclasses
from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from rlctl.errors import UsageError

if TYPE_CHECKING:  # acting needs neither onnx nor the writer of C
    from rlctl.policy.c_writer import CVector, CWriter
    from rlctl.policy.onnx_graph import Graph

Array = NDArray[Any]


@dataclasses.dataclass(slots=True)
class Layer(abc.ABC):
    """A function of one array.

    The first axis of every input and output is that of the rows, (k, ...). The bits of a row's output do not depend on
    the other rows. Arrays are not copied: new weights in shared memory take effect when `prepare` is called.
    """

    name: str  # the layer's name in SB3's `state_dict`, or its function

    @abc.abstractmethod
    def __call__(self, value: Any) -> Array:
        """Return the layer's output, a row for each row of the input."""

    def prepare(self) -> None:  # noqa: B027 (most layers have nothing to compute)
        """Compute values that depend only on the weights; call it again when the weights have changed."""

    @abc.abstractmethod
    def write_onnx(self, graph: Graph, value: str) -> str:
        """Add the layer to a graph, for a value of shape (batch, ...); return the output."""

    def count_outputs(self, inputs: int) -> int:
        """Return the number of outputs in C."""
        return inputs

    def write_c(self, writer: CWriter, source: CVector, target: CVector) -> None:
        """Write the layer as C: from one vector of numbers to another, which may be the same one.

        Raises `UsageError` for a layer of images.
        """
        writer.loop(source.size, f"{target.element} = {self.write_c_element(writer, source.element)};")

    def write_c_element(self, writer: CWriter, x: str) -> str:
        """Return a C expression: output `i`, for a layer whose outputs each depend on one input, `x`."""
        raise UsageError(f"export --c: {type(self).__name__} cannot be written as C; use export --onnx")


def multiply(rows: Array, weight: Array) -> Array:
    """Return the product of a matrix of shape (outputs, inputs) with each row, shape (k, outputs).

    BLAS has other code for a product of two matrices, whose last bits depend on where a row is in the matrix.
    """
    if len(rows) == 1:
        one: Array = rows.dot(weight.T)  # the same bits in half the time
        return one
    product: Array = np.matmul(weight, rows[:, :, None])[:, :, 0]
    return product


def as_row(vector: Array) -> Array:
    """Return a vector as a matrix of one row, which shares its memory.

    With rows of its own shape, NumPy calculates twice as fast as with a vector.
    """
    row: Array = vector[None]
    return row


def apply(layers: Iterable[Layer], value: Any) -> Array:
    """Apply layers one after the other."""
    for layer in layers:
        value = layer(value)
    return value
