"""The best policies of a group of seeds, evaluated: a score per seed, and how much seeds differ."""

from __future__ import annotations

import dataclasses
from typing import Any

from pydantic_core import to_jsonable_python

from rlctl import output
from rlctl.errors import AnswerIsNo, ArtifactError, RlctlError
from rlctl.evaluation.episode_statistics import Spread
from rlctl.evaluation.evaluate import Gates
from rlctl.evaluation.request import EvalRequest
from rlctl.evaluation.score import measure_score
from rlctl.policy.shipped import MeasuredScore
from rlctl.run.group import Group


@dataclasses.dataclass(frozen=True)
class SeedScore:
    """What came of a seed."""

    seed: int
    run: str = ""
    algo: str = ""
    steps: int | None = None
    seconds: float | None = None
    """Spent training [s]."""
    score: MeasuredScore | None = None
    problem: str = ""
    """Why there is no score."""


@dataclasses.dataclass(frozen=True)
class GroupScore:
    """The scores of a group."""

    group: Group
    seeds: list[SeedScore]

    def spread(self, quantity: str) -> Spread | None:
        """Return how `success` or `mean_return` is distributed over seeds; None where no seed has it."""
        values = [getattr(seed.score, quantity) for seed in self.seeds if seed.score is not None]
        known = [value for value in values if value is not None]
        return Spread.of(known) if known else None

    def check(self, gates: Gates) -> None:
        """Raise `ArtifactError` for seeds without a score, and `AnswerIsNo` for those that miss a gate.

        Raises `UsageError` for a gate on success where the task does not report it.
        """
        if failed := [seed for seed in self.seeds if seed.score is None]:
            raise ArtifactError(
                f"{self.group.path}: {len(failed)} of {len(self.seeds)} seeds without a score, the first seed "
                f"{failed[0].seed}: {failed[0].problem}"
            )
        missed = []
        for seed in self.seeds:
            score = seed.score
            assert score is not None
            gates.check_possible(score.success is not None)
            gates_missed = gates.list_missed(score.success, score.success_interval, score.mean_return)
            missed += [f"seed {seed.seed}: {gate}" for gate in gates_missed]
        if missed:
            raise AnswerIsNo("gate missed: " + "; ".join(missed))


def evaluate_group(group: Group, request: EvalRequest) -> GroupScore:
    """Evaluate a policy of every seed's run, by default the best; a seed without one has a problem instead."""
    return GroupScore(group, [_evaluate_seed(group, seed, request) for seed in group.seeds])


def _evaluate_seed(group: Group, seed: int, request: EvalRequest) -> SeedScore:
    run = group.find_run(seed)
    if run is None:
        return SeedScore(seed, problem="it has not begun")
    try:
        status = run.status()
        score = measure_score(dataclasses.replace(request, run=str(run.path)))
    except RlctlError as error:
        return SeedScore(seed, run.path.name, problem=str(error).partition("\n")[0])
    steps, seconds = status.get("steps"), status.get("seconds")
    return SeedScore(seed, run.path.name, str(status.get("algo", "")), steps, seconds, score)


def show(result: GroupScore, json: str | None) -> None:
    """Print a row per seed and what they have in common, or JSON alone for `-`."""
    if output.present(as_json(result), json):
        return
    out = output.out()
    scores = [seed.score for seed in result.seeds if seed.score is not None]
    episodes = f", {output.format_count(scores[0].episodes, 'episode')} each, seed {scores[0].seed}" if scores else ""
    seeds = output.format_count(len(result.seeds), "seed")
    out.print(f"{result.group.task}: {result.group.path}, {seeds}{episodes}")
    success, returns = result.spread("success"), result.spread("mean_return")
    rows = [_list_cells(seed) for seed in result.seeds]
    for label in ("mean", "IQM", "std"):
        rate, value = (None if spread is None else getattr(spread, label.lower()) for spread in (success, returns))
        rows.append((label, "-" if rate is None else f"{rate:.1%}", "-" if value is None else f"{value:.4g}"))
    output.print_table(("seed", "success", "return", "steps", "seconds", ""), rows, left=("",))


def _list_cells(seed: SeedScore) -> tuple[str, ...]:
    score = seed.score
    return (
        str(seed.seed),
        "-" if score is None or score.success is None else f"{score.success:.1%}",
        "-" if score is None else f"{score.mean_return:.4g}",
        "-" if seed.steps is None else f"{seed.steps:,}",
        "-" if seed.seconds is None else f"{seed.seconds:.0f}",
        seed.problem,
    )


def as_json(result: GroupScore) -> dict[str, Any]:
    """Return the scores as plain data."""
    spreads = {"success": result.spread("success"), "return": result.spread("mean_return")}
    content = {"group": result.group.path, "task": result.group.task, "seeds": result.seeds, **spreads}
    plain: dict[str, Any] = to_jsonable_python(content)
    return plain
