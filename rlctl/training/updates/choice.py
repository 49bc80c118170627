"""Which class updates a model."""

from typing import Any

from sb3_contrib import TQC
from stable_baselines3 import SAC

from rlctl.errors import RecipeError
from rlctl.training.own_networks import has_own_parts
from rlctl.training.updates.crossq import CrossQUpdate
from rlctl.training.updates.ppo import PpoUpdate
from rlctl.training.updates.q_learning import DqnUpdate, Td3Update
from rlctl.training.updates.sac import SacUpdate, TqcUpdate
from rlctl.training.updates.xqc import XqcUpdate


def choose_update(model: Any) -> Any:
    """Return the object whose `train` updates a model: a class of this package, or the SB3 model itself."""
    updates: tuple[Any, ...] = (PpoUpdate, SacUpdate, TqcUpdate, CrossQUpdate, XqcUpdate, Td3Update, DqnUpdate)
    extracts = any("features_extractor" in name for name, _ in model.policy.named_parameters())  # not all are linear
    for update in updates:
        if not extracts and not has_own_parts(model.policy) and update.supports(model):
            return update(model)
    if type(model) in (SAC, TQC) and getattr(model, "policy_delay", 1) > 1:
        raise RecipeError(
            "policy_delay: supported only for multi-layer perceptrons with tanh or ReLU on the CPU. "
            "Stable-Baselines3 updates all other networks and cannot delay the actor: leave it out"
        )
    return model
