"""Perceptrons with batch renormalization before each linear layer: the networks of CrossQ, without autograd.

S. Ioffe, Batch Renormalization, 2017, https://arxiv.org/abs/1702.03275, as in sb3-contrib: for `warmup_steps` batch
normalization, then with limits of the correction that do not change.

Normalization and linear layer are one product: the weights contain the factors, the bias the means. The gradients of
both follow from the product of the outputs' gradient and the inputs, which is as large as the weights. So only the
statistics, and their part of the inputs' gradient, need arrays as large as the batch.
"""

import dataclasses
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from sb3_contrib.common.torch_layers import BatchRenorm1d
from torch import nn

from rlctl.training.updates.mlp import is_mlp, share, share_gradients
from rlctl.training.updates.perceptrons import Floats, MlpStack


@dataclasses.dataclass(frozen=True)
class _Normalized:
    """Inputs of a layer, shape (networks, batch, size), and how they are normalized; the rest (networks, 1, size)."""

    inputs: Floats
    mean: Floats
    factor: Floats  # normalized = (inputs - mean) * factor + shift, before the layer's own scale and bias
    shift: Floats
    # Derivatives of the variance that normalizes, and of the mean, by the batch's variance; None without learning.
    var_by_var: Floats | None = None
    mean_by_var: Floats | None = None

    def center(self) -> "_Normalized":
        """Subtract the mean from the inputs, so that large ones are not rounded."""
        return dataclasses.replace(self, inputs=self.inputs - self.mean, mean=np.zeros_like(self.mean))


class _Renorm:
    """Layers of equal size, one per network, whose parameters and statistics become slices of shared arrays."""

    def __init__(self, layers: Sequence[Any]) -> None:
        self._layers, self._settings = layers, layers[0]
        self._eps = np.float32(layers[0].eps)
        scales, biases = [layer.scale for layer in layers], [layer.bias for layer in layers]
        self._scale, self._bias = (share(values).numpy()[:, None] for values in (scales, biases))
        self._scale_gradient, self._bias_gradient = (share_gradients(values)[:, None] for values in (scales, biases))
        names = ("ra_mean", "ra_var")
        self._mean, self._var = (share([getattr(layer, name) for layer in layers]).numpy()[:, None] for name in names)

    def find_line(self, normalized: _Normalized) -> tuple[Floats, Floats]:
        """Return factor and offset of the layers' outputs: (inputs - mean) * factor + offset."""
        return normalized.factor * self._scale, normalized.shift * self._scale + self._bias

    def normalize(self, inputs: Floats) -> _Normalized:
        """Use the running statistics."""
        factor: Floats = np.reciprocal(np.sqrt(self._var + self._eps))
        return _Normalized(inputs, self._mean.copy(), factor, np.zeros_like(factor))

    def learn(self, inputs: Floats) -> _Normalized:
        """Use the statistics of the batch, which change the running ones."""
        settings, count = self._settings, inputs.shape[1]
        mean = _sum(inputs) / np.float32(count)
        squares = inputs - mean
        var = _sum(np.square(squares, out=squares)) / np.float32(count - 1)
        ratio, shift = np.ones_like(self._var), np.zeros_like(self._mean)
        if int(settings.steps) > settings.warmup_steps:
            running = np.sqrt(self._var + self._eps)
            ratio = (np.sqrt(var + self._eps) / running).clip(1 / settings.rmax, settings.rmax)
            shift = ((mean - self._mean) / running).clip(-settings.dmax, settings.dmax)
        self._mean += np.float32(settings.momentum) * (mean - self._mean)
        self._var += np.float32(settings.momentum) * (var - self._var)
        for layer in self._layers:
            layer.steps += 1
        factor = 1 / np.sqrt(var / np.square(ratio) + self._eps)
        # The mean that normalizes is the batch's minus `away`.
        deviation = np.sqrt(var)
        away = shift * deviation / ratio
        by_var = np.divide(-0.5 * shift, ratio * deviation, out=np.zeros_like(factor), where=deviation > 0)
        return _Normalized(inputs, mean, factor, away * factor, 1 / np.square(ratio), by_var)

    def backpropagate(self, normalized: _Normalized, total: Floats, product: Floats) -> tuple[Floats, Floats] | None:
        """Set the gradients of scale and bias.

        Args:
            normalized: how the inputs were normalized.
            total: of the outputs' gradient, the sum over the batch; shape (networks, 1, size).
            product: the sum of the gradient times (inputs - mean).

        Returns:
            Slope and offset of what the statistics add to the inputs' gradient, as a function of (inputs - mean); None
            if they are not the batch's.
        """
        self._bias_gradient[...] = total
        self._scale_gradient[...] = product * normalized.factor + total * normalized.shift
        if normalized.var_by_var is None or normalized.mean_by_var is None:
            return None
        count = np.float32(normalized.inputs.shape[1])
        to_mean = -normalized.factor * self._scale * total
        to_var = np.square(normalized.factor) * self._scale * self._scale_gradient * -0.5 * normalized.var_by_var
        to_var += to_mean * normalized.mean_by_var
        return to_var * (2 / (count - 1)), to_mean / count


