"""Updates with gradients computed in NumPy, without autograd; other algorithms and networks are updated by SB3."""

from __future__ import annotations

from typing import Any

from rlctl.training.updates.dqn import DqnUpdate
from rlctl.training.updates.ppo import PpoUpdate
from rlctl.training.updates.sac import SacUpdate
from rlctl.training.updates.td3 import Td3Update
from rlctl.training.updates.tqc import TqcUpdate


def choose_learner(model: Any) -> Any:
    """Return whose `train` updates a model: one of these, or the model itself, which is SB3's."""
    updates: tuple[Any, ...] = (PpoUpdate, SacUpdate, TqcUpdate, Td3Update, DqnUpdate)
    return next((update(model) for update in updates if update.supports(model)), model)
