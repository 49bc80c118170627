"""Multi-layer perceptrons in NumPy whose gradients are computed without autograd.

The networks of robot learning are so small that autograd's overhead takes longer than their arithmetic. It also
computes unneeded gradients, e.g. of the critic's weights in the actor's update. NumPy's matrix products are up to twice
as fast as torch's on AMD processors, and a NumPy call takes a third of the time.
"""

import functools
import math
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from rlctl.rollout.workers import available_cores

Floats = NDArray[np.float32]

LOG_SQRT_TAU = 0.5 * math.log(2 * math.pi)  # minus the logarithm of the standard normal density at 0
_ACTIVATIONS = (nn.Tanh, nn.ReLU)


class _Layer:
    """Linear layers of equal size, one per network; their parameters become slices of shared arrays."""

    def __init__(self, linears: Sequence[nn.Linear]) -> None:
        weights, biases = [linear.weight for linear in linears], [linear.bias for linear in linears]
        self.parameters = [share(weights), share(biases)]
        self.weight, self.bias = self.parameters[0].numpy(), self.parameters[1].numpy()[:, None, :]
        self.weight_gradient = share_gradients(weights)
        self.bias_gradient = share_gradients(biases)[:, None, :]


class MlpStack:
    """Perceptrons of equal shape: linear layers with an activation after each except the last.

    Arrays have the shape (networks, batch, size); inputs of shape (1, batch, size) are used by all. The weights
    stay those of the modules.
    """

    def __init__(self, networks: Sequence[Iterable[nn.Module]]) -> None:
        modules = [list(network) for network in networks]
        self._uses_tanh = any(isinstance(module, nn.Tanh) for module in modules[0])
        linears = [[module for module in network if isinstance(module, nn.Linear)] for network in modules]
        self._layers = [_Layer(row) for row in zip(*linears, strict=True)]
        self._buffers: dict[tuple[str, int], list[Floats]] = {}
        self.count = len(modules)  # number of networks
        self.run_calls: Callable[..., list[Any]] = lambda calls: [call() for call in calls]  # for a layer's gradients
        self.parameters = [values for layer in self._layers for values in layer.parameters]
        """Weights and biases, of all networks together."""
        self.gradients = [layer.weight_gradient for layer in self._layers]
        self.gradients += [layer.bias_gradient for layer in self._layers]
        """Gradients of the parameters; the order differs from `parameters`."""

    def run(self, inputs: Floats, use: str) -> list[Floats]:
        """Return the inputs and the output of each layer. The next run with the same `use` overwrites these arrays."""
        values = [inputs, *self._get_buffers(use, inputs.shape[1])]
        for index in range(len(self._layers)):
            self._run_layer(index, values[index], values[index + 1])
        return values

    def _run_layer(self, index: int, inputs: Floats, output: Floats) -> None:
        layer = self._layers[index]
        np.matmul(inputs, layer.weight.swapaxes(1, 2), out=output)
        output += layer.bias
        is_hidden = index + 1 < len(self._layers)
        if is_hidden and self._uses_tanh:
            np.tanh(output, out=output)
        elif is_hidden:
            torch.from_numpy(output).relu_()  # a tenth of NumPy's time

    def _get_buffers(self, use: str, batch: int) -> list[Floats]:
        if (use, batch) not in self._buffers:
            shapes = [(self.count, batch, layer.bias.shape[2]) for layer in self._layers]
            self._buffers[use, batch] = [np.empty(shape, np.float32) for shape in shapes]
        return self._buffers[use, batch]

    def backpropagate(self, values: list[Floats], gradient: Floats, *, latent: Floats | None = None) -> None:
        """Set the weights' gradients from the outputs' gradient, and from `latent`, of the last hidden layer."""
        hidden = self._get_buffers("gradients", gradient.shape[1])
        for index in reversed(range(1, len(self._layers))):
            to_weight = functools.partial(self._set_gradients, index, values[index], gradient)
            to_inputs = functools.partial(np.matmul, gradient, self._layers[index].weight, out=hidden[index - 1])
            gradient = self.run_calls([to_weight, to_inputs])[1]
            if latent is not None and index + 1 == len(self._layers):
                gradient += latent
            self._derive(gradient, values[index])
        self._set_gradients(0, values[0], gradient)

    def _set_gradients(self, index: int, inputs: Floats, gradient: Floats) -> None:
        layer = self._layers[index]
        np.matmul(gradient.swapaxes(1, 2), inputs, out=layer.weight_gradient)
        np.matmul(np.ones((1, gradient.shape[1]), np.float32), gradient, out=layer.bias_gradient)  # the batch's sum

    def input_gradient(self, values: list[Floats], gradient: Floats, first: int) -> Floats:
        """Return the gradient of inputs `first` and later, from the gradient of the outputs."""
        hidden = self._get_buffers("gradients", gradient.shape[1])
        for index in reversed(range(1, len(self._layers))):
            gradient = np.matmul(gradient, self._layers[index].weight, out=hidden[index - 1])
            self._derive(gradient, values[index])
        return gradient @ self._layers[0].weight[:, :, first:]

    def _derive(self, gradient: Floats, activated: Floats) -> None:
        """Turn the gradient of activated values into that of the values before activation, in place."""
        changed, values = torch.from_numpy(gradient), torch.from_numpy(activated)
        if self._uses_tanh:
            torch.ops.aten.tanh_backward.grad_input(changed, values, grad_input=changed)
        else:
            torch.ops.aten.threshold_backward.grad_input(changed, values, 0, grad_input=changed)


