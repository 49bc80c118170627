"""Multi-layer perceptrons in NumPy whose gradients are computed without autograd, and without torch.

The networks of robot learning are so small that autograd's overhead takes longer than their arithmetic. It also
computes unneeded gradients, e.g. of the critic's weights in the actor's update. NumPy's matrix products are up to twice
as fast as torch's on AMD processors, and a NumPy call takes a third of the time.
"""

import functools
import itertools
import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float32]
ArrayShapes = list[tuple[int, ...]]

LOG_SQRT_TAU = 0.5 * math.log(2 * math.pi)  # minus the logarithm of the standard normal density at 0
_ALIGNMENT = 16  # [floats], a cache line


def list_shapes(sizes: Sequence[int], networks: int = 1) -> ArrayShapes:
    """Return the shapes of weight and bias per layer; `sizes`: of the inputs, and of the outputs of each layer."""
    shapes: ArrayShapes = []
    for inputs, outputs in itertools.pairwise(sizes):
        shapes += [(networks, outputs, inputs), (networks, 1, outputs)]
    return shapes


def count_floats(shapes: ArrayShapes) -> int:
    """Return the length of the vector that `split_vector` needs."""
    return sum(-(-math.prod(shape) // _ALIGNMENT) * _ALIGNMENT for shape in shapes)


def split_vector(vector: Floats, shapes: ArrayShapes) -> list[Floats]:
    """Return parts of a vector as arrays of the given shapes, which share its memory."""
    parts, first = [], 0
    for shape in shapes:
        parts.append(vector[first : first + math.prod(shape)].reshape(shape))
        first += count_floats([shape])
    return parts


class MlpStack:
    """Perceptrons of equal shape: linear layers with tanh or ReLU after each except the last.

    Arrays have the shape (networks, batch, size); inputs of shape (1, batch, size) are used by all. `parameters` are
    weight and bias of each layer, shaped as `list_shapes` returns.
    """

    def __init__(self, parameters: Sequence[Floats], *, uses_tanh: bool) -> None:
        self._weights, self._biases = parameters[::2], parameters[1::2]
        self._uses_tanh = uses_tanh
        self._buffers: dict[tuple[str, int], list[Floats]] = {}

    def select(self, network: int) -> "MlpStack":
        """Return a stack of one of the networks; the parameters share memory."""
        pairs = zip(self._weights, self._biases, strict=True)
        parameters = [part[network : network + 1] for pair in pairs for part in pair]
        return MlpStack(parameters, uses_tanh=self._uses_tanh)

    def run(self, inputs: Floats, use: str) -> list[Floats]:
        """Return the inputs and the output of each layer. The next run with the same `use` overwrites these arrays."""
        values = [inputs, *self._get_buffers(use, inputs.shape[1])]
        for index in range(len(self._weights)):
            self._run_layer(index, values[index], values[index + 1], self._weights[index], self._biases[index])
        return values

    def read_latent(self, values: list[Floats]) -> Floats:
        """Return the inputs of the last layer."""
        return values[-2]

    def _run_layer(self, index: int, inputs: Floats, output: Floats, weight: Floats, bias: Floats) -> None:
        np.matmul(inputs, weight.swapaxes(1, 2), out=output)
        output += bias
        is_hidden = index + 1 < len(self._weights)
        if is_hidden and self._uses_tanh:
            np.tanh(output, out=output)
        elif is_hidden:
            np.maximum(output, _make_zeros(output.shape), out=output)  # with a scalar it takes four times as long

    def _get_buffers(self, use: str, batch: int) -> list[Floats]:
        if (use, batch) not in self._buffers:
            shapes = [(bias.shape[0], batch, bias.shape[2]) for bias in self._biases]
            self._buffers[use, batch] = [np.empty(shape, np.float32) for shape in shapes]
        return self._buffers[use, batch]

    def backpropagate(
        self, values: list[Floats], gradient: Floats, gradients: Sequence[Floats], *, latent: Floats | None = None
    ) -> None:
        """Set `gradients` of the parameters from the outputs' gradient, and from `latent`, of the last hidden layer.

        Overwrites the hidden layers in `values`, which `run` returned; rows after those of `gradient` have none.
        """
        values = [value[:, : gradient.shape[1]] for value in values]
        hidden = self._get_buffers("gradients", gradient.shape[1])
        for index in reversed(range(1, len(self._weights))):
            self._set_gradients(values[index], gradient, gradients[2 * index : 2 * index + 2])
            gradient = np.matmul(gradient, self._weights[index], out=hidden[index - 1])
            if latent is not None and index + 1 == len(self._weights):
                gradient += latent
            self._derive(gradient, values[index])
        self._set_gradients(values[0], gradient, gradients[:2])

    def _set_gradients(self, inputs: Floats, gradient: Floats, gradients: Sequence[Floats]) -> None:
        np.matmul(gradient.swapaxes(1, 2), inputs, out=gradients[0])
        np.matmul(_make_ones(gradient.shape[1]), gradient, out=gradients[1])  # the batch's sum

    def input_gradient(self, values: list[Floats], gradient: Floats, first: int) -> Floats:
        """Return the gradient of inputs `first` and later, from that of the outputs; overwrites as `backpropagate`."""
        hidden = self._get_buffers("gradients", gradient.shape[1])
        for index in reversed(range(1, len(self._weights))):
            gradient = np.matmul(gradient, self._weights[index], out=hidden[index - 1])
            self._derive(gradient, values[index])
        return gradient @ self._weights[0][:, :, first:]

    def _derive(self, gradient: Floats, activated: Floats) -> None:
        """Turn the gradient of activated values into that of the values before activation; overwrites both."""
        if self._uses_tanh:
            np.square(activated, out=activated)
            np.subtract(1, activated, out=activated)
            gradient *= activated
        else:
            gradient *= activated > 0


@functools.lru_cache
def _make_zeros(shape: tuple[int, ...]) -> Floats:
    return np.zeros(shape, np.float32)


@functools.lru_cache
def _make_ones(count: int) -> Floats:
    return np.ones((1, count), np.float32)


def clip_norm(gradient: Floats, limit: float) -> None:
    """Scale a vector in place so that its Euclidean norm is at most `limit`, as torch does."""
    norm = math.sqrt(float(np.vdot(gradient, gradient)))
    if not norm <= limit:
        gradient *= np.float32(limit / (norm + 1e-6))
