"""Steps of Adam without the checks and hooks that take longer than its arithmetic."""

import torch


def step(optimizer: torch.optim.Optimizer) -> None:
    """Do what `optimizer.step` does on the CPU, with torch's fused kernel where that is possible."""
    group = optimizer.param_groups[0]
    parameters = [parameter for parameter in group["params"] if parameter.grad is not None]
    states = [optimizer.state[parameter] for parameter in parameters]
    is_plain = type(optimizer) is torch.optim.Adam and len(optimizer.param_groups) == 1 and not group["amsgrad"]
    if not is_plain or not all(states):  # the first step creates the states
        optimizer.step()
        return
    steps = [state["step"] for state in states]
    torch._foreach_add_(steps, 1)
    torch._fused_adam_(
        parameters,
        [parameter.grad for parameter in parameters],
        [state["exp_avg"] for state in states],
        [state["exp_avg_sq"] for state in states],
        [],
        steps,
        lr=group["lr"],
        beta1=group["betas"][0],
        beta2=group["betas"][1],
        weight_decay=group["weight_decay"],
        eps=group["eps"],
        amsgrad=False,
        maximize=group["maximize"],
    )
