"""A moving average of an actor's weights, which is evaluated, kept and exported instead of the last weights.

The last weights swing from update to update, and with them how long a robot stays on its legs; training goes on with
them. B. Polyak, A. Juditsky, Acceleration of Stochastic Approximation by Averaging, 1992.
"""

from typing import Any

import torch

from rlctl.training.privileged import name_as_sb3
from rlctl.training.snapshot import Tensors

_PREFIX = "average/"  # of the tensors of a checkpoint


class ActorAverage:
    """The average of the actor's parameters and of the statistics of its normalization layers."""

    def __init__(self, model: Any, decay: float) -> None:
        """Average with the weight 1 - `decay` for the newest update; 0 is no average."""
        self._model, self._decay = model, decay
        self._average: dict[str, torch.Tensor] = {}  # by the names of the policy's state; empty before the first update

    def _read(self) -> dict[str, torch.Tensor]:
        state = self._model.policy.state_dict()
        return {name: value for name, value in state.items() if name.startswith("actor.") and value.is_floating_point()}

    @torch.no_grad()
    def follow(self, updates: int) -> None:
        """Add the current weights, after so many updates."""
        if not self._decay:
            return
        weights = self._read()
        if not self._average:
            self._average = {name: value.clone() for name, value in weights.items()}
        torch._foreach_lerp_(
            [self._average[name] for name in weights], list(weights.values()), 1 - self._decay**updates
        )

    def list_tensors(self) -> Tensors:
        """Return a copy, by the names of policy files; empty without an average."""
        return {f"policy/{name_as_sb3(name)}": value.cpu().numpy().copy() for name, value in self._average.items()}

    def take(self) -> Tensors:
        """Return what a checkpoint stores."""
        return {f"{_PREFIX}{name}": value.cpu().numpy().copy() for name, value in self._average.items()}

    def restore(self, tensors: Tensors) -> None:
        """Restore what `take` returned; from older checkpoints, which have none, it begins with the weights."""
        self._average = {
            name: torch.from_numpy(tensors[f"{_PREFIX}{name}"].copy()).to(value.device)
            for name, value in self._read().items()
            if f"{_PREFIX}{name}" in tensors
        }
