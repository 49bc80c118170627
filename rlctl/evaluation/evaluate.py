"""`rlctl eval`: play many episodes, each with its own seed, and return their statistics."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from rlctl import output
from rlctl.environments.info import EnvInfo
from rlctl.environments.spec import EnvSpec
from rlctl.errors import AnswerIsNo, UsageError
from rlctl.evaluation.episode_statistics import (
    Spread,
    mean_action_change,
    mean_interval,
    mean_metrics,
    mean_terms,
    success_interval,
    success_rate,
)
from rlctl.evaluation.players import Baseline, LoadedPolicy, choose_task, find_player, load_baseline
from rlctl.evaluation.request import EvalRequest
from rlctl.policy.file import PolicyInfo
from rlctl.policy.players.player import Exploration
from rlctl.policy.shipped import MeasuredScore
from rlctl.rollout.collect import Episode, play_episodes
from rlctl.rollout.seeds import Stream, episode_seeds
from rlctl.rollout.workers import Workers, available_cores
from rlctl.run.episode import save_episode


@dataclasses.dataclass(frozen=True)
class Evaluation:
    """The numbers of an evaluation."""

    name: str  # the policy's file, or the baseline
    policy: PolicyInfo | None  # None for a baseline
    spec: EnvSpec
    events: dict[str, bool]  # whether each event of the task was active
    seed: int
    deterministic: bool
    played: list[Episode]
    success_rate: float | None
    success_interval: tuple[float, float] | None
    returns: Spread
    lengths: Spread
    terms: dict[str, float]  # mean over episodes of each weighted term's sum
    metrics: dict[str, float]  # mean per step of each reward term of weight 0, as the task returned it
    final_distance: Spread | None
    max_steps: int | None
    limited_by: Path | None = None
    unlimited: Evaluation | None = None  # the same episodes without limits
    action_change: float | None = None
    """Mean of |action - previous action|, over elements and steps; None if it was not measured."""

    @property
    def episodes(self) -> list[dict[str, Any]]:
        """A flat row per episode, for a table: `pandas.DataFrame(evaluation.episodes)`."""
        return [_flatten(row) for row in self.rows()]

    def rows(self) -> list[dict[str, Any]]:
        """Return a row per episode, as the JSON of `rlctl eval` has it; terms and metrics are dicts."""
        return [
            {
                "index": index,
                "seed": result.seed,
                "success": result.success,
                "return": result.total_reward,
                "length": result.length,
                "final_distance": result.final_distance,
                "terms": result.terms,
                "metrics": result.metrics,
            }
            for index, result in enumerate(episode.result for episode in self.played)
        ]

    def __repr__(self) -> str:
        rate = "" if self.success_rate is None else f"success {self.success_rate:.1%}, "
        return f"Evaluation({self.spec.task}, {len(self.played)} episodes: {rate}return {self.returns.mean:.4g})"


def _flatten(row: dict[str, Any]) -> dict[str, Any]:
    nested = {f"{key}.{name}": value for key in ("terms", "metrics") for name, value in row.pop(key).items()}
    return row | nested


@dataclasses.dataclass(frozen=True)
class Gates:
    """The minimum scores that an evaluation must reach."""

    min_success: float | None = None
    min_success_lower: float | None = None
    min_return: float | None = None

    def __post_init__(self) -> None:
        for name in ("min_success", "min_success_lower"):
            rate = getattr(self, name)
            if rate is not None and not 0 <= rate <= 1:
                hint = f"; {rate:g} % is {rate / 100:g}" if 1 < rate <= 100 else ""
                raise UsageError(f"--{name.replace('_', '-')} {rate:g}: a rate is between 0 and 1{hint}")
        if self.min_return is not None and math.isnan(self.min_return):
            raise UsageError("--min-return nan: every return would pass; give a number")

    def check_possible(self, has_success: bool) -> None:
        """Raise `UsageError` for a gate on success where the environment does not report it."""
        if not has_success and (self.min_success is not None or self.min_success_lower is not None):
            raise UsageError("--min-success: this task reports no success (no is_success); use --min-return")

    def check(self, result: Evaluation) -> None:
        """Raise `AnswerIsNo`, naming every gate that was missed."""
        if missed := self.list_missed(result.success_rate, result.success_interval, result.returns.mean):
            raise AnswerIsNo("gate missed: " + "; ".join(missed))

    def list_missed(self, rate: float | None, interval: tuple[float, float] | None, mean_return: float) -> list[str]:
        """Return a phrase for each gate that these scores miss."""
        missed = []
        if self.min_success is not None and rate is not None and rate < self.min_success:
            missed.append(f"success rate {rate:.3f} is below {self.min_success:g}")
        if self.min_success_lower is not None and interval is not None and interval[0] < self.min_success_lower:
            missed.append(f"lower bound {interval[0]:.3f} of the success rate is below {self.min_success_lower:g}")
        if self.min_return is not None and mean_return < self.min_return:
            missed.append(f"mean return {mean_return:.3f} is below {self.min_return:g}")
        return missed


NO_GATES = Gates()


def run_evaluation(
    request: EvalRequest,
    gates: Gates = NO_GATES,
    *,
    print_notes: Callable[[Sequence[str]], None] = output.print_notes,
) -> Evaluation:
    """Find the policy, play its episodes, and return their statistics; `print_notes` as in `find_player`."""
    if request.baseline is not None:
        return _evaluate(load_baseline(request), choose_task(request), request, gates)
    _, policy, spec = find_player(request, print_notes)
    return _evaluate(policy, spec, request, gates)


def start_workers(spec: EnvSpec, request: EvalRequest) -> Workers:
    """Start the workers of a request: by default an environment per core, but no more than episodes."""
    n_envs = min(request.n_envs or available_cores(), request.episodes)
    return Workers(spec, n_envs, timeout_s=request.env_timeout_s)


def _evaluate(actor: LoadedPolicy | Baseline, spec: EnvSpec, request: EvalRequest, gates: Gates) -> Evaluation:
    if request.record is not None:
        _check_new(request.record)
    with start_workers(spec, request) as workers:
        limits = None if request.limits is None else _read_limits(request.limits, workers.info)
        actor.give_to(workers)
        if workers.info.reward_weights:
            gates.check_possible(workers.info.has_success)
        episodes, info = _play(workers, request), workers.info
        if request.record is not None:
            for number, episode in enumerate(episodes):
                save_episode(request.record / f"{number:06d}.npz", episode.describe(spec, info, actor.name))
        evaluation = _summarize(actor, spec, info, request, episodes)
        if limits is not None:
            workers.limit_actions(limits)
            limited = _summarize(actor, spec, info, request, _play(workers, request))
            evaluation = dataclasses.replace(limited, limited_by=request.limits, unlimited=evaluation)
    gates.check_possible(evaluation.success_rate is not None)
    return evaluation


def _check_new(folder: Path) -> None:
    if folder.exists() and not (folder.is_dir() and not any(folder.iterdir())):
        raise UsageError(f"--record {folder}: exists already; give a new folder, or remove this one")


def _read_limits(file: Path, info: EnvInfo) -> dict[str, Any]:
    """Return limits as plain data; raises `RecipeError` if they do not fit the environment's actions."""
    from rlctl.deploy.filter.fitting import fit_limits
    from rlctl.deploy.filter.limits import read_limits

    limits = read_limits(file)
    fit_limits(limits, info)
    return limits.model_dump(mode="json", exclude_unset=True)


