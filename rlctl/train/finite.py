"""Whether a model can still be trained: its weights and losses are numbers."""

from __future__ import annotations

import math
from pathlib import Path

import torch
from stable_baselines3.common.base_class import BaseAlgorithm

from rlctl.errors import DivergedError

# Explained variance, for one, is not a number where rewards are constant, and nothing is wrong.
_MUST_BE_FINITE = ("loss", "value_loss", "policy_gradient_loss", "policy_loss", "actor_loss", "critic_loss")


def check_finite(model: BaseAlgorithm, run: Path) -> None:
    """Raise `DivergedError` if a weight or a loss is not finite; `run` is named in it."""
    for name, parameter in model.policy.named_parameters():
        if not bool(torch.isfinite(parameter).all()):
            raise _diverged(f"weights {name} are", model, run)
    losses = model.logger.name_to_value
    for name in _MUST_BE_FINITE:
        if not math.isfinite(losses.get(f"train/{name}", 0.0)):
            raise _diverged(f"{name} is", model, run)


def _diverged(what: str, model: BaseAlgorithm, run: Path) -> DivergedError:
    return DivergedError(
        f"training diverged: {what} not finite at step {model.num_timesteps:,}. A smaller "
        "algo_kwargs.learning_rate or a smaller reward helps most often.\n"
        f"What was saved before is in {run}"
    )
