"""Steps of Adam without the checks and hooks that take longer than its arithmetic."""

from typing import Any

import torch

from rlctl.training.updates.perceptrons import Floats


def step(optimizer: torch.optim.Optimizer) -> None:
    """Do what `optimizer.step` does on the CPU, with torch's fused kernel where that is possible."""
    group = optimizer.param_groups[0]
    parameters = [parameter for parameter in group["params"] if parameter.grad is not None]
    states = [optimizer.state[parameter] for parameter in parameters]
    if not _is_plain(optimizer) or not all(states):  # the first step creates the states
        optimizer.step()
        return
    steps = [state["step"] for state in states]
    torch._foreach_add_(steps, 1)
    averages, squares = ([state[name] for state in states] for name in ("exp_avg", "exp_avg_sq"))
    _run_kernel(group, parameters, [parameter.grad for parameter in parameters], averages, squares, steps)


class VectorAdam:
    """Steps of an optimizer whose parameters are all parts of one vector: one call instead of one per parameter.

    The optimizer's state stays complete, so its own `step` can be called too: the tensors of the state become parts of
    vectors, also after a checkpoint is loaded.
    """

    def __init__(self, optimizer: torch.optim.Optimizer, vector: Floats, gradient: Floats) -> None:
        self._optimizer = optimizer
        self._vector, self._gradient = torch.from_numpy(vector), torch.from_numpy(gradient)
        self._parameters = [parameter for group in optimizer.param_groups for parameter in group["params"]]
        self._averages = {name: torch.zeros_like(self._vector) for name in ("exp_avg", "exp_avg_sq")}
        self._steps = torch.zeros(len(self._parameters))
        self._bound: Any = None  # the state that is known to consist of parts of the vectors

    def step(self) -> None:
        """Do what the optimizer's own `step` does."""
        states = self._optimizer.state
        if self._bound is None or states[self._parameters[0]].get("exp_avg") is not self._bound:
            if not self._can_bind():
                step(self._optimizer)
                return
            self._bind()
        self._steps += 1
        averages, squares = self._averages.values()
        group = self._optimizer.param_groups[0]
        _run_kernel(group, [self._vector], [self._gradient], [averages], [squares], [self._steps[0]])

    def _can_bind(self) -> bool:
        states = [self._optimizer.state[parameter] for parameter in self._parameters]
        if not _is_plain(self._optimizer) or not all(states):
            return False
        inside = all(0 <= self._find(parameter) < len(self._vector) for parameter in self._parameters)
        return inside and len({float(state["step"]) for state in states}) == 1

    def _find(self, parameter: torch.Tensor) -> int:
        return (parameter.data_ptr() - self._vector.data_ptr()) // self._vector.element_size()

    def _bind(self) -> None:
        for index, parameter in enumerate(self._parameters):
            state, first = self._optimizer.state[parameter], self._find(parameter)
            for name, vector in self._averages.items():
                part = vector[first : first + parameter.numel()].view(parameter.shape)
                part.copy_(state[name])
                state[name] = part
            self._steps[index] = state["step"]
            state["step"] = self._steps[index]
        self._bound = self._optimizer.state[self._parameters[0]]["exp_avg"]


def _is_plain(optimizer: torch.optim.Optimizer) -> bool:
    groups = optimizer.param_groups
    return type(optimizer) is torch.optim.Adam and len(groups) == 1 and not groups[0]["amsgrad"]


def _run_kernel(group: dict[str, Any], *arrays: list[torch.Tensor]) -> None:
    parameters, gradients, averages, squares, steps = arrays
    torch._fused_adam_(
        *(parameters, gradients, averages, squares, [], steps),
        lr=group["lr"],
        beta1=group["betas"][0],
        beta2=group["betas"][1],
        weight_decay=group["weight_decay"],
        eps=group["eps"],
        amsgrad=False,
        maximize=group["maximize"],
    )
