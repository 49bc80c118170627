"""`rlctl eval`: play many episodes, each with its own seed, and return their statistics."""

import dataclasses
import functools
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from rlctl import output
from rlctl.environments.info import EnvInfo
from rlctl.environments.spec import EnvSpec
from rlctl.errors import AnswerIsNo, UsageError
from rlctl.evaluation import episode_statistics
from rlctl.evaluation.episode_statistics import Spread
from rlctl.evaluation.eval_request import NO_GATES, EvalRequest, Gates
from rlctl.evaluation.failures import FailurePattern, find_patterns
from rlctl.evaluation.players import Baseline, LoadedPolicy, choose_task, find_player, load_baseline
from rlctl.evaluation.sequential import EarlyGate, find_interval
from rlctl.play.collect import Episode, play_episodes
from rlctl.play.episode import save_episode
from rlctl.play.messages import EpisodeResult
from rlctl.play.seeds import Stream, episode_seeds
from rlctl.play.workers import Workers, count_envs
from rlctl.policy.actor import Exploration
from rlctl.policy.file import PolicyInfo
from rlctl.policy.shipped import MeasuredScore

_PLAYED_TOGETHER = 10  # episodes, before it is asked whether the gate is decided


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
    unlimited: "Evaluation | None" = None  # the same episodes without limits
    action_change: float | None = None  # mean of |action - previous action|; None if it was not measured
    failure_patterns: list[FailurePattern] = dataclasses.field(default_factory=list)  # what failures have in common
    planned: int = 0  # episodes that were to be played
    early: EarlyGate | None = None  # what may have ended it before
    return_interval: tuple[float, float] | None = None
    """95 % interval of the mean return; None for one episode, and where the results may have ended it early."""

    def check(self, gates: Gates) -> None:
        """Raise `AnswerIsNo`, naming every gate that was missed."""
        if missed := gates.list_missed(self.success_rate, self.success_interval, self.returns.mean):
            raise AnswerIsNo("gate missed: " + "; ".join(missed))

    @property
    def end(self) -> str:
        """Why it ended, as a sentence: the gate was decided early, or empty: all episodes were played."""
        if self.early is None:
            return ""
        successes = sum(bool(episode.result.success) for episode in self.played)
        return self.early.explain_end(successes, len(self.played), self.planned)

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


def run_evaluation(
    request: EvalRequest,
    gates: Gates = NO_GATES,
    *,
    print_notes: Callable[[Sequence[str]], None] = output.print_notes,
) -> Evaluation:
    """Find the policy, play its episodes, and return their statistics; `print_notes` as in `find_player`."""
    if request.baseline is not None:
        return _evaluate(load_baseline(request.baseline), choose_baseline_task(request), request, gates)
    _, policy, spec = find_player(request, print_notes)
    return _evaluate(policy, spec, request, gates)


def choose_baseline_task(request: EvalRequest) -> EnvSpec:
    """Return the environment in which a request's `--policy` plays; raises `UsageError` for options of runs."""
    name = str(request.baseline)
    if request.checkpoint != "best" or request.stage is not None or not request.deterministic or request.task:
        raise UsageError(
            f"--policy {name} plays a task, not a run: leave out --checkpoint, "
            "--pretrained, --stage, --stochastic and --task"
        )
    if request.spec is not None:
        return request.spec.observe_as(EnvSpec(request.spec.task))
    return request.changes.apply(choose_task(request.run, name, "eval"))


def start_workers(spec: EnvSpec, request: EvalRequest) -> Workers:
    """Start the workers of a request: by default as many environments as `count_envs`, but no more than episodes."""
    n_envs = min(request.n_envs or count_envs(spec, request.episodes), request.episodes)
    return Workers(spec, n_envs, timeout_s=request.env_timeout_s)


def _evaluate(actor: LoadedPolicy | Baseline, spec: EnvSpec, request: EvalRequest, gates: Gates) -> Evaluation:
    if (folder := request.record) is not None and (folder.is_file() or any(folder.glob("*"))):
        raise UsageError(f"--record {folder}: exists already; give a new folder, or remove this one")
    early = gates.choose_early(request.limits is not None) if request.decide_early else None
    gates.check_reachable(request.episodes, decide_early=request.decide_early)
    with start_workers(spec, request) as workers:
        limits = None if request.limits is None else _read_limits(request.limits, workers.info)
        actor.give_to(workers)
        if actor.info is not None and (changes := actor.info.env.list_other_meanings(workers.info)):
            output.print_notes([f"warning: since the training {'; '.join(changes)}"])
        if workers.info.reward_weights:
            gates.check_possible(workers.info.has_success)
        if early is None:
            episodes = _play(workers, request, gates)
        else:
            episodes = _play_until_decided(workers, request, gates, early)
        if request.record is not None:
            for number, episode in enumerate(episodes):
                save_episode(request.record / f"{number:06d}.npz", episode.describe(spec, workers.info, actor.name))
        evaluation = _summarize(actor, workers, request, episodes, early)
        if limits is not None:
            workers.limit_actions(limits)
            limited = _summarize(actor, workers, request, _play(workers, request, gates))
            evaluation = dataclasses.replace(limited, limited_by=request.limits, unlimited=evaluation)
    return evaluation


