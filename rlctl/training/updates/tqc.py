"""Updates of TQC without autograd; equal to sb3-contrib's `train` except for rounding.

A. Kuznetsov et al., Controlling Overestimation Bias with Truncated Mixture of Continuous Distributional Quantile
Critics, 2020, https://arxiv.org/abs/2005.04269.
"""

from typing import Any, ClassVar

import numpy as np
import torch
from sb3_contrib import TQC

from rlctl.training.updates.mlp import Floats
from rlctl.training.updates.sac import SacUpdate


class TqcUpdate(SacUpdate):
    """SAC's update with critics that estimate quantiles of the return; the highest are dropped from targets."""

    algorithm: ClassVar[Any] = TQC

    def _choose_estimates(self, outputs: Floats) -> Floats:
        dropped = self._model.top_quantiles_to_drop_per_net * len(outputs)
        estimates = np.sort(np.concatenate(list(outputs), 1), axis=1)
        return estimates[:, : estimates.shape[1] - dropped]

    def _compute_loss(self, outputs: Floats, target: Floats) -> float:
        """Compare each quantile with each estimate by the quantile Huber loss."""
        errors = target[:, None, :] - outputs[..., None]
        sizes = np.abs(errors)
        sizes = np.where(sizes <= 1, 0.5 * np.square(sizes), sizes - 0.5)
        shares = _quantile_shares(outputs)[:, None]
        return float((sizes * np.where(errors < 0, 1 - shares, shares)).mean())

    def _differentiate_loss(self, outputs: Floats, target: Floats) -> Floats:
        # The derivative of the Huber loss is the error, clipped to [-1, 1]. Its weight is the
        # quantile's share if positive, else 1 - share; both sums follow from the slopes' sum and absolute sum.
        # The batch is the last axis here, since short innermost loops take twice as long.
        errors = torch.from_numpy(target).T.contiguous() - torch.from_numpy(outputs).mT.contiguous()[:, :, None]
        slopes = errors.clamp_(-1, 1)  # shape (critics, quantiles, estimates, batch)
        total, size = slopes.sum(2).mT.numpy(), slopes.abs_().sum(2).mT.numpy()
        count = np.float32(-2 * slopes[0].numel() * len(self._model.critic.q_networks))
        return np.ascontiguousarray((total + (2 * _quantile_shares(outputs) - 1) * size) / count)

    def _value(self, outputs: Floats) -> tuple[Floats, Floats]:
        count = outputs.shape[0] * outputs.shape[2]
        value: Floats = outputs.mean((0, 2))[:, None]
        return value, np.full_like(outputs, 1 / count)


def _quantile_shares(outputs: Floats) -> Floats:
    """Return the share of returns below each quantile, shape (quantiles,)."""
    count = outputs.shape[-1]
    return (np.arange(count, dtype=np.float32) + np.float32(0.5)) / np.float32(count)
