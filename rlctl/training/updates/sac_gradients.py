"""Gradients of the losses of SAC and TQC for one row block of a minibatch, in NumPy; `sac.py` does the updates.

The name of a gradient is its variable: `to_action` is the gradient of the loss with respect to the action.
"""

import dataclasses
import math

import numpy as np

from rlctl.play.shared_arrays import ArrayLayout
from rlctl.training.updates.blocks import MAX_BLOCKS, Arrays, BlockWork, select_block
from rlctl.training.updates.perceptrons import ArrayShapes, Floats, MlpStack, count_floats, list_shapes, split_vector
from rlctl.training.updates.squashed_gaussian import SquashedGaussian

CRITICS, ACTOR = 0, 1  # phases
CRITIC_LOSS, ACTOR_LOSS, LOG_PROB = 0, 1, 2  # columns of the sums


@dataclasses.dataclass(frozen=True)
class SacSettings:
    """Networks and constants; sizes are those of the inputs and of each layer's outputs."""

    rows: int  # of a minibatch
    actions: int
    actor: tuple[int, ...]
    actor_uses_tanh: bool
    critic: tuple[int, ...]
    critic_uses_tanh: bool
    critics: int
    log_std: tuple[int, ...] | None  # shape, with gSDE
    epsilon: float
    mean_limit: float | None
    dropped: int = 0  # TQC: of all critics' quantiles
    atoms: tuple[float, float] | None = None  # XQC: the first and the last return of the support

    def list_critic_shapes(self) -> ArrayShapes:
        """Return the shapes of the critics' parameters, which come first."""
        return list_shapes(self.critic, self.critics)

    def list_actor_shapes(self) -> ArrayShapes:
        """Return the shapes of the actor's parameters; with gSDE `log_std` is the last."""
        return list_shapes(self.actor) + ([] if self.log_std is None else [self.log_std])

    def list_shapes(self) -> ArrayShapes:
        """Return the shapes of all trained parameters."""
        return [*self.list_critic_shapes(), *self.list_actor_shapes()]

    def make_layout(self) -> ArrayLayout:
        """Return the arrays that all processes share besides the parameters and their gradients."""
        floats = np.dtype(np.float32)
        normal = (self.rows, self.actions) if self.log_std is None else self.log_std
        return {
            "targets": ((count_floats(self.list_critic_shapes()),), floats),  # parameters of the target critics
            "features": ((self.rows, self.critic[0] - self.actions), floats),  # the actor sees the first of them
            "next_features": ((self.rows, self.critic[0] - self.actions), floats),
            "actions": ((self.rows, self.actions), floats),
            "rewards": ((self.rows, 1), floats),
            "discounts": ((self.rows, 1), floats),
            "normal": (normal, floats),  # for actions of `features`; gSDE has one matrix for both
            "next_normal": (normal if self.log_std is None else (0,), floats),
            "numbers": ((3,), np.dtype(np.float64)),  # entropy coefficient, whether to compute losses, blocks
            "sums": ((MAX_BLOCKS, 3), np.dtype(np.float64)),
        }

    def count_weights(self) -> int:
        """Return the number of trained parameters."""
        return sum(math.prod(shape) for shape in self.list_shapes())