def is_mlp(modules: Iterable[nn.Module]) -> bool:
    """Return whether `MlpStack` supports these modules."""
    modules = list(modules)
    kinds = [type(module) for module in modules]
    hidden = kinds[1::2]
    on_cpu = all(parameter.device.type == "cpu" for module in modules for parameter in module.parameters())
    known = len(set(hidden)) <= 1 and all(kind in _ACTIVATIONS for kind in hidden)
    return on_cpu and set(kinds[::2]) == {nn.Linear} and known


def join_outputs(linears: Sequence[nn.Linear]) -> nn.Linear:
    """Return a layer with the outputs of all `linears`, which have the same inputs; then call `share_joined`."""
    joined = nn.Linear(linears[0].in_features, sum(linear.out_features for linear in linears))
    joined.weight.data = torch.cat([linear.weight.data for linear in linears])
    joined.bias.data = torch.cat([linear.bias.data for linear in linears])
    return joined


def share_joined(linears: Sequence[nn.Linear], joined: nn.Linear) -> None:
    """Make the parameters and gradients of layers slices of those of the joined layer."""
    first = 0
    for linear in linears:
        rows = slice(first, first + linear.out_features)
        for parameter, whole in ((linear.weight, joined.weight), (linear.bias, joined.bias)):
            parameter.data = whole.data[rows]
            assert whole.grad is not None  # `MlpStack` has set it
            parameter.grad = whole.grad[rows]
        first = rows.stop


def clip_norm(gradients: Iterable[Floats], limit: float) -> None:
    """Scale gradients in place so that their total Euclidean norm is at most `limit`, as torch does."""
    gradients = list(gradients)
    norm = math.sqrt(sum(float(np.vdot(gradient, gradient)) for gradient in gradients))
    if not norm <= limit:
        for gradient in gradients:
            gradient *= limit / (norm + 1e-6)


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


Result = TypeVar("Result")

_WORTHWHILE = 8_000_000  # multiplications per forward pass from which a second thread saves time


class SideBySide:
    """Runs calls on two threads, for small networks or on one core on one; the results are bit-exact either way."""

    def __init__(self, networks: Sequence[Iterable[nn.Module]], batch_size: int) -> None:
        linears = [[module for module in network if isinstance(module, nn.Linear)] for network in networks]
        multiplications = batch_size * min(sum(linear.weight.numel() for linear in row) for row in linears)
        is_worthwhile = multiplications >= _WORTHWHILE and available_cores() > 1
        self._second = ThreadPoolExecutor(1, initializer=_prepare_thread) if is_worthwhile else None

    def make_stacks(self, networks: Iterable[Iterable[nn.Module]], kind: type[MlpStack] = MlpStack) -> list[MlpStack]:
        """Return networks of equal shape as one stack, or, with a second thread, as one stack per network."""
        if self._second is None:
            return [kind(list(networks))]
        return [kind([network]) for network in networks]

    def run(self, calls: Sequence[Callable[[], Result]]) -> list[Result]:
        """Return what each call returns."""
        if self._second is None:
            return [call() for call in calls]
        others = [self._second.submit(call) for call in calls[1:]]
        return [calls[0](), *(other.result() for other in others)]


def _prepare_thread() -> None:
    # Both are settings of a thread in torch.
    torch.set_grad_enabled(False)
    torch.set_num_threads(1)
