"""A multi-layer perceptron whose gradients are computed without autograd.

The networks of robot learning are so small that autograd's bookkeeping takes longer than their arithmetic. It also
computes gradients that nobody needs, as those of a critic's weights where it only judges an actor.
"""

from __future__ import annotations

import math
from collections.abc import Iterable

import numpy as np
import torch
from torch import Tensor, nn

LOG_SQRT_TAU = 0.5 * math.log(2 * math.pi)
"""Minus the logarithm of the standard normal density at 0."""
_ACTIVATIONS = (nn.Tanh, nn.ReLU)


class Mlp:
    """Linear layers with one activation after each, but not after the last; the weights stay those of `modules`."""

    def __init__(self, modules: Iterable[nn.Module]) -> None:
        self._layers: list[nn.Linear] = []
        self._uses_tanh = False
        for module in modules:
            if isinstance(module, nn.Linear):
                self._layers.append(module)
            else:
                self._uses_tanh = isinstance(module, nn.Tanh)

    def count_weights(self) -> int:
        """Return how many weights the layers have: the products of a forward pass, for each row of a batch."""
        return sum(layer.weight.numel() for layer in self._layers)

    def run(self, inputs: Tensor) -> list[Tensor]:
        """Return the inputs, shape (batch, features), and what each layer makes of them; the outputs come last."""
        values = [inputs]
        for layer in self._layers[:-1]:
            values.append(self._activate(_apply(layer, values[-1])))
        return [*values, _apply(self._layers[-1], values[-1])]

    def _activate(self, values: Tensor) -> Tensor:
        if not self._uses_tanh:
            return values.relu_()
        if values.device.type != "cpu":
            return values.tanh_()
        np.tanh(values.numpy(), out=values.numpy())  # several times as fast as torch's
        return values

    def backpropagate(self, values: list[Tensor], gradient: Tensor, *, latent: Tensor | None = None) -> None:
        """Set the gradients of the weights from that of the outputs, where `values` is what `run` returned.

        `latent` is a gradient of the last hidden layer's values that is added to the one that comes from the outputs.
        """
        for index in reversed(range(len(self._layers))):
            layer = self._layers[index]
            torch.mm(gradient.t(), values[index], out=layer.weight.grad)
            torch.sum(gradient, 0, out=layer.bias.grad)
            if index > 0:
                gradient = gradient @ layer.weight
                if latent is not None:
                    gradient, latent = gradient + latent, None
                gradient = self._derive(gradient, values[index])

    def input_gradient(self, values: list[Tensor], gradient: Tensor) -> Tensor:
        """Return the gradient of the inputs from that of the outputs."""
        for index in reversed(range(len(self._layers))):
            gradient = gradient @ self._layers[index].weight
            if index > 0:
                gradient = self._derive(gradient, values[index])
        return gradient

    def _derive(self, gradient: Tensor, activated: Tensor) -> Tensor:
        if self._uses_tanh:
            derived: Tensor = torch.ops.aten.tanh_backward(gradient, activated)
        else:
            derived = torch.ops.aten.threshold_backward(gradient, activated, 0)
        return derived


def _apply(layer: nn.Linear, inputs: Tensor) -> Tensor:
    return torch.addmm(layer.bias, inputs, layer.weight.t())


def is_mlp(modules: Iterable[nn.Module]) -> bool:
    """Return whether `Mlp` can be made of these modules."""
    kinds = [type(module) for module in modules]
    hidden = kinds[1::2]
    return set(kinds[::2]) == {nn.Linear} and len(set(hidden)) <= 1 and all(kind in _ACTIVATIONS for kind in hidden)


def share_gradients(parameters: Iterable[nn.Parameter]) -> Tensor:
    """Give parameters gradients that lie in one array, one after the other, and return it."""
    found = list(parameters)
    shared = torch.zeros(sum(each.numel() for each in found), device=found[0].device)
    first = 0
    for parameter in found:
        parameter.grad = shared[first : first + parameter.numel()].view_as(parameter)
        first += parameter.numel()
    return shared