def _play(workers: Workers, request: EvalRequest) -> list[Episode]:
    seeds = episode_seeds(request.seed, Stream.EVAL, request.episodes)
    exploration = Exploration(stochastic=not request.deterministic)
    with output.show_progress("evaluating", len(seeds)) as show:
        return play_episodes(
            workers, seeds, exploration, record=request.measure_actions or request.record is not None, watch=show
        )


def _summarize(
    actor: LoadedPolicy | Baseline, spec: EnvSpec, info: EnvInfo, request: EvalRequest, episodes: list[Episode]
) -> Evaluation:
    results = [episode.result for episode in episodes]
    distances = [result.final_distance for result in results if result.final_distance is not None]
    return Evaluation(
        name=actor.name,
        policy=actor.info,
        spec=spec,
        events=info.events,
        seed=request.seed,
        deterministic=request.deterministic,
        played=[dataclasses.replace(episode, trajectory=None) for episode in episodes],
        success_rate=success_rate(results),
        success_interval=success_interval(results),
        returns=Spread.of([result.total_reward for result in results]),
        lengths=Spread.of([result.length for result in results]),
        terms=mean_terms(results),
        metrics=mean_metrics(results),
        final_distance=Spread.of(distances) if distances else None,
        max_steps=info.max_steps,
        action_change=mean_action_change(episodes) if request.measure_actions else None,
    )


def measure_score(
    request: EvalRequest, print_notes: Callable[[Sequence[str]], None] = output.print_notes
) -> MeasuredScore:
    """Return the score of a request's policy as a shipped policy carries it, with the mean change of actions."""
    evaluation = run_evaluation(dataclasses.replace(request, measure_actions=True), print_notes=print_notes)
    results = [episode.result for episode in evaluation.played]
    limit = evaluation.max_steps
    return MeasuredScore(
        episodes=len(results),
        seed=evaluation.seed,
        mean_return=evaluation.returns.mean,
        return_interval=mean_interval([result.total_reward for result in results]),
        success=evaluation.success_rate,
        success_interval=evaluation.success_interval,
        mean_length=evaluation.lengths.mean,
        ended_early=None if limit is None else sum(result.length < limit for result in results) / len(results),
        action_change=evaluation.action_change or 0.0,
    )
