"""Gradients of PPO's loss for one row block of a minibatch, in NumPy; `ppo.py` does the updates.

The name of a gradient is its variable: `to_mean` is the gradient of the loss with respect to the mean.
"""

import dataclasses

import numpy as np

from rlctl.play.shared_arrays import ArrayLayout
from rlctl.task.mirror import Mirror
from rlctl.training.updates.blocks import MAX_BLOCKS, Arrays, BlockWork, select_block
from rlctl.training.updates.perceptrons import LOG_SQRT_TAU, ArrayShapes, Floats, MlpStack, list_shapes, split_vector

DIFFERENTIATE, EVALUATE = 0, 1  # phases
LOSSES = ("policy_gradient_loss", "entropy_loss", "clip_fraction", "approx_kl", "value_loss", "mirror_loss")
_ROWS = 1024  # of one forward pass in an evaluation


@dataclasses.dataclass(frozen=True)
class PpoSettings:
    """Networks and constants; sizes are those of the inputs and of each layer's outputs."""

    rows: int  # of the rollout: steps * environments
    actor: tuple[int, ...]
    critic: tuple[int, ...]
    actor_uses_tanh: bool
    critic_uses_tanh: bool
    log_std: tuple[int, ...]  # shape
    sde_epsilon: float | None  # None without gSDE
    ent_coef: float
    vf_coef: float
    mirror: tuple[tuple[int, ...], tuple[int, ...]] | None = None  # the places of features and actions; see `Mirror`
    mirror_images: bool = True  # whether they are learned from as if they had been played
    mirror_loss: float = 0.0  # weight

    def list_shapes(self) -> ArrayShapes:
        """Return the shapes of the parameters: of the actor, of the critic, of the deviation."""
        return [*list_shapes(self.actor), *list_shapes(self.critic), self.log_std]

    def make_layout(self) -> ArrayLayout:
        """Return the arrays that all processes share besides the parameters and their gradients."""
        floats, numbers = np.dtype(np.float32), np.dtype(np.float64)
        return {
            "losses": ((MAX_BLOCKS, len(LOSSES)), numbers),  # sums of each block
            "features": ((self.rows, self.critic[0]), floats),  # the actor sees the first of them
            "actions": ((self.rows, self.actor[-1]), floats),
            **dict.fromkeys(("values", "log_probs", "returns"), ((self.rows,), floats)),
            "order": ((self.rows,), np.dtype(np.int64)),  # of the rows in this epoch
            "advantages": ((self.rows,), floats),  # in this order, normalized
            "minibatch": ((3,), np.dtype(np.int64)),  # its first row, its rows, its blocks
            "clip_ranges": ((2,), numbers),  # of the ratio, and of the values; infinite without one
        }


