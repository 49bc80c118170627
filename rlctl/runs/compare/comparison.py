"""`rlctl runs compare`: is one policy, or one recipe, better than another?

Single runs are compared as policies: each plays the same episodes. Groups of runs (several training seeds of a recipe)
are compared as recipes: each run's best policy is evaluated, and the score of a seed is its mean over the episodes.
"""

import dataclasses
import itertools
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlctl.errors import AnswerIsNo, UsageError
from rlctl.evaluation.eval_request import EvalRequest
from rlctl.evaluation.evaluate import Evaluation, run_evaluation
from rlctl.recipe.recipe import NOT_SET, Recipe, find_difference, find_mixed
from rlctl.runs.compare.margin import check_margin
from rlctl.runs.compare.policy_alone import PolicyAlone, find_same_policy, reports_success
from rlctl.runs.compare.significance import ComparedQuantity, MeanDifference, Verdict, compare_episodes, compare_seeds
from rlctl.runs.directory import RunDirectory
from rlctl.runs.listing import find_runs_of
from rlctl.runs.lookup import describe_source_change
from rlctl.runs.recipe_names import name_recipes
from rlctl.runs.summary import RunSummary, summarize
from rlctl.runs.tables import read_table

THRESHOLD = 0.9  # the default threshold, a success rate
_POLICIES = (".safetensors", ".onnx")


@dataclasses.dataclass(frozen=True)
class EvaluatedRun:
    """A run, its best policy's episodes, and when it reached the threshold."""

    path: Path
    seed: int | None
    evaluation: Evaluation
    steps_to_threshold: int | None
    seconds_to_threshold: float | None
    unfinished: str = ""  # where its training is, if it has not finished: `stopped at step 7,984 of 40,000`

    def values(self, quantity: ComparedQuantity) -> NDArray[np.float64]:
        """Return the success (0 or 1) or return of each episode, shape (episodes,); NaN where it is not reported."""
        results = [episode.result for episode in self.evaluation.played]
        values = [result.success if quantity == "success" else result.total_reward for result in results]
        return np.array([np.nan if value is None else value for value in values], np.float64)


@dataclasses.dataclass(frozen=True)
class Side:
    """One of the things compared: a policy, or the runs of a recipe."""

    name: str
    runs: list[EvaluatedRun]
    mixed: list[str]  # recipe keys in which its own runs differ; there should be none
    difference: str = ""  # of a recipe what distinguishes it from the others, where that names it

    @property
    def label(self) -> str:
        """The name in texts."""
        return self.difference or self.name

    @property
    def has_success(self) -> bool:
        """Whether the task reports success to every run."""
        return all(run.evaluation.success_rate is not None for run in self.runs)

    @property
    def unfinished(self) -> str:
        """Where the first of its trainings is that has not finished; empty if all have."""
        return next((run.unfinished for run in self.runs if run.unfinished), "")

    @property
    def never_succeeds(self) -> bool:
        """Whether the task reports success, and no episode of any run succeeded."""
        return all(run.evaluation.success_rate == 0 for run in self.runs)

    def scores(self, quantity: ComparedQuantity) -> NDArray[np.float64]:
        """Return each run's mean over its episodes, shape (runs,)."""
        return np.array([np.nanmean(run.values(quantity)) for run in self.runs], np.float64)


