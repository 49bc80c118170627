"""TQC's updates with gradients computed without autograd: what sb3-contrib's `TQC.train` computes, but for rounding.

A. Kuznetsov et al., Controlling Overestimation Bias with Truncated Mixture of Continuous Distributional Quantile
Critics, 2020, https://arxiv.org/abs/2005.04269.
"""

from __future__ import annotations

from typing import Any, ClassVar

import torch
from sb3_contrib import TQC
from torch import Tensor, nn

from rlctl.training.updates.sac import SacUpdate


class TqcUpdate(SacUpdate):
    """SAC's update with critics that estimate quantiles of the return, of which the highest do not count."""

    algorithm: ClassVar[Any] = TQC

    def _choose_estimates(self, outputs: list[Tensor]) -> Tensor:
        dropped = self._model.top_quantiles_to_drop_per_net * len(outputs)
        estimates = torch.cat(outputs, 1).sort(1)[0]
        return estimates[:, : estimates.shape[1] - dropped]

    def _compute_loss(self, output: Tensor, target: Tensor) -> float:
        """Compare each quantile with each estimate by the quantile Huber loss."""
        errors = target[:, None, :] - output[:, :, None]
        sizes = nn.functional.huber_loss(errors, torch.zeros_like(errors), reduction="none")
        shares = _quantile_shares(output)[:, None]
        loss: float = (sizes * torch.where(errors < 0, 1 - shares, shares)).mean().item()
        return loss / len(self._critics)

    def _differentiate_loss(self, output: Tensor, target: Tensor) -> Tensor:
        # The slope of Huber's loss is the error, at most 1 either way. It counts by the quantile's share where it is
        # positive, by the rest where it is negative; both sums come from the slopes' and their sizes'.
        slopes = (target[:, None, :] - output[:, :, None]).clamp_(-1, 1)
        total, size = slopes.sum(2), slopes.abs_().sum(2)
        return (total + (2 * _quantile_shares(output) - 1) * size) / (-2 * slopes.numel() * len(self._critics))

    def _judge(self, outputs: list[Tensor]) -> tuple[Tensor, list[Tensor]]:
        mean = torch.cat(outputs, 1)
        to_output = torch.full_like(outputs[0], 1 / mean.shape[1])
        return mean.mean(1, keepdim=True), [to_output] * len(outputs)


def _quantile_shares(output: Tensor) -> Tensor:
    """Return how much of the returns is to lie below each quantile, shape (quantiles,)."""
    count = output.shape[1]
    return (torch.arange(count, device=output.device) + 0.5) / count