class PpoGradients(BlockWork):
    """Computes the gradients of all parameters for the rows of a block."""

    def __init__(self, arrays: Arrays, settings: PpoSettings) -> None:
        self._arrays, self._settings = arrays, settings
        shapes, layers = settings.list_shapes(), 2 * len(settings.actor) - 2
        *networks, self._log_std = split_vector(arrays["parameters"], shapes)
        self._actor = MlpStack(networks[:layers], uses_tanh=settings.actor_uses_tanh)
        self._critic = MlpStack(networks[layers:], uses_tanh=settings.critic_uses_tanh)
        gradients = [split_vector(row, shapes) for row in arrays["gradients"]]
        places = settings.mirror
        self._mirrors = {} if places is None else {"features": Mirror(places[0]), "actions": Mirror(places[1])}
        self._copies = 2 if places is not None and settings.mirror_images else 1
        """How often each row of a minibatch is learned from: a second time as its mirror image."""
        self._gradients = [(parts[:layers], parts[layers:-1], parts[-1]) for parts in gradients]

    def compute(self, phase: int, task: int) -> None:
        """Do a phase for a block of the minibatch: two tasks for each block, the actor's and the critic's."""
        block, is_critic = divmod(task, 2)
        first, size, count = self._arrays["minibatch"].tolist()
        rows = select_block(block, count, first, size)
        if phase == EVALUATE:
            (self._evaluate_critic if is_critic else self._evaluate_actor)(rows)
        else:
            (self._differentiate_critic if is_critic else self._differentiate_actor)(block, rows, size)

    def _evaluate_actor(self, rows: slice) -> None:
        """Write the log-probabilities of the rollout's actions."""
        for part in _split(rows):
            actor = self._actor.run(self._arrays["features"][None, part, : self._settings.actor[0]], "actor")
            z = self._arrays["actions"][part] - actor[-1][0]
            std = self._compute_std(actor)
            z /= std
            self._arrays["log_probs"][part] = _compute_log_prob(np.square(z), np.log(std))

    def _evaluate_critic(self, rows: slice) -> None:
        """Write the values of the rollout's observations."""
        for part in _split(rows):
            self._arrays["values"][part] = self._critic.run(self._arrays["features"][None, part], "critic")[-1].ravel()

    def _take(self, name: str, rows: slice) -> Floats:
        """Return rows of the rollout, in this epoch's order, and after them their mirror images."""
        values: Floats = self._arrays[name].take(self._arrays["order"][rows], axis=0)
        return self._add_mirrored(name, values)

    def _add_mirrored(self, name: str, values: Floats) -> Floats:
        if self._copies == 1:
            return values
        return np.concatenate([values, self._mirrors[name](values) if name in self._mirrors else values])

    def _differentiate_actor(self, block: int, rows: slice, size: int) -> None:
        """Set a block's gradients of the minibatch's mean loss, and its sums of what is logged."""
        size *= self._copies
        clip_range = float(self._arrays["clip_ranges"][0])
        features = self._take("features", rows)
        learned = len(features)
        if self._settings.mirror_loss and self._copies == 1:
            features = np.concatenate([features, self._mirrors["features"](features)])
        everything = self._actor.run(features[None, :, : self._settings.actor[0]], "actor")
        actor = [layer[:, :learned] for layer in everything]
        std = self._compute_std(actor)
        z = self._take("actions", rows) - actor[-1][0]
        z /= std
        log_std, squared = np.log(std), np.square(z)
        log_ratio = _compute_log_prob(squared, log_std) - self._take("log_probs", rows)
        ratio = np.exp(log_ratio)
        advantages = self._add_mirrored("advantages", self._arrays["advantages"][rows])
        unclipped, clipped = advantages * ratio, advantages * ratio.clip(1 - clip_range, 1 + clip_range)
        # If the clipped term is smaller, the loss does not depend on the policy.
        to_log_prob = (unclipped * (unclipped <= clipped) / np.float32(-size))[:, None]
        squared -= 1
        squared *= to_log_prob
        squared -= np.float32(self._settings.ent_coef / size)
        to_actor, _, to_log_std = self._gradients[block]
        self._differentiate_std(actor, std, squared, to_log_std)
        z /= std
        z *= to_log_prob
        to_mean = z
        if self._settings.mirror_loss:
            differences = self._compare_with_images(everything[-1][0])
            to_mean = differences * np.float32(2 * self._settings.mirror_loss * self._copies / size)
            to_mean[:learned] += z
            first = differences[: len(differences) // 2]
            self._arrays["losses"][block, 5] = np.vdot(first, first)
        self._actor.backpropagate(everything, to_mean[None], to_actor)
        entropy = float(log_std.sum()) * (1 if log_std.ndim > 1 else len(z)) + (0.5 + LOG_SQRT_TAU) * z.size
        self._arrays["losses"][block, :4] = (
            -float(np.minimum(unclipped, clipped).sum()),
            -entropy,
            np.count_nonzero(np.abs(ratio - 1) > clip_range),
            float((ratio - 1 - log_ratio).sum()),
        )
        self._arrays["losses"][block, :4] /= self._copies

    def _compare_with_images(self, means: Floats) -> Floats:
        """Return the differences of means from the mirrored means of their images, which are in the other half.

        W. Yu et al., Learning symmetric and low-energy locomotion, 2018, https://arxiv.org/abs/1801.08093, equation 4.
        """
        rows = len(means) // 2
        differences: Floats = means - self._mirrors["actions"](np.concatenate([means[rows:], means[:rows]]))
        return differences

    def _differentiate_critic(self, block: int, rows: slice, size: int) -> None:
        size *= self._copies
        clip_range = float(self._arrays["clip_ranges"][1])
        critic = self._critic.run(self._take("features", rows)[None], "critic")
        errors = critic[-1].ravel() - self._take("returns", rows)
        to_value = errors
        if clip_range < np.inf:
            before = self._take("values", rows)
            moved = critic[-1].ravel() - before
            errors = before + moved.clip(-clip_range, clip_range) - self._take("returns", rows)
            to_value = errors * (np.abs(moved) <= clip_range)
        self._arrays["losses"][block, 4] = np.vdot(errors, errors) / self._copies
        to_value = to_value * np.float32(2 * self._settings.vf_coef / size)
        self._critic.backpropagate(critic, to_value[None, :, None], self._gradients[block][1])

    def _compute_std(self, actor: list[Floats]) -> Floats:
        """Return the standard deviation of actions, shape (actions,), with gSDE (batch, actions)."""
        if self._settings.sde_epsilon is None:
            return np.exp(self._log_std)
        variances: Floats = np.square(actor[-2][0]) @ np.exp(2 * self._log_std) + np.float32(self._settings.sde_epsilon)
        return np.sqrt(variances)

    def _differentiate_std(self, actor: list[Floats], std: Floats, gradient: Floats, to_log_std: Floats) -> None:
        """Set the gradient of `log_std` from that of the logarithm of `_compute_std`, shape (batch, actions)."""
        if self._settings.sde_epsilon is None:
            np.sum(gradient, 0, out=to_log_std)
            return
        # std^2 = latent^2 @ exp(2 log_std) + epsilon; no gradient flows into the latent values, as in SB3.
        of_variance = np.square(actor[-2][0]).T @ (gradient / np.square(std))
        np.multiply(of_variance, np.exp(2 * self._log_std), out=to_log_std)


def _compute_log_prob(squared: Floats, log_std: Floats) -> Floats:
    """Return the log-probabilities of actions from the squares of their standardized values."""
    log_prob: Floats = squared.sum(1) * np.float32(-0.5)
    log_prob -= log_std.sum(-1) + np.float32(LOG_SQRT_TAU * squared.shape[1])
    return log_prob


def _split(rows: slice) -> list[slice]:
    return [slice(first, min(first + _ROWS, rows.stop)) for first in range(rows.start, rows.stop, _ROWS)]