@dataclasses.dataclass(frozen=True)
class Candidate:
    """A side that is compared with the baseline, and the differences in scores and recipe."""

    side: Side
    differences: Mapping[ComparedQuantity, MeanDifference]  # `success`, where the task reports it, then `return`
    recipe_changes: dict[str, tuple[Any, Any]] | None
    """Per dotted key the value here and the baseline's; None where a recipe is not known."""
    same_policy: str = ""  # sha256 of the policy file, if it is the baseline's too

    @property
    def verdict(self) -> Verdict:
        """Success decides; if it cannot tell, the return decides. The p-values are adjusted for both tests."""
        verdicts = (difference.verdict for difference in self.differences.values())
        return next((verdict for verdict in verdicts if verdict is not Verdict.CANNOT_TELL), Verdict.CANNOT_TELL)

    @property
    def is_better(self) -> bool:
        """Whether the verdict is `better`, and the interval of the difference that decides is above 0."""
        decisive = (each for each in self.differences.values() if each.verdict is not Verdict.CANNOT_TELL)
        first = next(decisive, None)
        return first is not None and first.verdict is Verdict.BETTER and first.low > 0

    def describe_loss(self, margin: float) -> str:
        """Return by how much it may be worse, if that may be more than `margin`; empty for the same policy."""
        (quantity, difference), *_ = self.differences.items()
        if self.same_policy or difference.low >= -margin:
            return ""
        largest = f"{-difference.low:.3g}"
        if difference.verdict is Verdict.WORSE:
            return (
                f"its {quantity} is lower by {-difference.mean:.3g}, perhaps by {largest}; --margin allows {margin:g}"
            )
        return f"its {quantity} may be lower by as much as {largest}; --margin allows {margin:g}"


@dataclasses.dataclass(frozen=True)
class ComparisonGate:
    """What candidates must show against the baseline: not to be worse, unless it says otherwise."""

    margin: float | None = None
    """The episodes must exclude a larger loss of success, or of return if the task reports no success."""
    better: bool = False  # each must be shown to be better, see `Candidate.is_better`
    allow_no_success: bool = False
    """Whether a candidate passes that never succeeds, as the baseline: it is not worse, but does nothing."""

    @property
    def name(self) -> str:
        """As `--gate` takes it."""
        return "better" if self.better else "not-worse"


NOT_WORSE = ComparisonGate()


@dataclasses.dataclass(frozen=True)
class RunComparison:
    """The baseline and the candidates that were compared with it."""

    of_recipes: bool  # whether recipes are compared, seed by seed; else two policies, episode by episode
    task: str
    baseline: Side
    candidates: list[Candidate]
    episodes: int
    threshold: float | None

    @property
    def world_differences(self) -> list[str]:
        """Recipe keys of the environment in which a candidate differs from the baseline; all play in the baseline's."""
        keys = dict.fromkeys(key for candidate in self.candidates for key in candidate.recipe_changes or ())
        return [key for key in keys if key.partition(".")[0] in ("task", "reward_weights", "randomize", "events")]

    @property
    def sides(self) -> list[Side]:
        """The baseline, then the candidates' sides."""
        return [self.baseline, *(candidate.side for candidate in self.candidates)]

    def find_missed(self, gate: ComparisonGate = NOT_WORSE) -> dict[str, str]:
        """Return the candidates that miss the gate, with a phrase; one with the baseline's policy is not worse."""
        missed = {}
        for candidate in self.candidates:
            name = candidate.side.name
            if candidate.side.never_succeeds and self.baseline.never_succeeds and not gate.allow_no_success:
                problem = (
                    f"not worse, but both succeed in none of {self.episodes} episodes, so nothing is shown; "
                    "--allow-no-success lets that pass"
                )
            elif gate.better:
                problem = "" if candidate.is_better else f"not shown to be better than {self.baseline.label}"
            elif gate.margin is None:
                problem = f"worse than {self.baseline.label}" if candidate.verdict is Verdict.WORSE else ""
            else:
                problem = candidate.describe_loss(gate.margin)
            if problem:
                missed[name] = f"{candidate.side.label}: {problem}"
        return missed

    def check(self, gate: ComparisonGate = NOT_WORSE) -> None:
        """Raise `AnswerIsNo` for what `find_missed` returns."""
        if missed := self.find_missed(gate):
            raise AnswerIsNo(f"gate missed: {'; '.join(missed.values())}")


