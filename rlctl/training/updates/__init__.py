"""Updates with gradients computed in NumPy, without autograd; other algorithms and networks are updated by SB3."""

from __future__ import annotations

from typing import Any

from sb3_contrib import TQC
from stable_baselines3 import SAC

from rlctl.errors import RecipeError
from rlctl.training.own_networks import has_own_parts
from rlctl.training.updates.dqn import DqnUpdate
from rlctl.training.updates.ppo import PpoUpdate
from rlctl.training.updates.sac import SacUpdate
from rlctl.training.updates.td3 import Td3Update
from rlctl.training.updates.tqc import TqcUpdate


def choose_learner(model: Any) -> Any:
    """Return whose `train` updates a model: one of these, or the model itself, which is SB3's."""
    updates: tuple[Any, ...] = (PpoUpdate, SacUpdate, TqcUpdate, Td3Update, DqnUpdate)
    for update in updates:
        if not has_own_parts(model.policy) and update.supports(model):
            return update(model)
    if type(model) in (SAC, TQC) and getattr(model, "policy_delay", 1) > 1:
        raise RecipeError(
            "policy_delay: only for multi-layer perceptrons with tanh or ReLU on the CPU; Stable-Baselines3's updates, "
            "which all other networks have, cannot delay the actor's: leave it out"
        )
    return model
