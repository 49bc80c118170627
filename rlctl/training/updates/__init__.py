"""Updates of PPO, SAC and TQC with gradients computed without autograd; other algorithms are updated by SB3."""

from __future__ import annotations

from typing import Any

from rlctl.training.updates.ppo import PpoUpdate
from rlctl.training.updates.sac import SacUpdate
from rlctl.training.updates.tqc import TqcUpdate


def choose_learner(model: Any) -> Any:
    """Return whose `train` updates a model: one of these, or the model itself, which is SB3's."""
    return next((update(model) for update in (PpoUpdate, SacUpdate, TqcUpdate) if update.supports(model)), model)
