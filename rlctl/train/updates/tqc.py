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
        """Compare each quantile with each estimate by the quantile Huber loss.

        Its slope is the error, at most 1 either way; the loss is half the error's square, and beyond 1 its size less a
        half. The estimates are sorted, so the sums over those within a range come from where its ends are: not every
        quantile has to be compared with every estimate.
        """
        place, size = output.double(), output.shape[1]
        share = (torch.arange(size, device=output.device) + 0.5) / size
        ends = torch.searchsorted(target, torch.cat([output - 1, output, output + 1], 1))
        number, total, square = (_sum_between(target.double().pow(power), ends) for power in range(3))
        # In the ranges of errors below -1, to 0, to 1, and above it.
        errors, squares = total - number * place, square - 2 * place * total + number * place.square()
        slope_below, slope_above = errors[1] - number[0], errors[2] + number[3]
        loss_below = 0.5 * (squares[1] - number[0]) - errors[0]
        loss_above = 0.5 * (squares[2] - number[3]) + errors[3]
        compared = output.numel() * target.shape[1] * len(self._critics)
        loss = ((1 - share) * loss_below + share * loss_above).sum().item() / compared
        return loss, (((1 - share) * slope_below + share * slope_above) / -compared).float()

    def _judge(self, outputs: list[Tensor]) -> tuple[Tensor, list[Tensor]]:
        mean = torch.cat(outputs, 1)
        to_output = torch.full_like(outputs[0], 1 / mean.shape[1])
        return mean.mean(1, keepdim=True), [to_output] * len(outputs)


def _sum_between(values: Tensor, ends: Tensor) -> Tensor:
    """Return sums over a row's values before, between and after three ends, shape (4, batch, quantiles)."""
    sums = torch.nn.functional.pad(values.cumsum(1), (1, 0))
    first, second, third = sums.gather(1, ends).chunk(3, 1)
    return torch.stack([first, second - first, third - second, sums[:, -1:] - third])
