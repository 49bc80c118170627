"""What a comparison prints."""

from __future__ import annotations

import dataclasses
from typing import Any

from rlctl import output
from rlctl.runs.comparison import Candidate, Comparison, Quantity, Side
from rlctl.runs.statistics import (
    ALPHA,
    Difference,
    SeedDifference,
    Verdict,
    interquartile_mean,
    interquartile_mean_interval,
)


def show(result: Comparison, json: str | None) -> None:
    """Print which question is answered, the scores, the differences and the verdicts; or write all as JSON."""
    if json is not None:
        output.write_result_json(json, as_json(result))
        return
    out = output.out()
    if result.of_recipes:
        out.print(f"recipes on {result.task}: the unit is the training seed, {result.episodes} episodes each")
        _show_seeds(result)
    else:
        out.print(f"policies on {result.task}: the unit is the episode, the same {result.episodes} for each")
        _show_policies(result)
    for candidate in result.candidates:
        _show_candidate(result, candidate)


def _show_policies(result: Comparison) -> None:
    table = _table("", "success", "return")
    for side in _sides(result):
        rate = side.runs[0].evaluation.success_rate
        table.add_row(side.name, "-" if rate is None else f"{rate:.1%}", f"{side.runs[0].values('return').mean():.4g}")
    output.out().print(table)


def _show_seeds(result: Comparison) -> None:
    reaching = "" if result.threshold is None else f" to {result.threshold:g}"
    table = _table("", "seed", "success", "return", *([f"steps{reaching}", f"seconds{reaching}"] if reaching else []))
    for side in _sides(result):
        for run in side.runs:
            rate = run.evaluation.success_rate
            table.add_row(
                side.name,
                "-" if run.seed is None else str(run.seed),
                "-" if rate is None else f"{rate:.1%}",
                f"{run.values('return').mean():.4g}",
                *(
                    [
                        "-" if run.steps_to_threshold is None else f"{run.steps_to_threshold:,}",
                        "-" if run.seconds_to_threshold is None else f"{run.seconds_to_threshold:.0f}",
                    ]
                    if reaching
                    else []
                ),
            )
    out = output.out()
    out.print(table)
    for side in _sides(result):
        for quantity in _quantities(result):
            scores = side.scores(quantity)
            low, high = interquartile_mean_interval(scores)
            out.print(
                f"{side.name}: {quantity} mean {scores.mean():.4g}, IQM {interquartile_mean(scores):.4g} "
                f"(95 % interval {low:.4g} to {high:.4g}), {len(scores)} seeds",
                markup=False,
            )


def _table(*columns: str) -> Any:
    from rich.table import Table

    table = Table(box=None, pad_edge=False)
    for number, column in enumerate(columns):
        table.add_column(column, justify="right" if number else "left", header_style="bold", overflow="fold")
    return table


def _sides(result: Comparison) -> list[Side]:
    return [result.baseline, *(candidate.side for candidate in result.candidates)]


def _quantities(result: Comparison) -> list[Quantity]:
    return list(result.candidates[0].differences)


def _show_candidate(result: Comparison, candidate: Candidate) -> None:
    out = output.out()
    out.print(f"\n{candidate.side.name} against {result.baseline.name}: [bold]{candidate.verdict}[/bold]")
    for quantity, difference in candidate.differences.items():
        out.print(f"  {quantity}: {format_difference(difference, as_percent=quantity == 'success')}")
    if candidate.verdict is Verdict.CANNOT_TELL:
        out.print(f"  {format_needed(candidate, result.of_recipes)}")
    for key, (value, before) in candidate.recipe_changes.items():
        out.print(f"  recipe: {key}: {before} -> {value}", markup=False)
    if not candidate.recipe_changes:
        out.print("  recipe: the same")


def format_difference(difference: Difference, *, as_percent: bool) -> str:
    """Return `+3.0 % (95 % interval +1.0 % to +5.0 %), p = 0.012`."""

    def number(value: float) -> str:
        return f"{value * 100:+.1f} %" if as_percent else f"{value:+.4g}"

    text = (
        f"{number(difference.mean)} (95 % interval {number(difference.low)} to {number(difference.high)}), "
        f"p = {difference.p:.2g}"
    )
    if isinstance(difference, SeedDifference):
        text += f", probability of improvement {difference.probability_of_improvement:.0%}"
    return text


def format_needed(candidate: Candidate, of_recipes: bool) -> str:
    """Say how much data would decide."""
    unit = "seeds for each recipe" if of_recipes else "episodes"
    first = next(iter(candidate.differences.values()))
    if isinstance(first, SeedDifference) and first.smallest_p >= ALPHA:
        return (
            f"so few seeds cannot decide: the smallest p-value that they can reach is {first.smallest_p:.2g}; "
            "4 seeds for each recipe reach 0.029, 5 reach 0.008"
        )
    needed = [each.needed for each in candidate.differences.values() if each.needed is not None]
    if not needed:
        return "no difference at all: more of the same would not decide"
    return f"if the difference is as it seems, about {min(needed):,} {unit} would decide"


def as_json(result: Comparison) -> dict[str, Any]:
    """Return the result as plain data."""
    return {
        "question": "recipes" if result.of_recipes else "policies",
        "unit": "training seed" if result.of_recipes else "episode",
        "task": result.task,
        "episodes": result.episodes,
        "threshold": result.threshold,
        "baseline": _side_as_json(result.baseline),
        "candidates": [
            {
                **_side_as_json(candidate.side),
                "verdict": str(candidate.verdict),
                "differences": {
                    quantity: {**dataclasses.asdict(difference), "verdict": str(difference.verdict)}
                    for quantity, difference in candidate.differences.items()
                },
                "recipe_changes": {
                    key: {"here": value, "baseline": before}
                    for key, (value, before) in candidate.recipe_changes.items()
                },
            }
            for candidate in result.candidates
        ],
    }


def _side_as_json(side: Side) -> dict[str, Any]:
    runs = [
        {
            "run": str(run.path),
            "seed": run.seed,
            "success_rate": run.evaluation.success_rate,
            "return": float(run.values("return").mean()),
            "steps_to_threshold": run.steps_to_threshold,
            "seconds_to_threshold": run.seconds_to_threshold,
        }
        for run in side.runs
    ]
    return {"name": side.name, "runs": runs}
