"""An LSTM, the one layer with a state."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING

import numpy as np

from rlctl.policy.layers.activation import sigmoid
from rlctl.policy.layers.layer import Array, multiply

if TYPE_CHECKING:
    from rlctl.policy.c_writer import CVector, CWriter
    from rlctl.policy.onnx_graph import Graph


@dataclasses.dataclass(slots=True)
class LstmLayer:
    """Weights of torch's LSTM, shape (4 x hidden, ...): the gates input, forget, cell and output, stacked."""

    of_input: Array
    of_hidden: Array
    biases: list[Array]  # two, shape (4 x hidden,); or none


@dataclasses.dataclass(slots=True)
class Lstm:
    """The layers of an LSTM."""

    name: str
    layers: list[LstmLayer]

    @property
    def hidden_size(self) -> int:
        """The number of outputs of each layer."""
        return int(self.layers[0].of_hidden.shape[1])

    def make_state(self, count: int) -> Array:
        """Return the state at the begin of `count` episodes: hidden and cell, shape (count, 2, layers, hidden)."""
        return np.zeros((count, 2, len(self.layers), self.hidden_size), np.float32)

    def step(self, value: Array, state: Array) -> Array:
        """Advance the states of the rows by one step, and return the output of the last layer, shape (k, hidden)."""
        for number, layer in enumerate(self.layers):
            hidden, cell = state[:, 0, number], state[:, 1, number]
            gates = multiply(value, layer.of_input) + multiply(hidden, layer.of_hidden)
            for bias in layer.biases:
                gates += bias
            i, f, g, o = np.split(gates, 4, axis=1)
            cell[:] = sigmoid(f) * cell + sigmoid(i) * np.tanh(g)
            value = hidden[:] = sigmoid(o) * np.tanh(cell)
        return value

    def write_onnx(self, graph: Graph, value: str, state: tuple[str, str]) -> tuple[str, tuple[str, str]]:
        """Add one step to a graph, for a value of shape (batch, size).

        `state` names the hidden and the cell state, each of shape (layers, batch, hidden). Returns the value, of shape
        (batch, hidden), and the next state.
        """
        time, count = graph.constant(f"{self.name}.time", np.array([0])), len(self.layers)
        before = [graph.add_with_outputs("Split", [part], count, axis=0) if count > 1 else [part] for part in state]
        sequence = graph.add("Unsqueeze", value, time)
        after: list[list[str]] = [[], []]
        for number, layer in enumerate(self.layers):
            constants = _add_constants(graph, layer, f"{self.name}.{number}")
            inputs = [sequence, *constants, "", *(part[number] for part in before)]
            outputs, hidden, cell = graph.add_with_outputs("LSTM", inputs, 3, hidden_size=self.hidden_size)
            sequence = graph.add("Squeeze", outputs, graph.constant(f"{self.name}.direction", np.array([1])))
            after[0].append(hidden)
            after[1].append(cell)
        joined = [graph.add("Concat", *parts, axis=0) if count > 1 else parts[0] for parts in after]
        return graph.add("Squeeze", sequence, time), (joined[0], joined[1])

    def write_c(self, writer: CWriter, source: CVector) -> CVector:
        """Write one step as C, whose state is in `state->hidden` and `state->cell`; return the output."""
        count = self.hidden_size
        for number, layer in enumerate(self.layers):
            hidden, cell = (writer.point_to(f"state->{member}", number * count, count) for member in ("hidden", "cell"))
            gates = writer.declare("gates", 4 * count)
            bias = np.sum(layer.biases, axis=0) if layer.biases else np.zeros(4 * count)
            writer.loop(4 * count, f"{gates.element} = {writer.constant('bias', bias)};")
            writer.add_product(layer.of_input, source, gates)
            writer.add_product(layer.of_hidden, hidden, gates)
            writer.statements.append(f"apply_gates({gates.name}, {count}, {hidden.name}, {cell.name});")
            source = hidden
        return source


def _add_constants(graph: Graph, layer: LstmLayer, name: str) -> list[str]:
    """Add input weights, recurrent weights and biases of a layer, with ONNX's leading dimension of directions."""
    weights = [_reorder_gates(weight) for weight in (layer.of_input, layer.of_hidden)]
    biases = [_reorder_gates(bias) for bias in layer.biases] or [np.zeros(len(weights[0]), np.float32)] * 2
    arrays = {"weight_ih": weights[0], "weight_hh": weights[1], "bias": np.concatenate(biases)}
    return [graph.constant(f"{name}.{part}", array[None]) for part, array in arrays.items()]


def _reorder_gates(values: Array) -> Array:
    """Change torch's order of gates (input, forget, cell, output) to ONNX's (input, output, forget, cell)."""
    i, f, c, o = np.split(values, 4)
    return np.concatenate([i, o, f, c])


# The order of the gates is input, forget, cell, output.
C_FUNCTIONS = {
    "apply_gates": """\
static void apply_gates(const float *gates, int count, float *hidden, float *cell)
{
    for (int i = 0; i < count; ++i) {
        const float remembered = sigmoid(gates[count + i]) * cell[i];
        cell[i] = remembered + sigmoid(gates[i]) * hyperbolic_tangent(gates[2 * count + i]);
        hidden[i] = sigmoid(gates[3 * count + i]) * hyperbolic_tangent(cell[i]);
    }
}
"""
}
