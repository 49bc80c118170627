"""`rlctl runs show`: one run: what it was trained with, its curve, its evaluations, its files."""

import shlex
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from rich.filesize import decimal as format_bytes
from rich.text import Text

from rlctl import output
from rlctl.errors import ArtifactError
from rlctl.evaluation import robustness
from rlctl.evaluation.robustness import Robustness
from rlctl.recipe.recipe import NOT_SET
from rlctl.recipe.stages import format_value
from rlctl.runs.best import describe_unevaluated_last
from rlctl.runs.diagnosis.findings import diagnose, format_findings
from rlctl.runs.diagnosis.history import RunHistory
from rlctl.runs.directory import RunDirectory
from rlctl.runs.listing import as_json
from rlctl.runs.lookup import describe_source_change
from rlctl.runs.report.audited import list_lines, read_audit
from rlctl.runs.summary import RunSummary, summarize
from rlctl.runs.tables import TableRows, list_points

_EVALUATIONS_SHOWN = 12
_POOR_SUCCESS = 0.5  # below, the policy has learned something else
_ALWAYS_SHOWN = ("steps", "success", "return")
_PLOT_SIZE = (90, 13)  # columns and lines of a curve


class RunDescription(RunHistory):
    """Everything that `rlctl runs show` prints about a run."""

    def __init__(self, run: RunDirectory) -> None:
        """Read a run; raises `ArtifactError` if its `run.json` is damaged."""
        super().__init__(run)
        self.warnings = list(_list_warnings(run.status()))
        if change := describe_source_change(run):
            self.warnings.append(f"{change}: it was trained on another version of the task")
        self.summary = summarize(run.path)
        unevaluated = describe_unevaluated_last(run)
        if unevaluated and self.summary.state != "running":
            self.warnings.append(unevaluated)
        self.findings = diagnose(self)
        self.robustness: Robustness | None = None  # what `rlctl eval --vary` or `--push` measured
        if run.robustness_file.is_file():
            try:
                self.robustness = robustness.read(run.robustness_file)
            except ArtifactError as error:
                self.warnings.append(str(error))
        self.audit: dict[str, Any] | None = None  # what `rlctl runs show --audit` found
        try:
            self.audit = read_audit(run)
        except ArtifactError as error:
            self.warnings.append(str(error))


def _list_warnings(status: Mapping[str, Any]) -> Iterator[str]:
    counted = {
        "observations_outside": "observations outside their space",
        "failed_evaluations": "evaluations that failed",
    }
    for key, noun in counted.items():
        if isinstance(count := status.get(key), int) and count:
            yield f"{count:,} {noun}"
    if status.get("error"):
        yield str(status["error"])


def describe_robustness(result: Robustness) -> Iterator[str]:
    """Yield lines about the worst cell of all maps and the nominal one, the push test, and the command.

    The scores name their policy: it need not be the one that the training's evaluations chose as the best.
    """
    policy = Path(result.policy_file).name
    if not result.is_baseline:
        policy = f"{policy}, step {result.training_steps:,}"
    if any(varied.played for varied in result.maps):
        place, worst = result.name_worst()
        where = f"worst cell, {result.episodes} episodes at {place}"
        for name, outcome in ((where, worst), ("with nothing varied", result.nominal)):
            rate = "" if outcome.success_rate is None else f"success {outcome.success_rate:.1%}, "
            yield f"{name}: {rate}return {outcome.mean_return:.4g} ({policy})"
    for line in result.list_failed():
        yield f"failed: {line}"
    if result.push is not None:
        yield f"{result.push.verdict} ({policy})"
    if result.command:
        yield f"measured by: {result.command}"


def _measure_sizes(run: RunDirectory) -> dict[str, int]:
    entries = [entry for entry in sorted(run.path.iterdir()) if not entry.name.startswith(".")]
    return {
        entry.name: sum(file.stat().st_size for file in (entry, *entry.rglob("*")) if file.is_file())
        for entry in entries
    }


