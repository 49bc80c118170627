"""Whether a model can still be trained: all that it has learnt, and its losses, are numbers."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from stable_baselines3.common.base_class import BaseAlgorithm

from rlctl.errors import DivergedError
from rlctl.train import snapshot

# Explained variance, for one, is not a number where rewards are constant, and nothing is wrong.
_MUST_BE_FINITE = ("loss", "value_loss", "policy_gradient_loss", "policy_loss", "actor_loss", "critic_loss")


def check_finite(model: BaseAlgorithm, run: Path) -> None:
    """Raise `DivergedError`, which names `run`, if a loss, or a number that is learnt, is not finite."""
    tensors, _ = snapshot.learned_tensors(model)
    losses = {name: np.array(model.logger.name_to_value.get(f"train/{name}", 0.0)) for name in _MUST_BE_FINITE}
    for name, values in {**tensors, **losses}.items():
        if values.dtype.kind == "f" and not np.isfinite(values).all():
            raise DivergedError(
                f"training diverged: {name.replace('/', ' ')} is not finite at step {model.num_timesteps:,}. A smaller "
                f"algo_kwargs.learning_rate or a smaller reward helps most often.\nWhat was saved before is in {run}"
            )
