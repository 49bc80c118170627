"""The layers of a policy's actor. NumPy applies them to one observation; `rlctl.exporting` writes them as ONNX or C.

Arrays are not copied: new weights in shared memory take effect when `prepare` is called.
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
        """Return the layer's output for one input, without a batch dimension."""

    def prepare(self) -> None:  # noqa: B027 (most layers have nothing to compute)
        """Compute values that depend only on the weights; call it again when the weights have changed."""


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

    def __call__(self, value: Array) -> Array:
        result: Array = self.weight.dot(value)
        result += self.bias
        return result


@dataclasses.dataclass(slots=True)
class Convolution(Layer):
    """A 2-D convolution without padding."""

    weight: Array  # shape (outputs, channels, height, width)
    bias: Array
    stride: int

    def __call__(self, value: Array) -> Array:
        count, channels, height, width = self.weight.shape
        windows = np.lib.stride_tricks.sliding_window_view(value, (height, width), axis=(1, 2))
        windows = windows[:, :: self.stride, :: self.stride]
        rows, columns = windows.shape[1:3]
        patches = windows.transpose(0, 3, 4, 1, 2).reshape(channels * height * width, rows * columns)
        return (self.weight.reshape(count, -1) @ patches + self.bias[:, None]).reshape(count, rows, columns)


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
    _deviation: Array = dataclasses.field(init=False)
    _high: Array = dataclasses.field(init=False)
    _low: Array = dataclasses.field(init=False)

    def __post_init__(self) -> None:
        # Arrays, because NumPy takes twice as long for a scalar and so few elements.
        self._high = np.full(np.shape(self.mean), self.clip)
        self._low = -self._high
        self.prepare()

    def prepare(self) -> None:
        """Compute the standard deviation from the variance."""
        self._deviation = np.sqrt(self.variance + self.epsilon)

    def __call__(self, value: Array) -> Array:
        # In float64 as VecNormalize: an element with little variance is multiplied by up to 10,000.
        normalized: Array = (value - self.mean) / self._deviation
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
        result = np.zeros(self._total, np.float32)
        result[self._offsets + np.ravel(value)] = 1.0
        return result


@dataclasses.dataclass(slots=True)
class ScaleImage(Layer):
    """Scales the bytes of an image to [0, 1], and moves the channels first."""

    channels_last: bool

    def __call__(self, value: Any) -> Array:
        pixels = np.asarray(value).transpose(2, 0, 1) if self.channels_last else np.asarray(value)
        return np.asarray(pixels, np.float32) / np.float32(255.0)


@dataclasses.dataclass(slots=True)
class Flatten(Layer):
    """Flattens an array to one dimension, in float32."""

    def __call__(self, value: Any) -> Array:
        return np.asarray(value, np.float32).ravel()


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


class Lstm:
    """The layers of an LSTM, and their state: hidden and cell, shape (2, layers, hidden)."""

    def __init__(self, name: str, layers: list[LstmLayer]) -> None:
        self.name = name
        self.layers = layers
        self.state = np.zeros((2, len(layers), layers[0].of_hidden.shape[1]), np.float32)

    def step(self, value: Array) -> Array:
        """Advance the state by one step and return the output of the last layer, shape (hidden,)."""
        state = self.state
        for number, layer in enumerate(self.layers):
            gates = layer.of_input.dot(value) + layer.of_hidden.dot(state[0, number])
            for bias in layer.biases:
                gates += bias
            i, f, g, o = np.split(gates, 4)
            state[1, number] = _sigmoid(f) * state[1, number] + _sigmoid(i) * np.tanh(g)
            value = state[0, number] = _sigmoid(o) * np.tanh(state[1, number])
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
