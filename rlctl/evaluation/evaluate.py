"""`rlctl eval`: many episodes, each with its own seed, and honest numbers from them."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path
from typing import Any

from rlctl import output
from rlctl.environments.info import EnvInfo
from rlctl.environments.spec import EnvSpec
from rlctl.errors import AnswerIsNo, UsageError
from rlctl.evaluation.baseline import Baseline, choose_task, load_baseline
from rlctl.evaluation.episode_statistics import (
    Spread,
    mean_action_change,
    mean_metrics,
    mean_terms,
    success_interval,
    success_rate,
)
from rlctl.evaluation.request import EvalRequest
from rlctl.policy.file import PolicyFile, PolicyInfo
from rlctl.policy.numpy_policy import check_playable, load_policy
from rlctl.policy.players.player import Exploration
from rlctl.rollout.collect import Episode, play_episodes
from rlctl.rollout.messages import EpisodeResult
from rlctl.rollout.seeds import Stream, episode_seeds
from rlctl.rollout.workers import Workers, available_cores
from rlctl.run import lookup


@dataclasses.dataclass(frozen=True)
class Evaluation:
    """The numbers of an evaluation."""

    name: str
    """The policy's file, or the baseline."""
    policy: PolicyInfo | None
    """None of a baseline."""
    spec: EnvSpec
    events: dict[str, bool]
    """The events that the task offers, and whether each acted."""
    seed: int
    deterministic: bool
    played: list[Episode]
    success_rate: float | None
    success_interval: tuple[float, float] | None
    returns: Spread
    lengths: Spread
    terms: dict[str, float]
    """Mean over episodes of each weighted term's sum."""
    metrics: dict[str, float]
    """Mean per step of each reward term of weight 0, as the task returned it."""
    final_distance: Spread | None
    max_steps: int | None
    limited_by: Path | None = None
    unlimited: Evaluation | None = None
    """The same episodes without limits."""
    action_change: float | None = None
    """Mean of |action - action before|, over elements and steps; None if it was not measured."""

    @property
    def episodes(self) -> list[dict[str, Any]]:
        """A flat row per episode, for a table: `pandas.DataFrame(evaluation.episodes)`."""
        return [_make_row(index, episode.result) for index, episode in enumerate(self.played)]

    def __repr__(self) -> str:
        rate = "" if self.success_rate is None else f"success {self.success_rate:.1%}, "
        return f"Evaluation({self.spec.task}, {len(self.played)} episodes: {rate}return {self.returns.mean:.4g})"


def _make_row(index: int, result: EpisodeResult) -> dict[str, Any]:
    return {
        "index": index,
        "seed": result.seed,
        "success": result.success,
        "return": result.total_reward,
        "length": result.length,
        "final_distance": result.final_distance,
        **{f"terms.{name}": value for name, value in result.terms.items()},
        **{f"metrics.{name}": value for name, value in result.metrics.items()},
    }


@dataclasses.dataclass(frozen=True)
class Gates:
    """What an evaluation must reach."""

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
        """Return what is missed by a success rate, its interval and a mean return, a phrase for each gate."""
        missed = []
        if self.min_success is not None and rate is not None and rate < self.min_success:
            missed.append(f"success rate {rate:.3f} is below {self.min_success:g}")
        if self.min_success_lower is not None and interval is not None and interval[0] < self.min_success_lower:
            missed.append(f"lower bound {interval[0]:.3f} of the success rate is below {self.min_success_lower:g}")
        if self.min_return is not None and mean_return < self.min_return:
            missed.append(f"mean return {mean_return:.3f} is below {self.min_return:g}")
        return missed


NO_GATES = Gates()


def run_evaluation(request: EvalRequest, gates: Gates = NO_GATES) -> Evaluation:
    """Find the policy, play its episodes, and return their statistics."""
    if request.baseline is not None:
        return _evaluate(load_baseline(request), choose_task(request), request, gates)
    _, policy, spec = find_player(request)
    return _evaluate(policy, spec, request, gates)


def find_player(request: EvalRequest) -> tuple[lookup.FoundPolicy, LoadedPolicy, EnvSpec]:
    """Find and read the policy of a request, and what it is to be evaluated on."""
    found = lookup.find_policy(request.run, request.checkpoint)
    output.print_notes(found.notes)
    policy = load_player(found.file, request.deterministic)
    return found, policy, found.locate(choose_spec(policy.info, request))