def _read_limits(file: Path, info: EnvInfo) -> dict[str, Any]:
    """Return limits as plain data; raises `RecipeError` if they do not fit the environment's actions."""
    from rlctl.limits.fitting import fit_limits
    from rlctl.limits.limits import read_limits

    limits = read_limits(file)
    fit_limits(limits, info)
    return limits.model_dump(mode="json", exclude_unset=True)


def _play(workers: Workers, request: EvalRequest, gates: Gates) -> list[Episode]:
    seeds = episode_seeds(request.seed, Stream.EVAL, request.episodes)
    with output.show_progress("evaluating", len(seeds), "episodes") as show:
        return _play_seeds(workers, request, gates, seeds, show)


def _play_seeds(
    workers: Workers, request: EvalRequest, gates: Gates, seeds: Sequence[int], show: Callable[[int], None]
) -> list[Episode]:
    """Play an episode per seed; raises `UsageError` at the end of the first one without the success of a gate."""
    return play_episodes(
        workers,
        seeds,
        Exploration(stochastic=not request.deterministic),
        record=request.measure_actions or request.record is not None,
        watch=show,
        check=lambda result: gates.check_possible(result.success is not None),
    )


def _play_until_decided(workers: Workers, request: EvalRequest, gates: Gates, early: EarlyGate) -> list[Episode]:
    """Play some episodes at a time; return those up to the one that decides the gate, whatever was played beyond."""
    seeds = episode_seeds(request.seed, Stream.EVAL, request.episodes)
    episodes: list[Episode] = []
    successes = 0
    with output.show_progress("evaluating", len(seeds), "episodes") as show:
        while chunk := seeds[len(episodes) : len(episodes) + max(_PLAYED_TOGETHER, workers.n_envs)]:
            show_chunk = functools.partial(_show_more, show, len(episodes))
            for episode in _play_seeds(workers, request, gates, chunk, show_chunk):
                episodes.append(episode)
                successes += bool(episode.result.success)
                if early.explain_end(successes, len(episodes), len(seeds)):
                    return episodes
    return episodes


def _show_more(show: Callable[[int], None], before: int, count: int) -> None:
    show(before + count)


def _summarize(
    actor: LoadedPolicy | Baseline,
    workers: Workers,
    request: EvalRequest,
    episodes: list[Episode],
    early: EarlyGate | None = None,
) -> Evaluation:
    results = [episode.result for episode in episodes]
    distances = [result.final_distance for result in results if result.final_distance is not None]
    return Evaluation(
        name=actor.name,
        policy=actor.info,
        spec=workers.spec,
        events=workers.info.events,
        seed=request.seed,
        deterministic=request.deterministic,
        played=[dataclasses.replace(episode, trajectory=None) for episode in episodes],
        success_rate=episode_statistics.success_rate(results),
        success_interval=_find_success_interval(results, request),
        returns=Spread.of([result.total_reward for result in results]),
        lengths=Spread.of([result.length for result in results]),
        terms=episode_statistics.mean_terms(results),
        metrics=episode_statistics.mean_metrics(results),
        final_distance=Spread.of(distances) if distances else None,
        max_steps=workers.info.max_steps,
        action_change=episode_statistics.mean_action_change(episodes) if request.measure_actions else None,
        failure_patterns=find_patterns(episodes, workers.info),
        planned=request.episodes,
        early=early,
        return_interval=None if early is not None or len(results) < 2 else episode_statistics.return_interval(results),
    )


def _find_success_interval(results: list[EpisodeResult], request: EvalRequest) -> tuple[float, float] | None:
    if not request.decide_early or results[0].success is None:
        return episode_statistics.success_interval(results)
    return find_interval(sum(bool(result.success) for result in results), len(results))


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
        return_interval=episode_statistics.return_interval(results),
        success=evaluation.success_rate,
        success_interval=evaluation.success_interval,
        mean_length=evaluation.lengths.mean,
        ended_early=None if limit is None else sum(result.length < limit for result in results) / len(results),
        action_change=evaluation.action_change or 0.0,
    )
