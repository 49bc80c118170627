"""A fully connected layer."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING

from rlctl.policy.layers.layer import Array, Layer, as_row, multiply

if TYPE_CHECKING:
    from rlctl.policy.c_writer import CVector, CWriter
    from rlctl.policy.onnx_graph import Graph


@dataclasses.dataclass(slots=True)
class Linear(Layer):
    """A fully connected layer."""

    weight: Array  # shape (outputs, inputs)
    bias: Array
    _transposed: Array = dataclasses.field(init=False)
    _bias: Array = dataclasses.field(init=False)

    def __post_init__(self) -> None:
        self._transposed, self._bias = self.weight.T, as_row(self.bias)

    def __call__(self, value: Array) -> Array:
        # As `multiply` does, without the call.
        result: Array = value.dot(self._transposed) if len(value) == 1 else multiply(value, self.weight)
        result += self._bias
        return result

    def write_onnx(self, graph: Graph, value: str) -> str:
        """Add it to a graph."""
        weight, bias = (graph.constant(f"{self.name}.{part}", getattr(self, part)) for part in ("weight", "bias"))
        return graph.add("Gemm", value, weight, bias, transB=1)

    def count_outputs(self, inputs: int) -> int:
        """Return the number of outputs."""
        return len(self.bias)

    def write_c(self, writer: CWriter, source: CVector, target: CVector) -> None:
        """Write it as C; the two vectors must differ."""
        writer.loop(target.size, f"{target.element} = {writer.constant('bias', self.bias)};")
        writer.add_product(self.weight, source, target)


# Weights are stored input by input: the sums of the inner loop are independent, so compilers use SIMD.
C_FUNCTIONS = {
    "apply_linear": """\
static void apply_linear(const float *RESTRICT weight, const float *RESTRICT input, int inputs,
                         float *RESTRICT output, int outputs)
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
"""
}
