"""Rollouts of a student, from which it learns its teacher's actions; then an on-policy algorithm goes on.

DAgger: S. Ross et al., A Reduction of Imitation Learning and Structured Prediction to No-Regret Online Learning, 2011,
https://arxiv.org/abs/1011.0686. The critic learns the returns meanwhile.
"""

import math
from collections.abc import Iterator
from typing import Any

import numpy as np
import torch
from gymnasium import spaces

from rlctl.environments.dict_spaces import split_space
from rlctl.recipe.recipe import Recipe
from rlctl.training import snapshot
from rlctl.training.demonstrations import set_noise
from rlctl.training.distilling.labelled_steps import LabelledSteps
from rlctl.training.on_policy import OnPolicyRollouts
from rlctl.training.progress import Progress
from rlctl.training.rollouts import SegmentWatch, WorkerVecEnv
from rlctl.training.snapshot import Tensors

TEACHER_SHARE = 0.2
"""Share of the distillation in which the teacher also acts, in fewer and fewer environments."""
_FIRST_RATE, _LAST_RATE = 1e-3, 1e-4
_EPOCHS, _BATCH = 5, 256  # where the algorithm has none
_LARGEST_SCALE = 1e3  # half width of an action's range, above which it counts as unbounded

Minibatch = tuple[Any, torch.Tensor, torch.Tensor, tuple[Any, ...], torch.Tensor]
"""Observations, labels, returns, LSTM states with episode starts (empty without), and which rows count."""