class SacGradients(BlockWork):
    """First the critics' gradients, by targets from the next actions; after their update the actor's gradients."""

    def __init__(self, arrays: Arrays, settings: SacSettings) -> None:
        self._arrays, self._settings = arrays, settings
        split, layers = len(settings.list_critic_shapes()), 2 * len(settings.actor) - 2
        parameters = split_vector(arrays["parameters"], settings.list_shapes())
        targets = split_vector(arrays["targets"], settings.list_critic_shapes())
        of_actor = parameters[split:]
        network = MlpStack(of_actor[:layers], uses_tanh=settings.actor_uses_tanh)
        log_std = None if settings.log_std is None else of_actor[-1]
        self._actor = SquashedGaussian(network, log_std, settings.actions, settings.epsilon, settings.mean_limit)
        self._critics = MlpStack(parameters[:split], uses_tanh=settings.critic_uses_tanh)
        self._targets = MlpStack(targets, uses_tanh=settings.critic_uses_tanh)
        gradients = [split_vector(row, settings.list_shapes()) for row in arrays["gradients"]]
        self._gradients = [(row[:split], row[split:]) for row in gradients]

    def compute(self, phase: int, task: int) -> None:
        """Set a block's gradients of the minibatch's mean loss, and its sums of what is logged."""
        rows = select_block(task, int(self._arrays["numbers"][2]), 0, self._settings.rows)
        (self._differentiate_critics if phase == CRITICS else self._differentiate_actor)(task, rows)

    def _take(self, name: str, rows: slice) -> Floats:
        """Return rows of an array; gSDE's noise matrix is for all rows."""
        is_matrix = self._settings.log_std is not None and name.endswith("normal")
        return self._arrays["normal"] if is_matrix else self._arrays[name][rows]

    def _differentiate_critics(self, block: int, rows: slice) -> None:
        coefficient, with_loss = np.float32(self._arrays["numbers"][0]), self._arrays["numbers"][1]
        features = self._take("next_features", rows)
        sample = self._actor.sample(features[:, : self._settings.actor[0]], "next", self._take("next_normal", rows))
        estimates = self._targets.run(np.concatenate([features, sample.action], 1)[None], "target")[-1]
        target = self._make_target(estimates, coefficient * sample.log_prob, rows)
        inputs = np.concatenate([self._take("features", rows), self._take("actions", rows)], 1)
        passed = self._critics.run(inputs[None], "learning")
        if with_loss:
            self._arrays["sums"][block, CRITIC_LOSS] = self._compute_loss(passed[-1], target)
        self._critics.backpropagate(passed, self._differentiate_loss(passed[-1], target), self._gradients[block][0])

    def _differentiate_actor(self, block: int, rows: slice) -> None:
        coefficient, features = float(self._arrays["numbers"][0]), self._take("features", rows)
        normal = self._take("normal", rows)
        sample = self._actor.sample(features[:, : self._settings.actor[0]], "learning", normal)
        passed = self._critics.run(np.concatenate([features, sample.action], 1)[None], "actor")
        value, to_outputs = self._value(passed[-1])
        sums = self._arrays["sums"][block]
        sums[LOG_PROB], sums[ACTOR_LOSS] = sample.log_prob.sum(), (coefficient * sample.log_prob - value).sum()
        to_outputs /= np.float32(-self._settings.rows)
        to_action = self._critics.input_gradient(passed, to_outputs, features.shape[1]).sum(0)
        to_log_prob = coefficient / self._settings.rows
        self._actor.backpropagate(sample, normal, to_action, to_log_prob, list(self._gradients[block][1]))

    def _make_target(self, outputs: Floats, penalty: Floats, rows: slice) -> Floats:
        """Return what the critics learn, from the outputs for the next step and the next actions' entropy penalty."""
        values = self._choose_estimates(outputs) - penalty
        return self._take("rewards", rows) + self._take("discounts", rows) * values

    def _choose_estimates(self, outputs: Floats) -> Floats:
        """Return the target critics' estimates that form the target, shape (batch, estimates)."""
        return outputs.min(0)

    def _compute_loss(self, outputs: Floats, target: Floats) -> float:
        """Return the sum over the rows of the critics' loss."""
        return 0.5 * float(np.square(outputs - target).sum())

    def _differentiate_loss(self, outputs: Floats, target: Floats) -> Floats:
        """Return the gradient of the critics' loss with respect to their outputs, shape (critics, batch, outputs)."""
        return (outputs - target) / np.float32(self._settings.rows)

    def _value(self, outputs: Floats) -> tuple[Floats, Floats]:
        """Return the value from the critics' outputs, shape (batch, 1), and its gradient with respect to them."""
        to_outputs = (np.arange(len(outputs))[:, None, None] == outputs.argmin(0)).astype(np.float32)
        return outputs.min(0), to_outputs


class TqcGradients(SacGradients):
    """SAC with critics that estimate quantiles of the return; the highest are dropped from targets.

    A. Kuznetsov et al., Controlling Overestimation Bias with Truncated Mixture of Continuous Distributional Quantile
    Critics, 2020, https://arxiv.org/abs/2005.04269.
    """

    def _choose_estimates(self, outputs: Floats) -> Floats:
        estimates = np.sort(np.concatenate(list(outputs), 1), axis=1)
        return estimates[:, : estimates.shape[1] - self._settings.dropped]

    def _compute_loss(self, outputs: Floats, target: Floats) -> float:
        """Compare each quantile with each estimate by the quantile Huber loss."""
        errors = target[:, None, :] - outputs[..., None]
        sizes = np.abs(errors)
        sizes = np.where(sizes <= 1, 0.5 * np.square(sizes), sizes - 0.5)
        shares = _quantile_shares(outputs)[:, None]
        return (
            float((sizes * np.where(errors < 0, 1 - shares, shares)).sum()) / (sizes[0].size / len(target)) / len(sizes)
        )

    def _differentiate_loss(self, outputs: Floats, target: Floats) -> Floats:
        # The derivative of the Huber loss is the error, clipped to [-1, 1]. Its weight is the
        # quantile's share if positive, else 1 - share; both sums follow from the slopes' sum and absolute sum.
        # The axes are (estimates, critics, quantiles, batch): sums over the first one are those of long arrays.
        errors = np.ascontiguousarray(target.T)[:, None, None] - np.ascontiguousarray(outputs.swapaxes(1, 2))
        np.clip(errors, -1, 1, out=errors)
        total = np.add.reduce(errors, axis=0).swapaxes(1, 2)
        size = np.add.reduce(np.abs(errors, out=errors), axis=0).swapaxes(1, 2)
        count = np.float32(-2 * self._settings.rows * outputs.shape[2] * target.shape[1] * len(outputs))
        return np.ascontiguousarray((total + (2 * _quantile_shares(outputs) - 1) * size) / count)

    def _value(self, outputs: Floats) -> tuple[Floats, Floats]:
        count = outputs.shape[0] * outputs.shape[2]
        value: Floats = outputs.mean((0, 2))[:, None]
        return value, np.full_like(outputs, 1 / count)


def _quantile_shares(outputs: Floats) -> Floats:
    """Return the share of returns below each quantile, shape (quantiles,)."""
    count = outputs.shape[-1]
    return (np.arange(count, dtype=np.float32) + np.float32(0.5)) / np.float32(count)
