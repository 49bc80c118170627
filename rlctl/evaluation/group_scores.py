"""`rlctl eval` of a group: the score of every seed, and how they are distributed."""

import dataclasses
import functools
from collections.abc import Callable, Sequence
from typing import Any

from pydantic_core import to_jsonable_python

from rlctl import output
from rlctl.errors import AnswerIsNo, ArtifactError, RlctlError
from rlctl.evaluation.episode_statistics import Spread
from rlctl.evaluation.eval_request import EvalRequest, Gates
from rlctl.evaluation.evaluate import measure_score
from rlctl.policy.shipped import MeasuredScore
from rlctl.runs.group import Group


@dataclasses.dataclass(frozen=True)
class SeedScore:
    """The score of one seed, or why it has none."""

    seed: int
    run: str = ""
    algo: str = ""
    steps: int | None = None
    seconds: float | None = None  # spent training [s]
    score: MeasuredScore | None = None
    problem: str = ""  # why there is no score


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

    def as_json(self) -> dict[str, Any]:
        """Return the scores as plain data."""
        spreads = {"success": self.spread("success"), "return": self.spread("mean_return")}
        scores = {"group": self.group.path, "task": self.group.task, "seeds": self.seeds, **spreads}
        return dict(to_jsonable_python(scores))

    def check(self, gates: Gates) -> None:
        """Raise `ArtifactError` if a seed has no score, and `AnswerIsNo` if one misses a gate."""
        scores = [(seed, seed.score) for seed in self.seeds if seed.score is not None]
        if failed := [seed for seed in self.seeds if seed.score is None]:
            raise ArtifactError(
                f"{self.group.path}: {len(failed)} of {len(self.seeds)} seeds have no score; seed {failed[0].seed}: "
                f"{failed[0].problem}"
            )
        missed = []
        for seed, score in scores:
            gates.check_possible(score.success is not None)
            gates_missed = gates.list_missed(score.success, score.success_interval, score.mean_return)
            missed += [f"seed {seed.seed}: {gate}" for gate in gates_missed]
        if missed:
            raise AnswerIsNo("gate missed: " + "; ".join(missed))


def evaluate_group(group: Group, request: EvalRequest) -> GroupScore:
    """Evaluate a policy of every seed's run, by default the best; a seed without one has a problem instead."""
    print_notes = functools.cache(output.print_notes)  # a warning about all seeds, such as a changed task, only once
    return GroupScore(group, [_evaluate_seed(group, seed, request, print_notes) for seed in group.seeds])


def _evaluate_seed(
    group: Group, seed: int, request: EvalRequest, print_notes: Callable[[Sequence[str]], None]
) -> SeedScore:
    run = group.find_run(seed)
    if run is None:
        return SeedScore(seed, problem="not started yet")
    try:
        status = run.status()
        score = measure_score(dataclasses.replace(request, run=str(run.path)), print_notes)
    except RlctlError as error:
        return SeedScore(seed, run.path.name, problem=str(error).partition("\n")[0])
    steps, seconds = status.get("steps"), status.get("seconds")
    return SeedScore(seed, run.path.name, str(status.get("algo", "")), steps, seconds, score)