def compare(
    texts: Sequence[str],
    request: EvalRequest,
    threshold: float | None = None,
    *,
    force: bool = False,
    margin: float | None = None,
) -> RunComparison:
    """Evaluate every run with the other fields of `request` than `run`, and compare each side with the first.

    `texts` are runs, policy files, groups, globs, or folders of runs; the first is the baseline. `threshold` is a
    success rate, or a return if the task reports no success; the result has the steps until an evaluation reached it.
    `force` compares even if the task has changed since a training or a seed has not finished its own. Raises
    `UsageError` for sides that cannot be compared, and for a `margin` that so many episodes cannot show.
    """
    if len(texts) < 2:
        raise UsageError("give two or more to compare, the baseline first: rlctl runs compare A B")
    groups = [[PolicyAlone(Path(text))] if Path(text).suffix in _POLICIES else find_runs_of(text) for text in texts]
    names = [
        text.rstrip("/") if len(group) > 1 else str(group[0].path) for text, group in zip(texts, groups, strict=True)
    ]
    return compare_runs(names, groups, request, threshold, force=force, margin=margin)


def compare_runs(
    names: Sequence[str],
    groups: Sequence[Sequence[RunDirectory]],
    request: EvalRequest,
    threshold: float | None = None,
    *,
    force: bool = False,
    margin: float | None = None,
) -> RunComparison:
    """Compare sides that have these names and runs; see `compare`."""
    import scipy.stats  # noqa: F401 - which rlctl-core leaves out: say so before any episode is played

    _refuse_unequal(names, groups)
    runs = [run for group in groups for run in group]
    tasks = list(dict.fromkeys(str(run.status()["task"]) for run in runs))
    if request.task is None and len(tasks) > 1:
        raise UsageError(f"runs of different tasks ({', '.join(tasks)}); --task TASK evaluates all on one task")
    for run in runs if request.task is None and not force else ():
        if change := describe_source_change(run):
            raise UsageError(
                f"{run.path}: {change}\nit was trained on another version of the task, so the comparison is not fair; "
                "--force compares anyway, on the task as it is now"
            )
    seeds = [run for group in groups if len(group) > 1 for run in group]
    if unfinished := next((run for run in seeds if run.status().get("status") != "finished" and not force), None):
        raise UsageError(
            f"{unfinished.path}: this seed has not finished its training\n"
            "the comparison is not fair; --force compares anyway"
        )
    recipes = [[] if isinstance(group[0], PolicyAlone) else [run.recipe() for run in group] for group in groups]
    for name, own in zip(names, recipes, strict=True):
        if any(one == two for one, two in itertools.combinations(own, 2)):
            raise UsageError(f"{name}: two of its runs have the same recipe and seed, which count as one training")
    of_recipes = len(groups[0]) > 1
    same = ["" if of_recipes else find_same_policy(group[0], groups[0][0]) for group in groups]
    has_margin = margin is not None and not (of_recipes or all(same))
    if margin is not None and has_margin and request.task is None:
        check_margin(margin, request.episodes, of_success=reports_success(groups[0][0]))
    first = _evaluate(groups[0][0], request, threshold)
    if margin is not None and has_margin:
        check_margin(margin, request.episodes, of_success=first.evaluation.success_rate is not None)
    # All play in the same environment: an easier tolerance does not make a policy better.
    request = dataclasses.replace(request, spec=first.evaluation.spec)
    sides = []
    for name, group, own, twin in zip(names, groups, recipes, same, strict=True):
        known = first.evaluation if twin else None
        evaluated = [first if run is groups[0][0] else _evaluate(run, request, threshold, known) for run in group]
        sides.append(Side(name=name, runs=evaluated, mixed=find_mixed(own)))
    if of_recipes:
        sides = _name_by_difference(sides, [own[0] for own in recipes])
    baseline, *others = sides
    return RunComparison(
        of_recipes=of_recipes,
        task=request.task or tasks[0],
        baseline=baseline,
        candidates=[
            Candidate(
                side,
                _differences(baseline, side, of_recipes, len(others)),
                find_difference(recipe[0], recipes[0][0]) | _find_other_starts(group[0], groups[0][0])
                if recipe and recipes[0]
                else None,
                twin,
            )
            for side, group, recipe, twin in zip(others, groups[1:], recipes[1:], same[1:], strict=True)
        ],
        episodes=request.episodes,
        threshold=_default_threshold(threshold, baseline.has_success),
    )


