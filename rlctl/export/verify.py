"""Is the exported file the policy? Compared on real rollouts, observation by observation and in closed loop."""

from __future__ import annotations

import dataclasses
import operator
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlctl.dict_spaces import map_parts, stack, take_row
from rlctl.export.agreement import Agreement, Comparison
from rlctl.rollout.collect import Episode, play_episodes
from rlctl.rollout.seeds import Stream, episode_seeds
from rlctl.rollout.workers import Workers
from rlctl.run.onnx_policy import OnnxPolicy
from rlctl.run.policy import Policy
from rlctl.run.torch_policy import TorchPolicy

MAX_RETURN_DIFFERENCE = 1e-3
"""Largest difference of an episode's return, relative."""
MIN_OBSERVATIONS = 1000
EPISODES = 20
"""Episodes played in closed loop by each of the two policies."""


@dataclasses.dataclass(frozen=True)
class ClosedLoop:
    """The same episodes, played once with each policy."""

    episodes: int
    same_success: int
    same_length: int
    max_return_difference: float
    """Relative to the larger of the episode's own return and the mean size of a return."""
    mean_return: float
    mean_return_exported: float

    @property
    def agrees(self) -> bool:
        """Whether every episode had the same success and length, and a return within the limit."""
        same = self.same_success == self.same_length == self.episodes
        return same and self.max_return_difference <= MAX_RETURN_DIFFERENCE


@dataclasses.dataclass(frozen=True)
class Verification:
    """The result of comparing two policies."""

    agreement: Agreement
    closed_loop: ClosedLoop

    @property
    def passed(self) -> bool:
        return self.agreement.agrees and self.closed_loop.agrees


def verify(
    torch_policy: TorchPolicy,
    exported: Policy,
    files: PolicyFiles,
    workers: Workers,
    min_observations: int = MIN_OBSERVATIONS,
) -> Verification:
    """Play the same episodes with both files; on every observation of either, ask torch and the exported policy.

    Rollouts go on until `min_observations` were compared. Raises `TaskError` if the environment fails.
    """
    comparison = Comparison(torch_policy)
    seeds = episode_seeds(0, Stream.VERIFY, EPISODES)
    workers.set_policy(torch_policy.info, files.tensors)
    expected = play_episodes(workers, seeds, record=True)
    _compare_actions(torch_policy, exported, expected, comparison)
    if isinstance(exported, OnnxPolicy):
        _compare_batch(torch_policy, exported, expected, comparison)
    played = EPISODES
    while comparison.observations < min_observations:
        missing = min_observations / comparison.observations - 1.0
        total = played + max(1, round(1.1 * missing * played))
        more = play_episodes(workers, episode_seeds(0, Stream.VERIFY, total)[played:], record=True)
        _compare_actions(torch_policy, exported, more, comparison)
        played = total
    workers.set_other_policy(str(files.exported.resolve()))
    done = play_episodes(workers, seeds, record=True)
    compared = comparison.observations
    _compare_actions(torch_policy, exported, done, comparison)
    comparison.observations = compared  # those of one policy's rollouts are counted
    return Verification(comparison.result(), compare_episodes(expected, done))


@dataclasses.dataclass(frozen=True)
class PolicyFiles:
    """What the workers play: a policy file's tensors, and the exported file."""

    tensors: dict[str, NDArray[Any]]
    exported: Path
    """An ONNX file, or a compiled library."""


def _compare_actions(
    torch_policy: TorchPolicy, exported: Policy, episodes: Sequence[Episode], comparison: Comparison
) -> None:
    """Ask both policies on all observations of some episodes."""
    for episode in episodes:
        assert episode.trajectory is not None  # recorded
        observations, length = episode.trajectory.observations, len(episode.trajectory.actions)
        torch_policy.reset()
        exported.reset()
        rows = 1 if torch_policy.is_recurrent else length
        for low in range(0, length, rows):
            some = map_parts(operator.itemgetter(slice(low, low + rows)), observations)
            actions = [exported.predict(take_row(some, row)) for row in range(rows)]
            comparison.add(torch_policy.act(some), np.stack(actions))
        comparison.observations += length


def _compare_batch(
    torch_policy: TorchPolicy, exported: OnnxPolicy, episodes: Sequence[Episode], comparison: Comparison
) -> None:
    """Ask both policies on the first observations of some episodes, all at once."""
    first = stack([take_row(each.trajectory.observations, 0) for each in episodes if each.trajectory is not None])
    torch_policy.reset()
    comparison.add(torch_policy.act(first), exported.start_episodes(first))
    comparison.batch_sizes.add(len(episodes))


def compare_episodes(expected: Sequence[Episode], done: Sequence[Episode]) -> ClosedLoop:
    """Compare episodes of the same seeds."""
    pairs = [(ours.result, theirs.result) for ours, theirs in zip(expected, done, strict=True)]
    returns = np.array([[ours.total_reward, theirs.total_reward] for ours, theirs in pairs])
    # A return that happens to cancel out to nearly nothing is no measure of its own difference.
    scale = np.maximum(np.abs(returns).max(axis=1), np.abs(returns).mean())
    difference = np.abs(returns[:, 0] - returns[:, 1])
    relative = np.divide(difference, scale, out=np.zeros_like(difference), where=scale > 0)
    return ClosedLoop(
        episodes=len(pairs),
        same_success=sum(ours.success == theirs.success for ours, theirs in pairs),
        same_length=sum(ours.length == theirs.length for ours, theirs in pairs),
        max_return_difference=float(relative.max()),
        mean_return=float(returns[:, 0].mean()),
        mean_return_exported=float(returns[:, 1].mean()),
    )
