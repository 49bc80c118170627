"""The learner: model, environments, curriculum and progress of a training."""

import dataclasses
import statistics
import time
import warnings
from collections.abc import Sequence
from typing import Any

import numpy as np
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.her import HerReplayBuffer

from rlctl.environments.info import EnvInfo
from rlctl.environments.spec import EnvSpec
from rlctl.errors import RecipeError, RlctlError
from rlctl.output import format_count
from rlctl.play.messages import EpisodeResult, LevelRule
from rlctl.play.workers import Workers
from rlctl.policy.file import PolicyFile
from rlctl.recipe.recipe import Recipe
from rlctl.recipe.stages import FollowingLevel, Promotion, Stage, format_title
from rlctl.training.display import percent
from rlctl.training.progress import Progress
from rlctl.training.rollouts import Rollouts
from rlctl.training.snapshot import pack


def make_goal_spec(stages: Sequence[EnvSpec]) -> EnvSpec:
    """Return the spec in which evaluations are played and which policies store: the last stage, at level 1.

    A lower level is for training: it may make some episodes easier, and a score of these would say nothing.
    """
    return dataclasses.replace(stages[-1], level=1.0)


class Curriculum:
    """The stages of a training, with their state in `progress`; without any, no stage is ever due."""

    def __init__(self, stages: Sequence[Stage], specs: Sequence[EnvSpec], goal: EnvInfo, progress: Progress) -> None:
        self.stages = stages
        self.specs = list(specs) if stages else []  # of each stage
        self.goal_spec = make_goal_spec(specs)
        self.goal = goal  # description of the environments of `goal_spec`
        self._progress = progress
        if stages and not progress.stage:
            progress.stage = 1

    @property
    def _rule(self) -> Promotion | None:
        """Promotion rule of the current stage; None for the last."""
        return self.stages[self._progress.stage - 1].promote if self.stages else None

    @property
    def level_rule(self) -> LevelRule | None:
        """How the levels of the environments follow success in the current stage; None where they do not."""
        level = self.stages[self._progress.stage - 1].level if self.stages else 1.0
        return LevelRule(**level.model_dump()) if isinstance(level, FollowingLevel) else None

    @property
    def has_levels(self) -> bool:
        """Whether levels follow success in any stage."""
        return any(isinstance(stage.level, FollowingLevel) for stage in self.stages)

    @property
    def title(self) -> str:
        """The current stage as text: `stage 2 of 3: tolerance 0.1`."""
        return format_title(self._progress.stage, self.stages)

    def columns(self) -> dict[str, int]:
        """Return the table column `stage`; empty without stages."""
        return {"stage": self._progress.stage} if self.stages else {}

    def count(self, ended: Sequence[EpisodeResult]) -> None:
        """Count finished training episodes of the current stage, in the order in which they ended."""
        rule = self._rule
        if rule is None:
            return
        if rule.success is not None:
            values = [None if episode.success is None else float(episode.success) for episode in ended]
        else:
            values = [episode.total_reward for episode in ended]
        self._progress.stage_episodes = [*self._progress.stage_episodes, *values][-rule.window :]

    def measured(self) -> float | None:
        """Return the success rate or mean return that the rule compares; None until its window is full."""
        rule = self._rule
        values = self._progress.stage_episodes
        if rule is None or len(values) < rule.window:
            return None
        # Some environments report success only when there is one.
        return statistics.fmean(0.0 if value is None else value for value in values)

    def is_due(self, steps: int) -> bool:
        """Return whether the current stage is done after `steps` environment steps."""
        rule, measured = self._rule, self.measured()
        if rule is None or measured is None:
            return False
        return steps - self._progress.stage_began >= rule.min_steps and measured >= rule.threshold

    def enter_next_stage(self, steps: int) -> tuple[str, str]:
        """Enter the next stage; return its title and the reason."""
        rule, measured = self._rule, self.measured()
        assert rule is not None  # else `is_due` is False
        assert measured is not None
        reason = f"success {percent(measured)}" if rule.success is not None else f"return {measured:.2f}"
        progress = self._progress
        progress.stage, progress.stage_began, progress.stage_episodes = progress.stage + 1, steps, []
        return self.title, f"after {steps:,} steps: {reason} over {format_count(rule.window, 'episode')}"