class DistillingRollouts(OnPolicyRollouts):
    """Learns the teacher's actions in the first `steps` steps, then as the algorithm does."""

    def __init__(self, model: Any, env: WorkerVecEnv, recipe: Recipe, progress: Progress, steps: int) -> None:
        super().__init__(model, env, recipe, progress)
        self._steps = steps
        self._teaches = True  # whether the teacher has labelled the segment
        self._optimizer = torch.optim.Adam(model.policy.parameters(), _FIRST_RATE)
        self._labelled = LabelledSteps()
        self._scale = torch.ones(1, device=model.device)
        if isinstance(model.action_space, spaces.Box):
            half = (model.action_space.high - model.action_space.low) / 2
            self._scale = torch.as_tensor(np.where(half < _LARGEST_SCALE, half, 1.0).ravel(), device=model.device)

    @property
    def _share_done(self) -> float:
        return self.model.num_timesteps / self._steps

    def start(self) -> None:
        """Let the workers play a segment; at first the teacher acts in some environments, drawn for each segment."""
        self._teaches = self._share_done < 1.0
        count = math.ceil(max(0.0, 1.0 - self._share_done / TEACHER_SHARE) * self.env.num_envs)
        self.env.taught = self._rng().permutation(self.env.num_envs)[:count].tolist()
        super().start()

    def _rng(self) -> np.random.Generator:
        return np.random.default_rng([self.model.seed, self.model.num_timesteps])

    def finish(self, watch: SegmentWatch | None) -> None:
        """Wait for the segment and store it, with the teacher's actions in the place of those that were taken."""
        super().finish(watch)
        segment, buffer = self.env.last_segment, self.model.rollout_buffer
        if not self._teaches or segment is None:
            return
        labels = segment.label.reshape(*segment.label.shape[:2], -1)
        buffer.actions[...] = labels.swapaxes(0, 1)
        if self._is_recurrent:  # its states become outdated
            return
        rows = {f"observation/{key}": values[:, :-1] for key, values in segment.observation.items()}
        rows |= {"label": labels, "return": buffer.returns.T}
        self._labelled.add({name: values.reshape(-1, *values.shape[2:]) for name, values in rows.items()})

    @property
    def _is_recurrent(self) -> bool:
        return hasattr(self.model, "_last_lstm_states")

    def learn(self) -> None:
        """Learn the labels of this segment and of the newest before it, without a teacher as the algorithm does."""
        if not self._teaches:
            super().learn()
            return
        model, policy = self.model, self.model.policy
        for group in self._optimizer.param_groups:
            group["lr"] = _FIRST_RATE + (_LAST_RATE - _FIRST_RATE) * min(self._share_done, 1.0)
        policy.set_training_mode(True)
        losses = []
        for minibatch in self._sample():
            imitation, value = self._compute_losses(*minibatch)
            self._optimizer.zero_grad(set_to_none=False)  # `training/updates` shares the memory of the gradients
            torch.autograd.backward(imitation + model.vf_coef * value)
            self._optimizer.step()
            losses.append((imitation.item(), value.item()))
        policy.set_training_mode(False)
        with torch.no_grad():
            set_noise(model)
        model._n_updates += getattr(model, "n_epochs", _EPOCHS)
        for name, mean in zip(("policy_loss", "value_loss"), np.mean(losses, axis=0), strict=True):
            model.logger.record(f"train/{name}", float(mean))
        model.logger.record("train/learning_rate", self._optimizer.param_groups[0]["lr"])
        model.logger.record("train/n_updates", model._n_updates, exclude="tensorboard")
        if self._share_done >= 1.0:
            self._labelled = LabelledSteps()

    def _sample(self) -> Iterator[Minibatch]:
        """Yield as many minibatches as the algorithm's own update of a segment has."""
        model, rng, buffer = self.model, self._rng(), self.model.rollout_buffer
        size, epochs = getattr(model, "batch_size", _BATCH), getattr(model, "n_epochs", _EPOCHS)
        self._statistics = self.acting_statistics()
        if self._is_recurrent:
            for _ in range(epochs):
                for data in buffer.get(size):
                    states = data.lstm_states, data.episode_starts
                    yield data.observations, data.actions, data.returns, states, data.mask > 0
            return
        for _ in range(epochs * math.ceil(buffer.buffer_size * buffer.n_envs / size)):
            rows = self._labelled.sample(rng, size)
            parts = {key: rows[f"observation/{key}"] for key in split_space(model.observation_space)}
            observed = self._to_tensor({key: self._prepare(key, part) for key, part in parts.items()}, slice(None))
            labels, returns = (torch.as_tensor(rows[name], device=model.device) for name in ("label", "return"))
            yield observed, labels, returns, (), torch.ones(size, dtype=torch.bool, device=model.device)

    def _compute_losses(
        self, observed: Any, labels: torch.Tensor, returns: torch.Tensor, states: tuple[Any, ...], counts: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the loss of the actor, squared errors or a negative log-likelihood, and that of the critic."""
        policy = self.model.policy
        if states:
            both, starts = states
            distribution, _ = policy.get_distribution(observed, both.pi, starts)
            values = policy.predict_values(observed, both.vf, starts)
        elif policy.share_features_extractor:
            features = policy.extract_features(observed)  # once: of pictures it takes most of the time
            latent = policy.mlp_extractor.forward_actor(features)
            distribution = policy._get_action_dist_from_latent(latent)
            # The critic does not change the features that the actor needs.
            values = policy.value_net(policy.mlp_extractor.forward_critic(features.detach()))
        else:
            distribution, values = policy.get_distribution(observed), policy.predict_values(observed)
        if isinstance(self.model.action_space, spaces.Box):
            errors = ((distribution.mode().flatten(1) - labels) / self._scale).square().mean(dim=1)
        else:
            is_single = isinstance(self.model.action_space, spaces.Discrete)
            errors = -distribution.log_prob(labels.long().flatten() if is_single else labels)
        return errors[counts].mean(), (values.flatten() - returns).square()[counts].mean()

    def take(self) -> tuple[Tensors, Any]:
        """Return the optimiser and the labelled steps for a checkpoint; nothing after the distillation."""
        if self._share_done >= 1.0:
            return {}, None
        tensors, plain = snapshot.flatten(self._optimizer.state_dict(), "distilling")
        return tensors | self._labelled.take(), plain

    def restore(self, tensors: Tensors, plain: Any) -> None:
        """Restore what `take` returned."""
        if plain is not None:
            self._optimizer.load_state_dict(snapshot.unflatten(plain, tensors))
            self._labelled.restore(tensors)
