"""Perceptrons of torch modules: which are supported, and their parameters as views of NumPy arrays."""

from collections.abc import Iterable, Sequence
from typing import Any

import torch
from torch import Tensor, nn

from rlctl.training.updates.perceptrons import Floats

_ACTIVATIONS = (nn.Tanh, nn.ReLU)


def is_mlp(modules: Iterable[nn.Module]) -> bool:
    """Return whether `MlpStack` supports these modules."""
    modules = list(modules)
    kinds = [type(module) for module in modules]
    hidden = kinds[1::2]
    on_cpu = all(parameter.device.type == "cpu" for module in modules for parameter in module.parameters())
    known = len(set(hidden)) <= 1 and all(kind in _ACTIVATIONS for kind in hidden)
    return on_cpu and set(kinds[::2]) == {nn.Linear} and known


def list_sizes(modules: Iterable[nn.Module]) -> tuple[int, ...]:
    """Return the sizes of a perceptron's inputs and of each layer's outputs."""
    linears = [module for module in modules if isinstance(module, nn.Linear)]
    return (linears[0].in_features, *(linear.out_features for linear in linears))


def uses_tanh(modules: Iterable[nn.Module]) -> bool:
    """Return whether the activation is tanh; else it is ReLU."""
    return any(isinstance(module, nn.Tanh) for module in modules)


def bind(parameter: Tensor, values: Floats, gradient: Floats | None) -> None:
    """Make an array, and one for its gradient, the memory of a parameter, whose values are kept."""
    values[...] = parameter.detach().numpy()
    parameter.data = torch.from_numpy(values)
    if gradient is not None:
        parameter.grad = torch.from_numpy(gradient)


def bind_networks(
    networks: Iterable[Iterable[Any]], parameters: Sequence[Floats], gradients: Sequence[Floats] = ()
) -> None:
    """Bind perceptrons of equal shape to the arrays of a `MlpStack`; without `gradients` to be trained by nobody."""
    for number, network in enumerate(networks):
        linears = [module for module in network if isinstance(module, nn.Linear)]
        for index, parameter in enumerate(part for linear in linears for part in (linear.weight, linear.bias)):
            shape = parameter.shape
            gradient = gradients[index][number].reshape(shape) if gradients else None
            bind(parameter, parameters[index][number].reshape(shape), gradient)


def share(parameters: Sequence[Tensor]) -> Tensor:
    """Make parameters, or buffers, of equal shape slices of one array; return it."""
    shared = torch.stack([parameter.data for parameter in parameters])
    for parameter, part in zip(parameters, shared, strict=True):
        parameter.data = part
    return shared


def share_gradients(parameters: Sequence[Tensor]) -> Floats:
    """Give parameters of equal shape gradients that are slices of one array; return it."""
    shared = torch.zeros(len(parameters), *parameters[0].shape)
    for parameter, part in zip(parameters, shared, strict=True):
        parameter.grad = part
    return shared.numpy()