def _name_by_difference(sides: Sequence[Side], recipes: Sequence[Recipe]) -> list[Side]:
    """Name recipes by what differs, unless that names two alike, as where they began with other policies."""
    differences = name_recipes(recipes)
    if "" in differences or len(set(differences)) < len(differences):
        return list(sides)
    return [dataclasses.replace(side, difference=text) for side, text in zip(sides, differences, strict=True)]


def _find_other_starts(run: RunDirectory, baseline: RunDirectory) -> dict[str, tuple[Any, Any]]:
    """Return the policies that two trainings began with, under the name of the option, if they differ."""
    starts = [str((trained.status().get("from") or {}).get("policy", NOT_SET)) for trained in (run, baseline)]
    return {} if starts[0] == starts[1] else {"--from": (starts[0], starts[1])}


def _refuse_unequal(names: Sequence[str], groups: Sequence[Sequence[RunDirectory]]) -> None:
    if len({len(group) > 1 for group in groups}) > 1:
        alone = next(name for name, group in zip(names, groups, strict=True) if len(group) == 1)
        raise UsageError(
            f"{alone}: a single run cannot be compared with a group of seeds; "
            "train more seeds, or compare two single runs as policies"
        )
    paths = [run.path.resolve() for group in groups for run in group]
    if (twice := next((path for path in paths if paths.count(path) > 1), None)) is not None:
        raise UsageError(f"{twice}: given twice; a run cannot be compared with itself")


def _evaluate(
    run: RunDirectory, request: EvalRequest, threshold: float | None, evaluation: Evaluation | None = None
) -> EvaluatedRun:
    evaluation = evaluation or run_evaluation(dataclasses.replace(request, run=str(run.path)))
    has_success = evaluation.success_rate is not None
    column, threshold = "success" if has_success else "return", _default_threshold(threshold, has_success)
    reached: dict[str, float | None] = {}
    if threshold is not None:
        rows = read_table(run.evals_file)
        reached = next((row for row in rows if (value := row.get(column)) is not None and value >= threshold), reached)
    steps = reached.get("steps")
    summary = None if isinstance(run, PolicyAlone) else summarize(run.path)
    return EvaluatedRun(
        path=run.path,
        seed=None if summary is None else summary.seed,
        evaluation=evaluation,
        steps_to_threshold=None if steps is None else int(steps),
        seconds_to_threshold=reached.get("seconds"),
        unfinished="" if summary is None else _describe_unfinished(summary, run),
    )


def _describe_unfinished(summary: RunSummary, run: RunDirectory) -> str:
    if summary.state == "done":
        return ""
    return f"{summary.state} at step {summary.steps or 0:,} of {run.recipe().total_timesteps:,}"


def _default_threshold(threshold: float | None, has_success: bool) -> float | None:
    return THRESHOLD if threshold is None and has_success else threshold


def _differences(
    baseline: Side, side: Side, of_recipes: bool, comparisons: int
) -> Mapping[ComparedQuantity, MeanDifference]:
    quantities: list[ComparedQuantity] = ["return"]
    if baseline.has_success and side.has_success:
        quantities = ["success", "return"]
    one, two = (
        {quantity: own.scores(quantity) if of_recipes else own.runs[0].values(quantity) for quantity in quantities}
        for own in (baseline, side)
    )
    return compare_seeds(one, two, comparisons) if of_recipes else compare_episodes(one, two, comparisons)
