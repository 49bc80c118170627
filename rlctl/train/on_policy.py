"""PPO, A2C and recurrent PPO on segments that workers have played: values and log-probabilities in one batched pass."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import NDArray
from sb3_contrib.common.recurrent.type_aliases import RNNStates
from stable_baselines3.common.vec_env import VecNormalize

from rlctl.dict_spaces import join, split, split_space
from rlctl.run.acting import Exploration
from rlctl.train.rollouts import Check, Rollouts, Statistics, to_network_layout
from rlctl.train.vec_env import PlayedSegment

Arrays = dict[str, NDArray[Any]]

_ROWS = 4096
"""Observations in one forward pass."""


class OnPolicyRollouts(Rollouts):
    """Plays `n_steps` steps of each environment into the rollout buffer."""

    _statistics: Statistics

    def start(self) -> None:
        model = self.model
        self._statistics = self.acting_statistics()
        self.send_policy(self._statistics)
        every = model.sde_sample_freq if model.use_sde else 0
        self.env.start(model.n_steps, Exploration(stochastic=True, sde_every=max(every, 0)))

    def finish(self, check: Check | None) -> None:
        segment = self.env.finish(check)
        self.model.num_timesteps += segment.reward.size
        self._fill_buffer(segment, self.update_reward_statistics(segment))
        self.finish_segment(segment)

    def learn(self) -> None:
        self._learner.train()

    def _fill_buffer(self, segment: PlayedSegment, rewards: NDArray[np.float32]) -> None:
        """Write a segment into SB3's buffer, whose arrays have the shape (steps, environments, ...)."""
        model, buffer = self.model, self.model.rollout_buffer
        inputs = self._prepare(segment)
        with torch.no_grad():
            judge = _Recurrent if hasattr(model, "_last_lstm_states") else _FeedForward
            judged = judge(model).judge(inputs)
        rewards[tuple(inputs.truncated.T)] += model.gamma * judged.final_values
        buffer.reset()
        targets: Any = split(buffer.observations)
        for key, rows in inputs.observations.items():
            targets[key][...] = rows[:, :-1].swapaxes(0, 1).reshape(targets[key].shape)
        buffer.actions[...] = inputs.actions.swapaxes(0, 1)
        buffer.rewards[...] = rewards.T
        buffer.episode_starts[...] = inputs.starts.T
        buffer.values[...] = judged.values.T
        buffer.log_probs[...] = judged.log_probs.T
        for name, values in judged.states.items():
            getattr(buffer, name)[...] = values
        buffer.pos, buffer.full = buffer.buffer_size, True
        buffer.compute_returns_and_advantage(
            last_values=torch.from_numpy(judged.last_values), dones=segment.done[:, -1].astype(np.float32)
        )

    def _prepare(self, segment: PlayedSegment) -> Inputs:
        model = self.model
        prepare = _Preparation(model.observation_space, self._statistics, model.get_vec_normalize_env())
        truncated = np.argwhere(segment.truncated & ~segment.terminated)
        starts = np.concatenate([np.asarray(model._last_episode_starts)[:, None], segment.done[:, :-1]], axis=1)
        return Inputs(
            {key: prepare(key, rows) for key, rows in segment.observation.items()},
            segment.stored,
            starts,
            segment.done,
            truncated,
            {key: prepare(key, rows[tuple(truncated.T)]) for key, rows in segment.final.items()},
        )


@dataclasses.dataclass(frozen=True)
class Inputs:
    """A segment as the networks need it; arrays of shape (environments, steps, ...)."""

    observations: Arrays
    """Normalised; one row more than steps: what followed the last."""
    actions: NDArray[Any]
    """As the policy chose them."""
    starts: NDArray[np.bool_]
    """Where an episode began."""
    done: NDArray[np.bool_]
    """Where one ended."""
    truncated: NDArray[np.int64]
    """Environment and step of each that was truncated, shape (episodes, 2)."""
    final: Arrays
    """What those ended with, shape (episodes, ...)."""


@dataclasses.dataclass(frozen=True)
class Judgement:
    """What the networks say of a segment."""

    values: NDArray[np.float32]
    """Shape (environments, steps)."""
    log_probs: NDArray[np.float32]
    last_values: NDArray[np.float32]
    """Of what followed the last step, shape (environments,)."""
    final_values: NDArray[np.float32]
    """Of what truncated episodes ended with."""
    states: Arrays = dataclasses.field(default_factory=dict)
    """Of the recurrent buffer: the states before each step."""


