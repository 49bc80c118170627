"""Perceptrons with batch renormalization before each linear layer: the networks of CrossQ, without autograd.

S. Ioffe, Batch Renormalization, 2017, https://arxiv.org/abs/1702.03275, as in sb3-contrib: for `warmup_steps` batch
normalization, then with limits of the correction that do not change.
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
    """How a layer's inputs were normalized; arrays have the shape (networks, 1, size).

    normalized = inputs * factor + shift, before the layer's own scale and bias.
    """

    inputs: Floats  # shape (networks, batch, size); with learning minus their mean
    factor: Floats
    shift: Floats
    # Derivatives of the variance that normalizes, and of the mean, by the batch's variance; None without learning.
    var_by_var: Floats | None = None
    mean_by_var: Floats | None = None


class _Renorm:
    """Layers of equal size, one per network, whose parameters and statistics become slices of shared arrays.

    Scale and bias never touch the batch: the linear layer behind takes them into its weights, and the sums of their
    gradients follow from the gradient of those weights. A batch has more elements than a layer has weights.
    """

    def __init__(self, layers: Sequence[Any]) -> None:
        self._layers, self._settings = layers, layers[0]
        self._eps = np.float32(layers[0].eps)
        scales, biases = [layer.scale for layer in layers], [layer.bias for layer in layers]
        self._scale, self._bias = (share(values).numpy()[:, None] for values in (scales, biases))
        self._scale_gradient, self._bias_gradient = (share_gradients(values)[:, None] for values in (scales, biases))
        names = ("ra_mean", "ra_var")
        self._mean, self._var = (share([getattr(layer, name) for layer in layers]).numpy()[:, None] for name in names)

    def normalize(self, inputs: Floats) -> _Normalized:
        """Return how the running statistics normalize."""
        factor: Floats = np.reciprocal(np.sqrt(self._var + self._eps))
        return _Normalized(inputs, factor, -self._mean * factor)

    def learn(self, inputs: Floats) -> _Normalized:
        """Return how the statistics of the batch normalize; they change the running ones."""
        settings, count = self._settings, inputs.shape[1]
        mean = _sum(inputs) / np.float32(count)
        centered = inputs - mean
        var = np.einsum("nbi,nbi->ni", centered, centered)[:, None] / np.float32(count - 1)
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
        return _Normalized(centered, factor, away * factor, 1 / np.square(ratio), by_var)

    def fold(self, normalized: _Normalized, weights: Floats, biases: Floats) -> tuple[Floats, Floats]:
        """Return the weights and biases of the linear layer for inputs that are not normalized."""
        constant = normalized.shift * self._scale + self._bias
        return self.scale(normalized, weights), biases + constant @ weights.swapaxes(1, 2)

    def apply(self, normalized: _Normalized) -> Floats:
        """Return the outputs."""
        outputs = self.scale(normalized, normalized.inputs)
        outputs += normalized.shift * self._scale + self._bias
        return outputs

    def scale(self, normalized: _Normalized, values: Floats) -> Floats:
        """Return weights, or gradients, of the outputs as those of the inputs."""
        return values * (normalized.factor * self._scale)

    def backpropagate(
        self, normalized: _Normalized, weights: Floats, gradients: Sequence[Floats], latent: Floats | None
    ) -> tuple[Floats, Floats]:
        """Turn gradients of the folded weights and biases into those of all parameters, and of two factors.

        The gradient of the layer's inputs is the one by the folded weights, plus the returned slope times
        `normalized.inputs`, plus the returned constant. `latent` is a gradient of the normalized inputs that did not
        come through the weights.
        """
        to_folded, to_biases = gradients
        total, product = to_biases @ weights, np.einsum("noi,noi->ni", weights, to_folded)[:, None]
        if latent is not None:
            total += _sum(latent)
            product += _sum(latent * normalized.inputs)
        factor = normalized.factor * self._scale
        to_folded *= factor
        to_folded += to_biases.swapaxes(1, 2) * (normalized.shift * self._scale + self._bias)
        self._bias_gradient[...] = total
        self._scale_gradient[...] = product * normalized.factor + total * normalized.shift
        assert normalized.var_by_var is not None
        assert normalized.mean_by_var is not None
        count = np.float32(normalized.inputs.shape[1])
        to_mean = -factor * total
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


def is_normalized(modules: Iterable[nn.Module]) -> bool:
    """Return whether batch normalization comes before each linear layer."""
    return all(type(module) is BatchRenorm1d and module.affine for module in list(modules)[::3])


def is_supported(modules: Iterable[nn.Module]) -> bool:
    """Return whether these modules are a perceptron with or without batch normalization."""
    modules = list(modules)
    return is_mlp(module for index, module in enumerate(modules) if index % 3 or not is_normalized(modules))


class NormalizedMlpStack(MlpStack):
    """As `MlpStack`; a run for the use "learning" normalizes by the batch, all others by the running statistics."""

    def __init__(self, stack: MlpStack, networks: Sequence[Iterable[nn.Module]], *, keeps_latent: bool = False) -> None:
        """Use the linear layers of `stack`, and the batch normalization in the modules of `networks`.

        `keeps_latent`: whether `run` returns the last layer's normalized inputs too.
        """
        vars(self).update(vars(stack))
        self._keeps_latent = keeps_latent
        norms = [[module for module in network if isinstance(module, BatchRenorm1d)] for network in networks]
        self._norms = [_Renorm(row) for row in zip(*norms, strict=True)]

    def run(self, inputs: Floats, use: str) -> list[Floats]:
        """Return the inputs and the output of each layer; if it is kept, the latent state is the last but one."""
        values = _Passed(inputs)
        outputs = self._get_buffers(use, inputs.shape[1])
        for index, norm in enumerate(self._norms):
            normalized = norm.learn(values[index]) if use == "learning" else norm.normalize(values[index])
            if self._keeps_latent and index + 1 == len(self._norms):
                values.append(norm.apply(normalized))
            weights, biases = norm.fold(normalized, self._weights[index], self._biases[index])
            self._run_layer(index, normalized.inputs, outputs[index], weights, biases)
            values.append(outputs[index])
            values.normalized.append(normalized)
        return values

    def backpropagate(
        self, values: list[Floats], gradient: Floats, gradients: Sequence[Floats], *, latent: Floats | None = None
    ) -> None:
        """As `MlpStack.backpropagate`; `latent` is the gradient of the last layer's normalized inputs."""
        assert isinstance(values, _Passed)
        hidden = self._get_buffers("gradients", gradient.shape[1])
        for index in reversed(range(len(self._weights))):
            normalized, weights, norm = values.normalized[index], self._weights[index], self._norms[index]
            parts = gradients[2 * index : 2 * index + 2]
            self._set_gradients(normalized.inputs, gradient, parts)
            slope, constant = norm.backpropagate(normalized, weights, parts, latent)
            if index > 0:
                gradient = np.matmul(gradient, norm.scale(normalized, weights), out=hidden[index - 1])
                if latent is not None:
                    gradient += norm.scale(normalized, latent)
                by_statistics = normalized.inputs  # no longer needed, and overwritten
                by_statistics *= slope
                by_statistics += constant
                gradient += by_statistics
                self._derive(gradient, values[index])
            latent = None

    def input_gradient(self, values: list[Floats], gradient: Floats, first: int) -> Floats:
        """Return the gradient of inputs `first` and later, of a run by the running statistics."""
        assert isinstance(values, _Passed)
        for index in reversed(range(len(self._weights))):
            begin = 0 if index else first
            gradient = gradient @ self._norms[index].scale(values.normalized[index], self._weights[index])[:, :, begin:]
            if index > 0:
                self._derive(gradient, values[index])
        return gradient
