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
    """Inputs of a layer, shape (networks, batch, size), and how they were normalized; the rest (networks, 1, size)."""

    centered: Floats  # minus their mean
    factor: Floats  # normalized = centered * factor + shift, before the layer's own scale and bias
    shift: Floats
    # Derivatives of the variance that normalizes, and of the mean, by the batch's variance; None without learning.
    var_by_var: Floats | None = None
    mean_by_var: Floats | None = None


class _Renorm:
    """Layers of equal size, one per network, whose parameters and statistics become slices of shared arrays."""

    def __init__(self, layers: Sequence[Any]) -> None:
        self._layers, self._settings = layers, layers[0]
        self._eps = np.float32(layers[0].eps)
        scales, biases = [layer.scale for layer in layers], [layer.bias for layer in layers]
        self.scale, self._bias = (share(values).numpy()[:, None] for values in (scales, biases))
        self._scale_gradient, self._bias_gradient = (share_gradients(values)[:, None] for values in (scales, biases))
        names = ("ra_mean", "ra_var")
        self._mean, self._var = (share([getattr(layer, name) for layer in layers]).numpy()[:, None] for name in names)

    def run(self, inputs: Floats, *, learns: bool) -> tuple[Floats, _Normalized]:
        """Return the layers' outputs; with `learns` by the statistics of the batch, which change the running ones."""
        if learns:
            normalized = self._learn(inputs)
        else:
            factor: Floats = np.reciprocal(np.sqrt(self._var + self._eps))
            normalized = _Normalized(inputs - self._mean, factor, np.zeros_like(factor))
        outputs = normalized.centered * (normalized.factor * self.scale)
        outputs += normalized.shift * self.scale + self._bias
        return outputs, normalized

    def _learn(self, inputs: Floats) -> _Normalized:
        settings, count = self._settings, inputs.shape[1]
        mean = _sum(inputs) / np.float32(count)
        centered = inputs - mean
        var = _sum(np.square(centered)) / np.float32(count - 1)
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

    def backpropagate(self, normalized: _Normalized, gradient: Floats) -> Floats:
        """Set the gradients of scale and bias from the outputs' gradient; return that of the inputs."""
        total, product = _sum(gradient), _sum(gradient * normalized.centered)
        self._bias_gradient[...] = total
        self._scale_gradient[...] = product * normalized.factor + total * normalized.shift
        factor = normalized.factor * self.scale
        to_inputs: Floats = gradient * factor
        if normalized.var_by_var is not None and normalized.mean_by_var is not None:
            count = np.float32(gradient.shape[1])
            to_mean = -factor * total
            to_var = np.square(normalized.factor) * self.scale * self._scale_gradient * -0.5 * normalized.var_by_var
            to_var += to_mean * normalized.mean_by_var
            to_inputs += normalized.centered * (to_var * (2 / (count - 1)))
            to_inputs += to_mean / count
        return to_inputs


def _sum(values: Floats) -> Floats:
    """Return the sum over the batch; as a product it takes half the time."""
    return np.ones((1, values.shape[1]), np.float32) @ values


class _Passed(list[Floats]):
    """The inputs, then for each layer its normalized inputs and its output."""

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

    def __init__(self, stack: MlpStack, networks: Sequence[Iterable[nn.Module]]) -> None:
        """Use the linear layers of `stack`, and the batch normalization in the modules of `networks`."""
        vars(self).update(vars(stack))
        norms = [[module for module in network if isinstance(module, BatchRenorm1d)] for network in networks]
        self._norms = [_Renorm(row) for row in zip(*norms, strict=True)]

    def run(self, inputs: Floats, use: str) -> list[Floats]:
        """Return the inputs, and for each layer its normalized inputs and its output."""
        values = _Passed(inputs)
        outputs = self._get_buffers(use, inputs.shape[1])
        for index, norm in enumerate(self._norms):
            inputs, normalized = norm.run(values[-1], learns=use == "learning")
            self._run_layer(index, inputs, outputs[index])
            values += [inputs, outputs[index]]
            values.normalized.append(normalized)
        return values

    def backpropagate(
        self, values: list[Floats], gradient: Floats, gradients: Sequence[Floats], *, latent: Floats | None = None
    ) -> None:
        """As `MlpStack.backpropagate`; `latent` is the gradient of the last layer's normalized inputs."""
        assert isinstance(values, _Passed)
        for index in reversed(range(len(self._weights))):
            self._set_gradients(values[2 * index + 1], gradient, gradients[2 * index : 2 * index + 2])
            gradient = gradient @ self._weights[index]
            if latent is not None:
                gradient += latent
                latent = None
            gradient = self._norms[index].backpropagate(values.normalized[index], gradient)
            if index > 0:
                self._derive(gradient, values[2 * index])

    def input_gradient(self, values: list[Floats], gradient: Floats, first: int) -> Floats:
        """Return the gradient of inputs `first` and later, of a run by the running statistics."""
        assert isinstance(values, _Passed)
        for index in reversed(range(len(self._weights))):
            begin = 0 if index else first
            gradient = gradient @ self._weights[index][:, :, begin:]
            gradient *= (values.normalized[index].factor * self._norms[index].scale)[:, :, begin:]
            if index > 0:
                self._derive(gradient, values[2 * index])
        return gradient
