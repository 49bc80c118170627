"""Prints a comparison."""

from typing import Any

from rich.text import Text

from rlctl import output
from rlctl.evaluation.episode_statistics import Spread
from rlctl.evaluation.eval_request import judge
from rlctl.recipe.stages import format_value
from rlctl.runs.compare import significance
from rlctl.runs.compare.comparison import Candidate, ComparisonGate, EvaluatedRun, RunComparison, Side
from rlctl.storage.junit import Suite, make_gate_case
from rlctl.version import collect_versions


def make_suite(result: RunComparison, gate: ComparisonGate | None, seconds: float) -> Suite:
    """Return a test case for each candidate, which fails where it misses the gate; it took so long [s]."""
    missed = result.find_missed(gate) if gate else {}
    cases = []
    for candidate in result.candidates:
        name = candidate.side.name
        problems = [missed[name]] if name in missed else []
        text = "\n".join([describe_verdict(result, candidate), *describe_candidate(result, candidate)])
        classname = f"{result.task}.runs compare"
        cases.append(make_gate_case(classname, f"{name} against {result.baseline.name}", problems, text))
    return Suite(f"rlctl runs compare {result.task}", seconds, cases)


def show(result: RunComparison, json: str | None, gate: ComparisonGate | None = None) -> None:
    """Print which question is answered, the scores, the differences and the verdicts; or JSON alone for `-`."""
    missed = list(result.find_missed(gate).values()) if gate else []
    verdict = judge("runs compare", missed, has_gate=gate is not None)
    gates = {"gate": gate.name if gate else None, "margin": gate.margin if gate else None}
    if output.present(as_json(result) | verdict | gates, json):
        return
    out = output.out()
    if result.of_recipes:
        out.print(f"recipes on {result.task}: the unit is the training seed, {result.episodes} episodes each")
        _show_seeds(result)
    else:
        out.print(f"policies on {result.task}: the unit is the episode, the same {result.episodes} for each")
        rows = [(side.name, *_format_scores(side.runs[0])) for side in result.sides]
        output.print_table(("policy", "success", "return"), rows, left=("policy",))
    if result.world_differences:
        out.print(f"all runs were evaluated with the baseline's {', '.join(result.world_differences)}")
    out.print(describe_tests(result))
    for candidate in result.candidates:
        question = f"\n{candidate.side.label} against {result.baseline.label}: "
        out.print(Text.assemble(question, (describe_verdict(result, candidate), "bold")), soft_wrap=True)
        lines = describe_candidate(result, candidate)
        for key, (value, before) in (candidate.recipe_changes or {}).items():
            lines.append(f"recipe: {key}: {format_value(key, before)} -> {format_value(key, value)}")
        for line in [*lines, "recipe: the same"] if candidate.recipe_changes == {} else lines:
            out.print(f"  {line}")


def _show_seeds(result: RunComparison) -> None:
    columns = ["recipe", "seed", "success", "return"]
    if result.threshold is not None:
        columns += [f"steps to {result.threshold:g}", f"seconds to {result.threshold:g}"]
    rows = [(side.label, *_format_seed(run))[: len(columns)] for side in result.sides for run in side.runs]
    output.print_table(columns, rows, left=("recipe",))
    for side in result.sides:
        output.out().print(describe_seeds(result, side))
        if side.mixed:
            output.out().print(f"warning: {side.label} is not one recipe: its runs differ in {', '.join(side.mixed)}")


def describe_seeds(result: RunComparison, side: Side) -> str:
    """Return a recipe's scores in the episodes of the comparison."""
    scores = "; ".join(_format_aggregate(side, quantity) for quantity in result.candidates[0].differences)
    return f"{side.label}: {len(side.runs)} seeds, {scores}"


def _or_dash(value: float | None, form: str) -> str:
    return "-" if value is None else format(value, form)


def _format_scores(run: EvaluatedRun) -> tuple[str, str]:
    return _or_dash(run.evaluation.success_rate, ".1%"), f"{run.evaluation.returns.mean:.4g}"


def _format_seed(run: EvaluatedRun) -> tuple[str, ...]:
    reached = (_or_dash(run.steps_to_threshold, ","), _or_dash(run.seconds_to_threshold, ".0f"))
    return (_or_dash(run.seed, ""), *_format_scores(run), *reached)


def _format_aggregate(side: Side, quantity: significance.ComparedQuantity) -> str:
    """Return `success mean 97.0%, IQM 97.5% (95 % interval 95.0% to 99.0%)`; of few seeds their range."""
    scores = side.scores(quantity)
    spread, interval = Spread.of(scores.tolist()), significance.interquartile_mean_interval(scores)
    what = "95 % interval"
    if interval is None:
        what, interval = f"range of {scores.size} seeds", (float(scores.min()), float(scores.max()))
    form = ".1%" if quantity == "success" else ".4g"
    mean, middle, low, high = (format(value, form) for value in (spread.mean, spread.iqm, *interval))
    return f"{quantity} mean {mean}, IQM {middle} ({what} {low} to {high})"


