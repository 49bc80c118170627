"""The layers of a policy's actor. NumPy applies them to rows; `rlctl.exporting` writes them as ONNX or C.

The first axis of every input and output is that of the rows, (k, ...). The bits of a row's output do not depend on the
other rows. Arrays are not copied: new weights in shared memory take effect when `prepare` is called.
"""

import abc
import dataclasses
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]


@dataclasses.dataclass(slots=True)
class Layer(abc.ABC):
    """A function of one array."""

    name: str  # the layer's name in SB3's `state_dict`, or its function

    @abc.abstractmethod
    def __call__(self, value: Any) -> Array:
        """Return the layer's output, a row for each row of the input."""

    def prepare(self) -> None:  # noqa: B027 (most layers have nothing to compute)
        """Compute values that depend only on the weights; call it again when the weights have changed."""


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
    return vector.reshape(1, *vector.shape)


def apply(layers: Iterable[Layer], value: Any) -> Array:
    """Apply layers one after the other."""
    for layer in layers:
        value = layer(value)
    return value


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


@dataclasses.dataclass(slots=True)
class BatchRenorm(Layer):
    """sb3-contrib's batch renormalisation in evaluation mode."""

    mean: Array
    variance: Array
    scale: Array
    bias: Array
    epsilon: np.float32

    def __call__(self, value: Array) -> Array:
        return self.scale * ((value - self.mean) / np.sqrt(self.variance + self.epsilon)) + self.bias


@dataclasses.dataclass(slots=True)
class Normalize(Layer):
    """Normalisation of an observation by its running mean and variance."""

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
        # In float64 as VecNormalize: an element with little variance is multiplied by up to 10,000.
        normalized: Array = value.astype(np.float64)  # a subtraction of two types takes longer
        normalized -= self._mean
        normalized /= self._deviation
        np.minimum(normalized, self._high, out=normalized)
        np.maximum(normalized, self._low, out=normalized)
        return normalized.astype(np.float32)


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


@dataclasses.dataclass(slots=True)
class ScaleImage(Layer):
    """Scales the bytes of an image to [0, 1], and moves the channels first."""

    channels_last: bool

    def __call__(self, value: Any) -> Array:
        pixels = np.asarray(value).transpose(0, 3, 1, 2) if self.channels_last else np.asarray(value)
        return np.asarray(pixels, np.float32) / np.float32(255.0)


@dataclasses.dataclass(slots=True)
class Flatten(Layer):
    """Flattens each row to one dimension, in float32."""

    def __call__(self, value: Any) -> Array:
        flat = np.asarray(value, np.float32)
        return flat if flat.ndim == 2 else flat.reshape(len(flat), -1)


@dataclasses.dataclass(slots=True)
class Clip(Layer):
    """Clips to [-limit, limit]."""

    limit: float

    def __call__(self, value: Array) -> Array:
        return np.clip(value, -self.limit, self.limit)


@dataclasses.dataclass(slots=True)
class Activation(Layer):
    """An activation function: one of `ACTIVATIONS`."""

    def __call__(self, value: Array) -> Array:
        return ACTIVATIONS[self.name](value)


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
            cell[:] = _sigmoid(f) * cell + _sigmoid(i) * np.tanh(g)
            value = hidden[:] = _sigmoid(o) * np.tanh(cell)
        return value


def _sigmoid(value: Array) -> Array:
    return np.float32(0.5) * (np.tanh(np.float32(0.5) * value) + np.float32(1.0))


def _elu(value: Array) -> Array:
    return np.where(value > 0, value, np.expm1(np.minimum(value, 0)))


ACTIVATIONS: dict[str, Callable[[Array], Array]] = {
    "tanh": np.tanh,
    "relu": lambda value: np.maximum(value, np.float32(0.0)),
    "elu": _elu,
    "silu": lambda value: value * _sigmoid(value),
}