class Learner:
    """The model, its environments, the curriculum, and the progress, which checkpoints store."""

    def __init__(self, recipe: Recipe, rollouts: Rollouts, curriculum: Curriculum, progress: Progress) -> None:
        self.recipe = recipe
        self.rollouts = rollouts
        self.curriculum = curriculum
        self.progress = progress
        self.model: Any = rollouts.model
        self.env = rollouts.env
        self._started_s = time.monotonic()

    @property
    def steps(self) -> int:
        """Environment steps so far."""
        return int(self.model.num_timesteps)

    @property
    def is_at_end(self) -> bool:
        """Whether the recipe's steps are done, or a callback has ended the training."""
        return self.steps >= self.recipe.total_timesteps or bool(self.progress.stop_reason)

    @property
    def seconds(self) -> float:
        """Seconds of training so far, including those before a resume."""
        return time.monotonic() - self._started_s

    def start_clock(self) -> None:
        """Count the seconds of training from now on."""
        self._started_s = time.monotonic() - self.progress.seconds

    def pack(self) -> PolicyFile:
        """Return the current policy, with the last stage of the curriculum as its environment."""
        policy = pack(self.model, self.recipe.algo, self.curriculum.goal_spec, self.curriculum.goal)
        tensors = {**policy.tensors, **self.rollouts.list_averages()}
        return dataclasses.replace(policy, tensors=tensors).with_info(stages=self.curriculum.specs)

    def begin_next_stage(self) -> tuple[str, str]:
        """Cut the running episodes short and begin the next stage; return its title and the reason."""
        self.env.workers.rebuild(self.curriculum.specs[self.progress.stage])
        begun = self.curriculum.enter_next_stage(self.steps)
        self.env.follow_success(self.curriculum.level_rule)
        begin_next_episodes(self.model)
        return begun


def check_stages(specs: Sequence[EnvSpec], workers: Workers) -> EnvInfo:
    """Build an environment of every stage; raise an error if it differs from that of the first; return the last."""
    first, seen = workers.info, workers.privileged_sizes
    info = first
    for number, spec in enumerate(specs[1:], start=2):
        where = f"stage {number} of {len(specs)}"
        try:
            info = workers.rebuild(spec)
        except RlctlError as error:
            raise type(error)(f"{where}: {error}", details=error.details) from None
        if difference := info.find_difference(first, "stage 1's"):
            raise RecipeError(f"{where}: {difference}. One policy learns in all stages: leave out what changes it")
        if workers.privileged_sizes != seen:
            names = ", ".join(name for name, _ in set(workers.privileged_sizes.items()) ^ set(seen.items()))
            raise RecipeError(
                f"{where}: its critic does not see the same as stage 1's: {names}. Let the same events act in all "
                "stages, or add --set privileged.events=false"
            )
        if list(info.reward_weights) != list(first.reward_weights):
            raise RecipeError(
                f"{where}: its reward terms are {', '.join(info.reward_weights)}, "
                f"stage 1's are {', '.join(first.reward_weights)}; all stages need the same"
            )
    return info


def begin_next_episodes(model: BaseAlgorithm) -> None:
    """Cut the running episodes short and start new ones, as SB3 does at the start of a training."""
    env: Any = model.env
    if isinstance(model, OffPolicyAlgorithm) and model.replay_buffer is not None:
        _cut_episodes_short(model.replay_buffer)
    model._last_obs = env.reset()
    model._last_episode_starts = np.ones(env.num_envs, np.bool_)


def _cut_episodes_short(buffer: ReplayBuffer) -> None:
    """Mark the running episodes as truncated: no return and no hindsight goal extends into the next stage."""
    if isinstance(buffer, HerReplayBuffer):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # SB3 warns that this truncates episodes
            buffer.truncate_last_trajectory()
    else:
        buffer.timeouts[buffer.pos - 1, buffer.dones[buffer.pos - 1] == 0.0] = 1.0
