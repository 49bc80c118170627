"""PPO, A2C and recurrent PPO on segments played by workers: values and log-probabilities in batched passes."""

import dataclasses
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import NDArray
from sb3_contrib.common.recurrent.type_aliases import RNNStates

from rlctl.environments.dict_spaces import join, split, split_space
from rlctl.play.shared_arrays import SegmentArrays
from rlctl.policy.actor import Exploration
from rlctl.policy.layers import Normalize
from rlctl.training.rollouts import Rollouts, SegmentWatch, Statistics, to_network_layout
from rlctl.training.updates.ppo import PpoUpdate

Arrays = dict[str, NDArray[Any]]

_ROWS = 4096  # observations in one forward pass


@dataclasses.dataclass(frozen=True)
class _SegmentValues:
    values: NDArray[np.float32]  # shape (environments, steps)
    log_probs: NDArray[np.float32]
    last_values: NDArray[np.float32]  # values of the observations after the last step, shape (environments,)
    final_values: NDArray[np.float32]  # values of the final observations of truncated episodes
    states: Arrays = dataclasses.field(default_factory=dict)  # LSTM states before each step, for the recurrent buffer


class OnPolicyRollouts(Rollouts):
    """Plays `n_steps` steps of each environment into the rollout buffer."""

    _statistics: Statistics

    def start(self) -> None:
        """Send the policy to the workers and let them play `n_steps` steps of each environment."""
        model = self.model
        self._statistics = self.acting_statistics()
        self.send_policy(self._statistics)
        every = model.sde_sample_freq if model.use_sde else 0
        self.env.start(model.n_steps, Exploration(stochastic=True, sde_every=max(every, 0)))

    def finish(self, watch: SegmentWatch | None) -> None:
        """Wait for the segment and write it into SB3's rollout buffer."""
        segment = self.env.finish(watch)
        self.model.num_timesteps += segment.reward.size
        self._fill_buffer(segment)
        self.finish_segment(segment)

    def learn(self) -> None:
        """Run the updates of this segment."""
        self._updater.train()

    @torch.no_grad()
    def _fill_buffer(self, segment: SegmentArrays) -> None:
        """Write a segment into SB3's buffer, whose arrays have the shape (steps, environments, ...)."""
        model, buffer = self.model, self.model.rollout_buffer
        truncated = np.nonzero(segment.truncated & ~segment.terminated)
        starts = np.concatenate([np.asarray(model._last_episode_starts)[:, None], segment.done], axis=1)
        observations = {key: self._prepare(key, rows) for key, rows in segment.observation.items()}
        final = {key: self._prepare(key, rows[truncated]) for key, rows in segment.final.items()}
        if hasattr(model, "_last_lstm_states"):
            evaluated = self._evaluate_step_by_step(observations, segment.stored, starts, (truncated, final))
        else:
            evaluated = self._evaluate_segment(observations, segment.stored, final)
        rewards = self.update_reward_statistics(segment)
        rewards[truncated] += model.gamma * evaluated.final_values
        buffer.reset()
        targets: Any = split(buffer.observations)
        for key, rows in observations.items():
            targets[key][...] = rows[:, :-1].swapaxes(0, 1).reshape(targets[key].shape)
        buffer.actions[...] = segment.stored.swapaxes(0, 1)
        buffer.rewards[...] = rewards.T
        buffer.episode_starts[...] = starts[:, :-1].T
        buffer.values[...] = evaluated.values.T
        buffer.log_probs[...] = evaluated.log_probs.T
        for name, values in evaluated.states.items():
            getattr(buffer, name)[...] = values
        buffer.pos, buffer.full = buffer.buffer_size, True
        buffer.compute_returns_and_advantage(
            last_values=torch.from_numpy(evaluated.last_values), dones=segment.done[:, -1].astype(np.float32)
        )

    def _prepare(self, key: str, rows: NDArray[Any]) -> NDArray[Any]:
        """Return observations in the networks' form: normalised, images channels-first."""
        if key in self._statistics:
            normalizer = self.model.get_vec_normalize_env()
            rows = Normalize(key, *self._statistics[key], normalizer.clip_obs, normalizer.epsilon)(rows)
        return to_network_layout(rows, split_space(self.model.observation_space)[key])

    def _evaluate_segment(self, observations: Arrays, actions: NDArray[Any], final: Arrays) -> _SegmentValues:
        policy, (n_envs, steps) = self.model.policy, actions.shape[:2]
        flat = {key: rows[:, :-1].reshape(n_envs * steps, *rows.shape[2:]) for key, rows in observations.items()}
        values, log_probs = self._evaluate_actions(flat, actions.reshape(n_envs * steps, -1))
        ends = {key: np.concatenate([rows[:, -1], final[key]]) for key, rows in observations.items()}
        count = len(next(iter(ends.values())))
        parts = [policy.predict_values(self._to_tensor(ends, rows)).flatten() for rows in _slices(count)]
        after: NDArray[np.float32] = torch.cat(parts).cpu().numpy()
        shape = n_envs, steps
        return _SegmentValues(values.reshape(shape), log_probs.reshape(shape), after[:n_envs], after[n_envs:])

    def _evaluate_actions(self, observations: Arrays, actions: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
        """Return the values of observations and the log-probabilities of actions, shape (rows,)."""
        if isinstance(self._updater, PpoUpdate):
            return self._updater.evaluate(self._to_tensor(observations, slice(None)), actions)
        policy, chosen = self.model.policy, self._to_actions(actions)
        parts_of_batches = [
            policy.evaluate_actions(self._to_tensor(observations, rows), chosen[rows])[:2]
            for rows in _slices(len(chosen))
        ]
        values, log_probs = (
            torch.cat([part.flatten() for part in parts]).cpu().numpy() for parts in zip(*parts_of_batches, strict=True)
        )
        return values, log_probs

    def _evaluate_step_by_step(
        self, observations: Arrays, actions: NDArray[Any], starts: NDArray[np.bool_], ended: tuple[Any, Arrays]
    ) -> _SegmentValues:
        """Evaluate a segment step by step; `ended`: where episodes were truncated, and their final observations."""
        (envs, rows), final = ended
        policy, states, device = self.model.policy, self.model._last_lstm_states, self.model.device
        n_envs, steps = actions.shape[:2]
        begins = torch.as_tensor(starts.astype(np.float32), device=device)
        values, log_probs = np.zeros((2, n_envs, steps), np.float32)
        final_values = np.zeros(len(envs), np.float32)
        before: list[list[NDArray[Any]]] = []
        for step in range(steps):
            before.append([part.cpu().numpy() for pair in (states.pi, states.vf) for part in pair])
            observed = self._to_tensor(observations, (slice(None), step))
            value, log_prob, states = self._step(observed, self._to_actions(actions[:, step]), states, begins[:, step])
            values[:, step], log_probs[:, step] = value.cpu().numpy(), log_prob.cpu().numpy()
            for index in np.flatnonzero(rows == step):
                state = tuple(part[:, envs[index], None].contiguous() for part in states.vf)
                observed = self._to_tensor(final, slice(index, index + 1))
                final_values[index] = policy.predict_values(observed, state, torch.zeros(1, device=device)).item()
        self.model._last_lstm_states = states
        last = policy.predict_values(self._to_tensor(observations, (slice(None), -1)), states.vf, begins[:, -1])
        names = ("hidden_states_pi", "cell_states_pi", "hidden_states_vf", "cell_states_vf")
        stored = {name: np.stack(parts) for name, parts in zip(names, zip(*before, strict=True), strict=True)}
        return _SegmentValues(values, log_probs, last.flatten().cpu().numpy(), final_values, stored)

    def _step(
        self, observed: Any, actions: torch.Tensor, states: RNNStates, begins: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor, RNNStates]:
        """Return values, log-probabilities of given actions and the next states; as sb3-contrib's `forward` does."""
        policy = self.model.policy
        features = policy.extract_features(observed)
        for_actor, for_critic = (features, features) if policy.share_features_extractor else features
        latent_pi, after_pi = policy._process_sequence(for_actor, states.pi, begins, policy.lstm_actor)
        if policy.lstm_critic is not None:
            latent_vf, after_vf = policy._process_sequence(for_critic, states.vf, begins, policy.lstm_critic)
        elif policy.shared_lstm:
            latent_vf, after_vf = latent_pi.detach(), tuple(part.detach() for part in after_pi)
        else:
            latent_vf, after_vf = policy.critic(for_critic), after_pi
        values = policy.value_net(policy.mlp_extractor.forward_critic(latent_vf)).flatten()
        distribution = policy._get_action_dist_from_latent(policy.mlp_extractor.forward_actor(latent_pi))
        return values, distribution.log_prob(actions), RNNStates(after_pi, after_vf)

    def _to_tensor(self, observations: Arrays, rows: Any) -> Any:
        device = self.model.device
        return join({key: torch.as_tensor(value[rows], device=device) for key, value in observations.items()})

    def _to_actions(self, actions: NDArray[Any]) -> torch.Tensor:
        chosen = torch.as_tensor(actions, device=self.model.device)
        return chosen.flatten() if isinstance(self.model.action_space, spaces.Discrete) else chosen.float()


def _slices(count: int) -> list[slice]:
    return [slice(low, low + _ROWS) for low in range(0, count, _ROWS)]