@dataclasses.dataclass(frozen=True)
class LoadedPolicy:
    """A policy that workers can play."""

    path: Path
    info: PolicyInfo
    policy: PolicyFile | None
    """None for an exported file, which the workers load themselves."""

    @property
    def name(self) -> str:
        """The file, as it is shown."""
        return str(self.path)

    def give_to(self, workers: Workers) -> None:
        """Let workers act with it; raises `ArtifactError` if it is for other spaces than their environments have."""
        self.info.check_fits(workers.info, self.path)
        if self.policy is None:
            workers.set_other_policy(str(self.path.resolve()))
        else:
            workers.set_policy(self.policy)


def load_player(path: Path, deterministic: bool) -> LoadedPolicy:
    """Read and try a policy; raises `ArtifactError` for a damaged one."""
    if path.suffix == ".onnx":
        info = load_policy(path).info
        if not deterministic:
            raise UsageError("an exported policy cannot sample: only its deterministic action is in the ONNX file")
        return LoadedPolicy(path, info, None)
    policy = check_playable(PolicyFile.read(path))
    return LoadedPolicy(path, policy.info, policy)


def choose_spec(info: PolicyInfo, request: EvalRequest) -> EnvSpec:
    """Return what to evaluate on: the policy's task or another, with changes, or the stage that was asked for."""
    if request.spec is not None:  # the policy brings only how it observes
        own = info.spec
        return dataclasses.replace(request.spec, frame_stack=own.frame_stack, time_feature=own.time_feature)
    if (stage := request.stage) is None:
        return info.derive_spec(request.task, request.changes)
    if request.task is not None and request.task != info.spec.task:
        raise UsageError(
            f"--stage: stages are those of {info.spec.task}, which the policy was trained on; leave out --task"
        )
    if not info.stages:
        raise UsageError(f"--stage {stage}: this policy was trained without stages; leave out --stage")
    if not 1 <= stage <= len(info.stages):
        count = len(info.stages)
        raise UsageError(f"--stage {stage}: this policy was trained in {count} stages; give a number from 1 to {count}")
    return request.changes.apply(info.stages[stage - 1])


def start_workers(spec: EnvSpec, request: EvalRequest) -> Workers:
    """Start workers for the episodes of a request: as many as there are cores, but no more than episodes."""
    n_envs = min(request.n_envs or available_cores(), request.episodes)
    return Workers(spec, n_envs, timeout_s=request.env_timeout_s)


def _evaluate(actor: LoadedPolicy | Baseline, spec: EnvSpec, request: EvalRequest, gates: Gates) -> Evaluation:
    with start_workers(spec, request) as workers:
        limits = None if request.limits is None else _read_limits(request.limits, workers.info)
        actor.give_to(workers)
        if workers.info.reward_weights:
            gates.check_possible(workers.info.has_success)
        episodes, info = _play(workers, request), workers.info
        evaluation = _summarize(actor, spec, info, request, episodes)
        if limits is not None:
            workers.limit_actions(limits)
            limited = _summarize(actor, spec, info, request, _play(workers, request))
            evaluation = dataclasses.replace(limited, limited_by=request.limits, unlimited=evaluation)
    gates.check_possible(evaluation.success_rate is not None)
    return evaluation


def _read_limits(file: Path, info: EnvInfo) -> dict[str, Any]:
    """Return limits as plain data; raises `RecipeError` for those that an environment's actions cannot have."""
    from rlctl.deploy.filter.fitting import fit_limits
    from rlctl.deploy.filter.limits import read_limits

    limits = read_limits(file)
    fit_limits(limits, info)
    return limits.model_dump(mode="json", exclude_unset=True)


def _play(workers: Workers, request: EvalRequest) -> list[Episode]:
    seeds = episode_seeds(request.seed, Stream.EVAL, request.episodes)
    exploration = Exploration(stochastic=not request.deterministic)
    with output.show_progress("evaluating", len(seeds)) as show:
        return play_episodes(workers, seeds, exploration, record=request.measure_actions, watch=show)


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
