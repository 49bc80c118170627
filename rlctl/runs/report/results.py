"""The results of runs as a table: a row per run and the mean over the seeds of a recipe; Markdown, CSV, LaTeX."""

import csv
import dataclasses
import io
from collections.abc import Sequence

import numpy as np

from rlctl.evaluation.episode_statistics import mean_interval
from rlctl.runs.report.content import RecipeRuns, RunReport
from rlctl.runs.summary import RunSummary

Interval = tuple[float, float]

_LATEX = {"\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}"}
_LATEX |= {character: f"\\{character}" for character in "&%$#_{}"}


@dataclasses.dataclass(frozen=True)
class ResultRow:
    """The scores of a run, or their mean over the seeds of a recipe with its 95 % interval (Student's t)."""

    run: str  # name of the run; of a mean empty
    label: str
    recipe: str
    algo: str
    seed: int | None
    seeds: int  # with a score, over which a mean is taken; of a run 1
    state: str  # `done`, or why it is not; of a mean how many seeds are unfinished
    steps: int | None  # of a mean the fewest
    minutes: float | None  # of a mean the sum
    success: float | None
    success_interval: Interval | None
    mean_return: float | None
    return_interval: Interval | None

    @property
    def is_mean(self) -> bool:
        """Whether it is a mean over seeds."""
        return not self.run


def list_results(report: RunReport) -> list[ResultRow]:
    """Return a result per run, and after the runs of a recipe with several seeds their mean."""
    results = []
    for recipe in report.recipes:
        runs = [_describe_run(recipe, run.summary) for run in recipe.runs]
        results += runs
        if len(runs) > 1:
            results.append(_average(runs))
    return results


def _describe_run(recipe: RecipeRuns, run: RunSummary) -> ResultRow:
    return ResultRow(
        run=run.name,
        label=recipe.label,
        recipe=recipe.name,
        algo=run.algo,
        seed=run.seed,
        seeds=1,
        state=run.state_text,
        steps=run.steps,
        minutes=None if run.seconds is None else run.seconds / 60,
        success=run.best_success,
        success_interval=None,
        mean_return=run.best_return,
        return_interval=None,
    )


def _average(runs: Sequence[ResultRow]) -> ResultRow:
    scored = [run for run in runs if run.mean_return is not None]
    successes = [run.success for run in scored if run.success is not None]
    returns = [run.mean_return for run in scored if run.mean_return is not None]
    minutes = [run.minutes for run in runs if run.minutes is not None]
    unfinished = sum(run.state != "done" for run in runs)
    success_interval = None
    if successes:
        low, high = mean_interval(successes)
        success_interval = max(low, 0.0), min(high, 1.0)
    return dataclasses.replace(
        runs[0],
        run="",
        seed=None,
        seeds=len(scored),
        state=f"{unfinished} unfinished" if unfinished else "done",
        steps=min((run.steps for run in runs if run.steps is not None), default=None),
        minutes=sum(minutes) if minutes else None,
        success=float(np.mean(successes)) if successes else None,
        success_interval=success_interval,
        mean_return=float(np.mean(returns)) if returns else None,
        return_interval=mean_interval(returns) if returns else None,
    )


def format_markdown(results: Sequence[ResultRow]) -> str:
    """Return a Markdown table; intervals are in parentheses, and unfinished runs say so behind their name."""
    head = ("run", "recipe", "algo", "seed", "steps", "minutes", "success", "return")
    rows = [_list_cells(result) for result in results]
    lines = [head, ["---"] * len(head), *rows]
    return "".join(f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in line)} |\n" for line in lines)


def _list_cells(result: ResultRow) -> tuple[str, ...]:
    name = f"mean of {result.seeds} seeds" if result.is_mean else result.run
    if result.state != "done":
        name += f" ({result.state})"
    return (
        name,
        _name_recipe(result),
        result.algo,
        "" if result.seed is None else str(result.seed),
        "" if result.steps is None else f"{result.steps:,}",
        "" if result.minutes is None else f"{result.minutes:.1f}",
        _format(result.success, result.success_interval, ".1%"),
        _format(result.mean_return, result.return_interval, ".4g"),
    )


def _name_recipe(result: ResultRow) -> str:
    """Return the label, or what differs where the label is the name of the run, which the row has already."""
    is_name_of_run = result.label in result.run.split("/")
    return result.recipe if is_name_of_run or not result.label else result.label


def _format(value: float | None, interval: Interval | None, form: str) -> str:
    if value is None:
        return ""
    if interval is None:
        return f"{value:{form}}"
    return f"{value:{form}} ({interval[0]:{form}} to {interval[1]:{form}})"


def format_csv(results: Sequence[ResultRow]) -> str:
    """Return CSV with unrounded numbers; a row whose `run` is empty is a mean over seeds."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    names = ("run", "label", "recipe", "algo", "seed", "seeds", "state", "steps", "minutes")
    scores = ("success", "success_low", "success_high", "return", "return_low", "return_high")
    writer.writerow([*names, *scores])
    for result in results:
        success_interval = result.success_interval or (None, None)
        return_interval = result.return_interval or (None, None)
        values = [getattr(result, name) for name in names]
        writer.writerow([*values, result.success, *success_interval, result.mean_return, *return_interval])
    return text.getvalue()


def format_latex(report: RunReport, results: Sequence[ResultRow]) -> str:
    """Return a table for LaTeX with the package booktabs: a row per recipe, or per run where no recipe has seeds."""
    has_means = any(result.is_mean for result in results)
    alone = {result.label for result in results} - {result.label for result in results if result.is_mean}
    rows = [result for result in results if not has_means or result.is_mean or result.label in alone]
    lines = [
        f"% {report.title}: the best evaluation of each training; mean over seeds (95 % interval, Student's t)",
        r"\begin{tabular}{lrrll}",
        r"\toprule",
        r"recipe & seeds & steps & success & return \\",
        r"\midrule",
    ]
    for result in rows:
        name = result.label or result.recipe or result.algo
        if result.state != "done":
            name += f" ({result.state})"
        success = _format(result.success, result.success_interval, ".1%")
        value = _format(result.mean_return, result.return_interval, ".4g")
        steps = "" if result.steps is None else f"{result.steps:,}"
        cells = (name, str(result.seeds), steps, success, value)
        lines.append(" & ".join(map(_escape_latex, cells)) + r" \\")
    return "\n".join([*lines, r"\bottomrule", r"\end{tabular}", ""])


def _escape_latex(text: str) -> str:
    return "".join(_LATEX.get(character, character) for character in text)
