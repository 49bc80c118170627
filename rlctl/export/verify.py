"""Is the exported file the policy? Compared on real rollouts, observation by observation and in closed loop."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlctl.dict_spaces import Observations, take_row
from rlctl.export.agreement import Agreement, Comparison
from rlctl.rollout.collect import Episode, run_episodes
from rlctl.rollout.seeds import Stream, episode_seeds
from rlctl.rollout.workers import Workers
from rlctl.run.onnx_policy import OnnxPolicy
from rlctl.run.policy import BatchActor
from rlctl.run.torch_policy import TorchPolicy

MAX_RETURN_DIFFERENCE = 1e-3
"""Largest difference of an episode's return, relative."""
MIN_OBSERVATIONS = 1000
EPISODES = 20
"""Episodes run in closed loop by each of the two policies."""
N_ENVS = 10


@dataclasses.dataclass(frozen=True)
class ClosedLoop:
    """The same episodes, run once by each policy."""

    episodes: int
    same_success: int
    same_length: int
    max_return_difference: float
    """Relative to the larger of the episode's own return and the mean size of a return."""
    mean_return: float
    mean_return_onnx: float

    @property
    def agrees(self) -> bool:
        """Whether every episode had the same success and length, and a return within the limit."""
        same = self.same_success == self.same_length == self.episodes
        return same and self.max_return_difference <= MAX_RETURN_DIFFERENCE


@dataclasses.dataclass(frozen=True)
class Verification:
    """What was seen when two policies were compared."""

    agreement: Agreement
    closed_loop: ClosedLoop

    @property
    def passed(self) -> bool:
        """Whether actions and episodes agree."""
        return self.agreement.agrees and self.closed_loop.agrees


def verify(torch_policy: TorchPolicy, onnx_policy: OnnxPolicy, workers: Workers) -> Verification:
    """Run the same episodes with both policies; on every observation of either, ask both.

    Rollouts go on until `MIN_OBSERVATIONS` were seen. Raises `TaskError` if the environment fails.
    """
    comparison = Comparison(torch_policy)

    def run(seeds: Sequence[int], *, torch_drives: bool) -> list[Episode]:
        actor = _SideBySide(torch_policy, onnx_policy, workers.n_envs, comparison, torch_drives=torch_drives)
        return run_episodes(workers, actor, seeds)

    seeds = episode_seeds(0, Stream.VERIFY, EPISODES)
    expected = run(seeds, torch_drives=True)
    done = run(seeds, torch_drives=False)
    done_so_far = EPISODES
    while comparison.observations < MIN_OBSERVATIONS:
        missing = MIN_OBSERVATIONS / comparison.observations - 1.0
        wanted = done_so_far + max(1, round(1.1 * missing * done_so_far))
        run(episode_seeds(0, Stream.VERIFY, wanted)[done_so_far:], torch_drives=True)
        done_so_far = wanted
    return Verification(comparison.result(), compare_episodes(expected, done))


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
        mean_return_onnx=float(returns[:, 1].mean()),
    )


class _SideBySide:
    """Acts with one policy and asks the other too; each keeps its own recurrent state.

    The ONNX policy runs in full batches, and for the first environment alone as well.
    """

    def __init__(
        self,
        torch_policy: TorchPolicy,
        onnx_policy: OnnxPolicy,
        n_envs: int,
        comparison: Comparison,
        *,
        torch_drives: bool,
    ) -> None:
        self._torch = BatchActor(torch_policy, n_envs)
        self._onnx = BatchActor(onnx_policy, n_envs)
        self._alone = onnx_policy
        self._comparison = comparison
        self._torch_drives = torch_drives

    def act(self, observations: Observations, rows: NDArray[np.int64], starts: NDArray[np.bool_]) -> NDArray[Any]:
        expected = self._torch.act(observations, rows, starts)
        actions = self._onnx.act(observations, rows, starts)
        self._comparison.add(expected, actions)
        if rows[0] == 0:
            if starts[0]:
                self._alone.reset()
            self._comparison.add(expected[:1], self._alone.predict(take_row(observations, 0))[None])
        if not self._torch_drives:
            return actions
        self._comparison.observations += len(rows)
        return expected