class _Preparation:
    """Makes a network's inputs of raw observations: normalised, images with their channels first."""

    def __init__(self, space: spaces.Space[Any], statistics: Statistics, normalizer: VecNormalize | None) -> None:
        self._spaces = split_space(space)
        self._statistics = statistics
        self._normalizer = normalizer

    def __call__(self, key: str, rows: NDArray[Any]) -> NDArray[Any]:
        if key in self._statistics and self._normalizer is not None:
            mean, var = self._statistics[key]
            limit = self._normalizer.clip_obs
            rows = np.clip((rows - mean) / np.sqrt(var + self._normalizer.epsilon), -limit, limit).astype(np.float32)
        return to_network_layout(rows, self._spaces[key])


class _FeedForward:
    """Judges all steps of a segment at once."""

    def __init__(self, model: Any) -> None:
        self._model = model
        self._policy = model.policy

    def judge(self, inputs: Inputs) -> Judgement:
        """Return values and log-probabilities of a segment."""
        observations, actions = inputs.observations, inputs.actions
        n_envs, steps = actions.shape[:2]
        flat = {key: rows[:, :-1].reshape(n_envs * steps, *rows.shape[2:]) for key, rows in observations.items()}
        chosen = self._actions(actions.reshape(n_envs * steps, -1))
        values, log_probs = [], []
        for rows in _slices(n_envs * steps):
            value, log_prob, _ = self._policy.evaluate_actions(self._tensor(flat, rows), chosen[rows])
            values.append(value.flatten())
            log_probs.append(log_prob)
        shape = (n_envs, steps)
        return Judgement(
            torch.cat(values).cpu().numpy().reshape(shape),
            torch.cat(log_probs).cpu().numpy().reshape(shape),
            self._values({key: rows[:, -1] for key, rows in observations.items()}, n_envs),
            self._values(inputs.final, len(inputs.truncated)),
        )

    def _values(self, observations: Arrays, count: int) -> NDArray[np.float32]:
        parts = [self._policy.predict_values(self._tensor(observations, rows)).flatten() for rows in _slices(count)]
        result: NDArray[np.float32] = torch.cat(parts).cpu().numpy() if parts else np.zeros(0, np.float32)
        return result

    def _tensor(self, observations: Arrays, rows: Any) -> Any:
        parts = {key: torch.as_tensor(value[rows], device=self._model.device) for key, value in observations.items()}
        return join(parts)

    def _actions(self, actions: NDArray[Any]) -> torch.Tensor:
        chosen = torch.as_tensor(actions, device=self._model.device)
        return chosen.flatten() if isinstance(self._model.action_space, spaces.Discrete) else chosen.float()


class _Recurrent(_FeedForward):
    """Judges a segment step by step, as its LSTMs go on."""

    def judge(self, inputs: Inputs) -> Judgement:
        """Return values and log-probabilities of a segment, and the states that they came from."""
        observations, actions, truncated = inputs.observations, inputs.actions, inputs.truncated
        model, policy, states = self._model, self._policy, self._model._last_lstm_states
        n_envs, steps = actions.shape[:2]
        values, log_probs = np.zeros((2, n_envs, steps), np.float32)
        final_values = np.zeros(len(truncated), np.float32)
        before: list[list[NDArray[Any]]] = []
        for step in range(steps):
            before.append([part.cpu().numpy() for pair in (states.pi, states.vf) for part in pair])
            observed = self._tensor(observations, (slice(None), step))
            begins = torch.as_tensor(inputs.starts[:, step].astype(np.float32), device=model.device)
            value, log_prob, states = self._step(observed, self._actions(actions[:, step]), states, begins)
            values[:, step], log_probs[:, step] = value.cpu().numpy(), log_prob.cpu().numpy()
            for index in np.flatnonzero(truncated[:, 1] == step):
                env = int(truncated[index, 0])
                state = tuple(part[:, env : env + 1].contiguous() for part in states.vf)
                ended = self._tensor(inputs.final, slice(index, index + 1))
                final_values[index] = policy.predict_values(ended, state, torch.zeros(1, device=model.device)).item()
        model._last_lstm_states = states
        begins = torch.as_tensor(inputs.done[:, -1].astype(np.float32), device=model.device)
        last = policy.predict_values(self._tensor(observations, (slice(None), -1)), states.vf, begins)
        names = ("hidden_states_pi", "cell_states_pi", "hidden_states_vf", "cell_states_vf")
        stored = {name: np.stack(parts) for name, parts in zip(names, zip(*before, strict=True), strict=True)}
        return Judgement(values, log_probs, last.flatten().cpu().numpy(), final_values, stored)

    def _step(
        self, observed: Any, actions: torch.Tensor, states: RNNStates, begins: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor, RNNStates]:
        """Return values, log-probabilities of given actions and the next states; as sb3-contrib's `forward` does."""
        policy = self._policy
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


def _slices(count: int) -> Iterator[slice]:
    for low in range(0, count, _ROWS):
        yield slice(low, min(low + _ROWS, count))
