"""The present stage of a curriculum, and when the next one begins."""

from __future__ import annotations

import statistics
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
from rlctl.recipe.stages import Promotion, Stage, format_title
from rlctl.rollout.messages import EpisodeResult
from rlctl.rollout.workers import Workers
from rlctl.training.display import percent
from rlctl.training.progress import Progress


class Curriculum:
    """The stages of a training; without any, no stage is ever due.

    Its state is in `progress`, which checkpoints keep.
    """

    def __init__(self, stages: Sequence[Stage], specs: Sequence[EnvSpec], goal: EnvInfo, progress: Progress) -> None:
        self.stages = stages
        self.goal_spec = specs[-1]
        """The last stage: evaluations are played in it, policies are for it."""
        self.goal = goal
        """What the environments of `goal_spec` are."""
        self._specs = specs
        self._progress = progress
        if stages and not progress.stage:
            progress.stage = 1

    @property
    def number(self) -> int:
        """The present stage, from 1; 0 without stages."""
        return self._progress.stage

    @property
    def _rule(self) -> Promotion | None:
        """When the present stage is over; None for the last."""
        return self.stages[self.number - 1].promote if self.stages else None

    @property
    def title(self) -> str:
        """The present stage for people: `stage 2 of 3: tolerance 0.1`."""
        return format_title(self.number, self.stages)

    def columns(self) -> dict[str, int]:
        """Return the columns of the stage for tables: nothing without stages."""
        return {"stage": self.number} if self.stages else {}

    def specs(self) -> list[EnvSpec]:
        """Return what the environments of each stage are made from; nothing without stages."""
        return list(self._specs) if self.stages else []

    def count(self, ended: Sequence[EpisodeResult]) -> None:
        """Take note of training episodes of the present stage, in the order in which they ended."""
        rule = self._rule
        if rule is None:
            return
        if rule.success is not None:
            values = [None if episode.success is None else float(episode.success) for episode in ended]
        else:
            values = [episode.total_reward for episode in ended]
        self._progress.stage_episodes = [*self._progress.stage_episodes, *values][-rule.window :]

    def measured(self) -> float | None:
        """Return the success rate or mean return that the rule looks at; None while its window is not full."""
        rule = self._rule
        values = self._progress.stage_episodes
        if rule is None or len(values) < rule.window:
            return None
        # An environment may speak of success only when there is one.
        return statistics.fmean(0.0 if value is None else value for value in values)

    def is_due(self, steps: int) -> bool:
        """Say whether the present stage is done, after `steps` environment steps of training."""
        measured = self.measured()
        rule = self._rule
        if rule is None or measured is None:
            return False
        return steps - self._progress.stage_began >= rule.min_steps and measured >= rule.threshold

    def next_spec(self) -> EnvSpec:
        """Return what the environments of the next stage are made from."""
        return self._specs[self.number]

    def enter_next_stage(self, steps: int) -> tuple[str, str]:
        """Enter the next stage; return its title and why it begins."""
        rule, measured = self._rule, self.measured()
        assert rule is not None  # else nothing would be due
        assert measured is not None
        reason = f"success {percent(measured)}" if rule.success is not None else f"return {measured:.2f}"
        progress = self._progress
        progress.stage, progress.stage_began, progress.stage_episodes = progress.stage + 1, steps, []
        return self.title, f"after {steps:,} steps: {reason} over {format_count(rule.window, 'episode')}"


def check_stages(specs: Sequence[EnvSpec], workers: Workers) -> EnvInfo:
    """Build an environment of every stage, one after the other; return what those of the last are.

    `workers` have the first. Raises `RecipeError` or `TaskError`, which name the stage, for one that cannot be
    built, and `RecipeError` for one with other spaces or reward terms than the first.
    """
    first = info = None
    for number, spec in enumerate(specs, start=1):
        where = f"stage {number} of {len(specs)}"
        try:
            info = workers.info if number == 1 else workers.rebuild(spec)
        except RlctlError as error:
            raise type(error)(f"{where}: {error}", details=error.details) from None
        first = first or info
        if difference := info.find_difference(first, "stage 1's"):
            raise RecipeError(
                f"{where}: {difference}. One policy learns in all stages: leave out the task parameter that changes it"
            )
        if list(info.reward_weights) != list(first.reward_weights):
            raise RecipeError(
                f"{where}: its reward terms are {', '.join(info.reward_weights)}, "
                f"stage 1's are {', '.join(first.reward_weights)}; all stages need the same"
            )
    assert info is not None  # there is a first
    return info


def begin_next_episodes(model: BaseAlgorithm) -> None:
    """Leave the running episodes and begin the next ones, as SB3 does at the start of a training."""
    env: Any = model.env
    if isinstance(model, OffPolicyAlgorithm) and model.replay_buffer is not None:
        _cut_episodes(model.replay_buffer)
    model._last_obs = env.reset()
    model._last_episode_starts = np.ones(env.num_envs, np.bool_)


def _cut_episodes(buffer: ReplayBuffer) -> None:
    """Mark the running episodes as cut short but not over: no return, and no goal, reaches into the next stage."""
    if isinstance(buffer, HerReplayBuffer):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # SB3 warns of the very thing
            buffer.truncate_last_trajectory()
        return
    last = buffer.pos - 1
    running = buffer.dones[last] == 0.0  # the others have ended by themselves
    buffer.timeouts[last, running] = 1.0