def describe_verdict(result: RunComparison, candidate: Candidate) -> str:
    """Return `worse, but its training stopped at step 7,984 of 40,000`; the verdict alone if both have finished."""
    unfinished = [
        (whose, side.unfinished) for whose, side in (("its", candidate.side), ("the baseline's", result.baseline))
    ]
    parts = [f"{whose} training {text}" for whose, text in unfinished if text]
    return f"{candidate.verdict}, but {' and '.join(parts)}" if parts else str(candidate.verdict)


def describe_candidate(result: RunComparison, candidate: Candidate) -> list[str]:
    """Return a line per difference, and if the verdict is `cannot tell`, how much data would decide."""
    lines = [_format_difference(quantity, difference) for quantity, difference in candidate.differences.items()]
    if candidate.same_policy:
        return [f"the same policy file (sha256 {candidate.same_policy[:12]}...): there is nothing to tell apart"]
    if candidate.verdict is significance.Verdict.CANNOT_TELL:
        lines.append(format_needed(candidate, len(result.candidates)))
    return lines


def _format_difference(quantity: significance.ComparedQuantity, difference: significance.MeanDifference) -> str:
    """Return `success: +3.0 points (95 % interval +1.0 to +5.0), p = 0.012`; points are percentage points."""
    scale, form, unit = (100, "+.1f", " points") if quantity == "success" else (1, "+.4g", "")
    mean, low, high = (format(scale * value, form) for value in (difference.mean, difference.low, difference.high))
    text = f"{quantity}: {mean}{unit} (95 % interval {low} to {high}), p = {difference.p:.2g}"
    if isinstance(difference, significance.SeedDifference):
        text += f", probability of improvement {difference.probability_of_improvement:.0%}"
    return text


def format_needed(candidate: Candidate, comparisons: int) -> str:
    """Return how much data would decide; `comparisons` is the number of candidates."""
    first, *_ = candidate.differences.values()
    unit, parts = "episodes", []
    if isinstance(first, significance.SeedDifference):
        unit = "seeds for each recipe"
        if first.smallest_p >= significance.ALPHA:
            seeds, smallest = significance.find_least_seeds(comparisons)
            parts.append(
                f"too few seeds to decide: their smallest possible p-value is {first.smallest_p:.2g}; "
                f"{seeds} seeds for each recipe reach {smallest:.2g}"
            )
    needed = [
        (difference.needed, quantity) for quantity, difference in candidate.differences.items() if difference.needed
    ]
    if needed:
        count, quantity = min(needed)
        parts.append(
            f"about {count:,} new {unit} would decide, if the true difference in {quantity} is the measured one"
        )
    return "; ".join(parts) or "no difference at all: more data would not decide"


def describe_tests(result: RunComparison) -> str:
    """Return what is tested, and how often equal candidates are reported as different."""
    quantities = " and ".join(result.candidates[0].differences)
    count = len(result.candidates)
    of = "" if count == 1 else f" of {count} candidates"
    together = "" if count == 1 and " and " not in quantities else ", p-values (not intervals) adjusted for all tests"
    rate = f"{significance.ALPHA:.0%} of comparisons report a difference"
    return f"tested: {quantities}{of}{together}; if all are equal, {rate}"


def as_json(result: RunComparison) -> dict[str, Any]:
    """Return the result as plain data."""
    return {
        "question": "recipes" if result.of_recipes else "policies",
        "unit": "training seed" if result.of_recipes else "episode",
        "task": result.task,
        "versions": collect_versions(),
        "episodes": result.episodes,
        "threshold": result.threshold,
        "tested": describe_tests(result),
        "baseline": _side_as_json(result.baseline, result),
        "candidates": [
            {
                **_side_as_json(candidate.side, result),
                "verdict": str(candidate.verdict),
                "same_policy": bool(candidate.same_policy),
                "differences": {
                    quantity: {**vars(difference), "verdict": str(difference.verdict)}
                    for quantity, difference in candidate.differences.items()
                },
                "recipe_changes": None
                if candidate.recipe_changes is None
                else {
                    key: {"here": value, "baseline": before}
                    for key, (value, before) in candidate.recipe_changes.items()
                },
            }
            for candidate in result.candidates
        ],
    }


def _side_as_json(side: Side, result: RunComparison) -> dict[str, Any]:
    runs = [
        {
            "run": str(run.path),
            "seed": run.seed,
            "success_rate": run.evaluation.success_rate,
            "return": run.evaluation.returns.mean,
            "steps_to_threshold": run.steps_to_threshold,
            "seconds_to_threshold": run.seconds_to_threshold,
            "unfinished": run.unfinished,
        }
        for run in side.runs
    ]
    if not result.of_recipes:
        return {"name": side.name, "runs": runs}
    over_seeds = {}
    for quantity in result.candidates[0].differences:
        scores = side.scores(quantity)
        interval = significance.interquartile_mean_interval(scores)
        over_seeds[quantity] = {**vars(Spread.of(scores.tolist())), "iqm_interval": interval}
    return {"name": side.name, "label": side.label, "runs": runs, "over_seeds": over_seeds, "mixed": side.mixed}