def _sum(values: Floats) -> Floats:
    """Return the sum over the batch; as a product it takes half the time."""
    return np.ones((1, values.shape[1]), np.float32) @ values


class _Passed(list[Floats]):
    """The inputs and the output of each layer."""

    def __init__(self, inputs: Floats) -> None:
        super().__init__([inputs])
        self.normalized: list[_Normalized] = []
        self.weights: list[Floats] = []  # those that contain the factors


def is_normalized(modules: Iterable[nn.Module]) -> bool:
    """Return whether batch normalization comes before each linear layer."""
    return all(type(module) is BatchRenorm1d and module.affine for module in list(modules)[::3])


def is_supported(modules: Iterable[nn.Module]) -> bool:
    """Return whether these modules are a perceptron with or without batch normalization."""
    modules = list(modules)
    return is_mlp(module for index, module in enumerate(modules) if index % 3 or not is_normalized(modules))


class NormalizedMlpStack(MlpStack):
    """As `MlpStack`; a run for the use "learning" normalizes by the batch, all others by the running statistics."""

    def __init__(self, stack: MlpStack, networks: Sequence[Iterable[nn.Module]]) -> None:
        """Use the linear layers of `stack`, and the batch normalization in the modules of `networks`."""
        vars(self).update(vars(stack))
        norms = [[module for module in network if isinstance(module, BatchRenorm1d)] for network in networks]
        self._norms = [_Renorm(row) for row in zip(*norms, strict=True)]

    def run(self, inputs: Floats, use: str) -> list[Floats]:
        """As `MlpStack.run`."""
        values = _Passed(inputs)
        outputs = self._get_buffers(use, inputs.shape[1])
        for index, norm in enumerate(self._norms):
            normalized = (norm.learn if use == "learning" else norm.normalize)(values[-1])
            if index == 0:  # observations can be large, and vary little
                normalized = normalized.center()
            factor, offset = norm.find_line(normalized)
            weight: Floats = self._weights[index] * factor
            bias: Floats = (offset - normalized.mean * factor) @ self._weights[index].swapaxes(1, 2)
            bias += self._biases[index]
            self._run_layer(index, normalized.inputs, outputs[index], weight, bias)
            values.append(outputs[index])
            values.normalized.append(normalized)
            values.weights.append(weight)
        return values

    def read_latent(self, values: list[Floats]) -> Floats:
        """As `MlpStack.read_latent`: the normalized ones."""
        assert isinstance(values, _Passed)
        normalized = values.normalized[-1]
        factor, offset = self._norms[-1].find_line(normalized)
        return (normalized.inputs - normalized.mean) * factor + offset

    def backpropagate(
        self, values: list[Floats], gradient: Floats, gradients: Sequence[Floats], *, latent: Floats | None = None
    ) -> None:
        """As `MlpStack.backpropagate`; `latent` is the gradient of the last layer's normalized inputs."""
        assert isinstance(values, _Passed)
        hidden = self._get_buffers("gradients", values[0].shape[1])
        for index in reversed(range(len(self._weights))):
            rows = gradient.shape[1]
            normalized, weight, norm = values.normalized[index], self._weights[index], self._norms[index]
            factor, offset = norm.find_line(normalized)
            to_weight, to_bias = gradients[2 * index : 2 * index + 2]
            self._set_gradients(normalized.inputs[:, :rows], gradient, (to_weight, to_bias))
            sums = to_bias.swapaxes(1, 2)
            to_weight -= sums * normalized.mean
            total, product = to_bias @ weight, (weight * to_weight).sum(1, keepdims=True)
            to_weight *= factor
            to_weight += sums * offset
            if latent is not None:
                total += _sum(latent)
                product += _sum(latent * (normalized.inputs - normalized.mean))
            line = norm.backpropagate(normalized, total, product)
            if index == 0:
                return
            np.matmul(gradient, values.weights[index], out=hidden[index - 1][:, :rows])
            gradient = hidden[index - 1]
            gradient[:, rows:] = 0
            if latent is not None:
                gradient += latent * factor
                latent = None
            if line is not None:
                gradient += normalized.inputs * line[0]
                gradient += line[1] - normalized.mean * line[0]
            self._derive(gradient, values[index])

    def input_gradient(self, values: list[Floats], gradient: Floats, first: int) -> Floats:
        """Return the gradient of inputs `first` and later, of a run by the running statistics."""
        assert isinstance(values, _Passed)
        for index in reversed(range(1, len(self._weights))):
            gradient = gradient @ values.weights[index]
            self._derive(gradient, values[index])
        return gradient @ values.weights[0][:, :, first:]
