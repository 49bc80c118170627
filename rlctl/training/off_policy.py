"""SAC, TQC, CrossQ, XQC, TD3, DDPG and DQN on chunks of steps, with overlap and with hindsight experience replay.

With overlap workers play while the model learns. With hindsight the model also learns as if the state that an episode
reached had been its goal: M. Andrychowicz et al., Hindsight Experience Replay, 2017, https://arxiv.org/abs/1707.01495.
SB3's buffer does it; the current stage computes the rewards of exchanged goals, also for episodes of earlier stages.
"""

from typing import Any

import numpy as np
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.her import HerReplayBuffer

from rlctl.environments.dict_spaces import join, split_space
from rlctl.environments.info import EnvInfo
from rlctl.errors import RecipeError
from rlctl.policy.actor import Exploration
from rlctl.policy.file import DETERMINISTIC
from rlctl.recipe.hindsight import find_problem
from rlctl.recipe.recipe import Hindsight, Recipe, fill_parameters
from rlctl.training.averaging import ActorAverage
from rlctl.training.progress import Progress
from rlctl.training.rollouts import Rollouts, SegmentWatch, WorkerVecEnv, to_network_layout
from rlctl.training.snapshot import Tensors


class OffPolicyRollouts(Rollouts):
    """Plays `train_freq` steps, a chunk, into the replay buffer.

    With `overlap` workers play a chunk while the updates for the previous chunk are computed, so the acting policy is
    one chunk older than without. At the end the updates for the last chunk stay due: a longer run does them first.
    """

    def __init__(self, model: Any, env: WorkerVecEnv, recipe: Recipe, progress: Progress) -> None:
        super().__init__(model, env, recipe, progress)
        # Hindsight computes rewards in the environments while the model learns, so they cannot play then.
        self.overlap = recipe.overlap and recipe.her is None
        default = 0.1 if recipe.algo in DETERMINISTIC else 0.0  # deterministic actors need noise to explore
        self._action_noise = float(recipe.algo_kwargs.get("action_noise", default) or 0.0)
        self._average = ActorAverage(model, fill_parameters(recipe).get("actor_average", 0.0))

    def start(self) -> None:
        """Send the policy to the workers and let them play `train_freq` steps."""
        self.send_policy(self.acting_statistics())
        self.env.start(self.model.train_freq.frequency, self._exploration())

    def _exploration(self) -> Exploration:
        model = self.model
        plays = self.is_trained or (model.use_sde and model.use_sde_at_warmup)
        return Exploration(
            stochastic=True,
            warmup=model.num_timesteps < model.learning_starts and not plays,
            epsilon=float(getattr(model, "exploration_rate", 0.0)),
            action_noise=self._action_noise,
            sde_every=max(model.sde_sample_freq, 0) if model.use_sde else 0,
        )

    def finish(self, watch: SegmentWatch | None) -> None:
        """Store the chunk, not normalised, in the replay buffer, and do what SB3 does after each step."""
        segment = self.env.finish(watch)
        model, spaces = self.model, split_space(self.model.observation_space)
        observation = {key: to_network_layout(rows, spaces[key]) for key, rows in segment.observation.items()}
        final = {key: to_network_layout(rows, spaces[key]) for key, rows in segment.final.items()}
        done, timeouts = segment.done, segment.truncated & ~segment.terminated
        for step in range(done.shape[1]):
            now = {key: rows[:, step] for key, rows in observation.items()}
            after = {key: rows[:, step + 1] for key, rows in observation.items()}
            if (ended := done[:, step]).any():
                after = {key: rows.copy() for key, rows in after.items()}
                for key, rows in after.items():
                    rows[ended] = final[key][ended, step]
            infos = [{"TimeLimit.truncated": bool(timeout)} for timeout in timeouts[:, step]]
            reward = segment.reward[:, step].astype(np.float32)
            model.replay_buffer.add(join(now), join(after), segment.stored[:, step], reward, ended, infos)
            model.num_timesteps += len(reward)
            model._update_current_progress_remaining(model.num_timesteps, model._total_timesteps)
            model._on_step()
        self._progress.steps_to_learn += done.size
        model._episode_num += len(segment.ended)
        self.update_reward_statistics(segment)
        self.finish_segment(segment)

    def learn(self) -> None:
        """Do the updates due for the last chunk; with hindsight none before the first episode has ended."""
        model = self.model
        steps, self._progress.steps_to_learn = self._progress.steps_to_learn, 0
        if steps and model.num_timesteps > model.learning_starts and has_whole_episode(model.replay_buffer):
            updates = model.gradient_steps if model.gradient_steps >= 0 else steps
            if updates > 0:
                self._updater.train(batch_size=model.batch_size, gradient_steps=updates)
                self.rehearse(updates)
                self._average.follow(updates)

    def list_averages(self) -> Tensors:
        """As `Rollouts.list_averages`: of the actor."""
        return self._average.list_tensors()

    def take(self) -> tuple[Tensors, Any]:
        """As `Rollouts.take`."""
        return self._average.take(), None

    def restore(self, tensors: Tensors, plain: Any) -> None:
        """As `Rollouts.restore`."""
        self._average.restore(tensors)


_LEARNING_STARTS = 100  # SB3's own default, of every algorithm


def replay_arguments(recipe: Recipe, her: Hindsight, env: EnvInfo) -> dict[str, Any]:
    """Return SB3's arguments for the replay buffer; raises `RecipeError` for what hindsight excludes."""
    if problem := find_problem(recipe, env):
        raise RecipeError(problem)
    steps, size = (env.max_steps or 0) * recipe.n_envs, int(recipe.algo_kwargs["buffer_size"])
    if size < min(2 * steps, recipe.total_timesteps):
        raise RecipeError(_no_room(size, recipe.n_envs, f"{2 * steps} is enough"))
    return {
        "replay_buffer_class": HerReplayBuffer,
        "replay_buffer_kwargs": her.model_dump(),
        "learning_starts": max(_LEARNING_STARTS, steps),
    }


def _no_room(size: int, n_envs: int, advice: str) -> str:
    return (
        f"algo_kwargs.buffer_size: {size} steps of {n_envs} environments cannot hold the two complete episodes of "
        f"each environment that hindsight needs; {advice}"
    )


def has_whole_episode(buffer: ReplayBuffer) -> bool:
    """Return whether a hindsight buffer holds a complete episode; raises `RecipeError` if it is too small for one."""
    if not isinstance(buffer, HerReplayBuffer) or (buffer.ep_length > 0).any():
        return True
    if buffer.full:
        advice = f"set it to twice the steps of an episode, times {buffer.n_envs}"
        raise RecipeError(_no_room(buffer.buffer_size * buffer.n_envs, buffer.n_envs, advice))
    return False