def show(run: RunDescription, json: str | None) -> None:
    """Print the description, or JSON alone for `-`."""
    out, summary, sizes = output.out(), run.summary, _measure_sizes(run.run)
    records = {"evaluations": run.evaluations, "metrics": run.metrics, "warnings": run.warnings}
    measured = {"findings": run.findings, "robustness": run.robustness, "audit": run.audit, "bytes": sizes}
    if output.present({**as_json(summary), **records, **measured}, json):
        return
    title = f": {summary.task}, {summary.algo}, seed {summary.seed}: {summary.state_text}"
    out.print(Text.assemble((summary.name, "bold"), title))
    duration = output.format_duration(summary.seconds or 0.0)
    out.print(f"{summary.steps or 0:,} steps in {duration}, started {summary.started}")
    if summary.best_return is not None:
        success = "" if summary.best_success is None else f"success {summary.best_success:.1%}, "
        out.print(f"best evaluation at step {summary.best_step:,}: {success}return {summary.best_return:.4g}")
    if isinstance(source := run.status.get("from"), dict):
        out.print(f"started from {source.get('policy')}, step {source.get('training_steps')}")
    for change in list_changes(summary):
        out.print(f"differs from the task's recipe: {change}")
    for warning in run.warnings:
        out.print(f"warning: {warning}")
    for name in ("success", "return"):
        if curve := plot(run, name):
            out.print(curve)
    _show_evaluations(run.evaluations)
    for line in () if run.robustness is None else describe_robustness(run.robustness):
        out.print(f"robustness: {line}")
    for line in () if run.audit is None else list_lines(run.audit):
        out.print(line)
    if run.audit is None and summary.best_success is not None and summary.best_success < _POOR_SUCCESS:
        out.print(f"what has it learned instead? rlctl runs show {shlex.quote(str(summary.path))} --audit")
    for line in format_findings(run.findings):
        out.print(line)
    files = "  ".join(f"{name} {format_bytes(size)}" for name, size in sizes.items())
    out.print(f"files: {files}  in {summary.path}")


def list_changes(summary: RunSummary) -> list[str]:
    """Return `reward_weights.action = -50.0 (recipe: -0.05)` for each key that differs from the task's recipe."""
    changes = []
    for key, value in summary.changes.items():
        before = ""
        if key in summary.changed_from:
            text = format_value(key, summary.changed_from[key])
            before = " (not set there)" if text == NOT_SET else f" (recipe: {text})"
        changes.append(f"{key} = {format_value(key, value)}{before}")
    return changes


def plot(run: RunDescription, name: str) -> str:
    """Draw a quantity over training steps, episodes of training as a line and evaluations as points; empty if none."""
    lines = [list_points(rows, name) for rows in (run.metrics, run.evaluations)]
    if not any(lines):
        return ""
    import plotext

    plotext.clear_figure()
    plotext.plotsize(*_PLOT_SIZE)
    plotext.title(f"{name} over steps")
    if name == "success":
        plotext.ylim(0, 1)  # plotext would need too much memory for a point far outside
        lines = [[(step, min(max(value, 0.0), 1.0)) for step, value in points] for points in lines]
    line, point = ("braille", "●") if output.is_utf8() else (".", "o")
    training, evaluations = lines
    if training:
        plotext.plot(*zip(*training, strict=True), label="training", marker=line)
    if evaluations:
        plotext.scatter(*zip(*evaluations, strict=True), label="evaluations", marker=point)
    return str(plotext.uncolorize(plotext.build()))


def _show_evaluations(rows: TableRows) -> None:
    shown = rows[-_EVALUATIONS_SHOWN:]
    if len(rows) > len(shown):
        output.out().print(f"the last {len(shown)} of {len(rows)} evaluations:")
    if not shown:
        output.out().print("no evaluation yet")
        return
    columns, cells = tabulate(shown)
    output.print_table(columns, cells, drop=[name for name in reversed(columns) if name not in _ALWAYS_SHOWN])


def tabulate(rows: TableRows) -> tuple[list[str], list[list[str]]]:
    """Return the columns that have values in a table of evaluations, and the cells of its rows."""
    columns = [name for name in (rows[0] if rows else {}) if any(row.get(name) is not None for row in rows)]
    return columns, [[_format_cell(name, row.get(name)) for name in columns] for row in rows]


def _format_cell(name: str, value: float | None) -> str:
    if value is None:
        return ""
    if name in ("steps", "episodes"):
        return f"{value:,.0f}"
    return f"{value:.1%}" if name == "success" else f"{value:.4g}"
