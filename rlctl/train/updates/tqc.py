"""TQC's updates with gradients computed without autograd: what sb3-contrib's `TQC.train` computes, but for rounding.

A. Kuznetsov et al., Controlling Overestimation Bias with Truncated Mixture of Continuous Distributional Quantile
Critics, 2020, https://arxiv.org/abs/2005.04269.
"""

from __future__ import annotations

from typing import Any, ClassVar

import torch
from sb3_contrib import TQC
from torch import Tensor

from rlctl.train.updates.sac import SacUpdate


class TqcUpdate(SacUpdate):
    """SAC's update with critics that estimate quantiles of the return, of which the highest do not count."""

    algorithm: ClassVar[Any] = TQC

    def _choose_estimates(self, outputs: list[Tensor]) -> Tensor:
        dropped = self._model.top_quantiles_to_drop_per_net * len(outputs)
        estimates = torch.cat(outputs, 1).sort(1)[0]
        return estimates[:, : estimates.shape[1] - dropped]

    def _compare(self, output: Tensor, target: Tensor) -> tuple[float, Tensor]:
        """Compare each quantile with each estimate by the quantile Huber loss."""
        quantiles = output.shape[1]
        share = (torch.arange(quantiles, device=output.device) + 0.5).div(quantiles).view(1, -1, 1)
        error = target.unsqueeze(1) - output.unsqueeze(2)
        slope = error.clamp(-1, 1)
        count = error.numel() * len(self._critics)
        weighted = slope * torch.where(error < 0, 1 - share, share)
        # Huber's loss is slope * (error - slope / 2): half the square of a small error.
        loss = (weighted * (error - 0.5 * slope)).sum().item() / count
        return loss, weighted.sum(2) / -count

    def _judge(self, outputs: list[Tensor]) -> tuple[Tensor, list[Tensor]]:
        mean = torch.cat(outputs, 1)
        to_output = torch.full_like(outputs[0], 1 / mean.shape[1])
        return mean.mean(1, keepdim=True), [to_output] * len(outputs)
