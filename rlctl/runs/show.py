"""`rlctl runs show`: one run: what it was trained with, its curve, its evaluations, its files."""

from __future__ import annotations

import dataclasses
import sys
from pathlib import Path
from typing import Any

from rlctl import output
from rlctl.run.directory import RunDirectory
from rlctl.run.lookup import find_run
from rlctl.run.memory import format_bytes
from rlctl.runs.diagnosis import Finding, diagnose
from rlctl.runs.diagnosis import show as diagnosis
from rlctl.runs.listing import as_json
from rlctl.runs.summary import RunSummary, evaluations, read_table, summarize

Rows = list[dict[str, float | None]]

_EVALUATIONS_SHOWN = 12
_PLOT_SIZE = (90, 13)
"""Columns and lines of a curve."""


@dataclasses.dataclass(frozen=True)
class RunDescription:
    """Everything that is shown of a run."""

    summary: RunSummary
    metrics: Rows
    evaluations: Rows
    warnings: list[str]
    findings: list[Finding]
    """What its records show."""
    source: dict[str, Any] | None
    """The policy that it began with, as `run.json` has it."""
    sizes: dict[str, int]
    """Bytes per file or folder of the run."""


def describe(text: str | None) -> RunDescription:
    """Read the run that a word stands for; raises `ArtifactError` if there is none."""
    run = find_run(text)
    return RunDescription(
        summary=summarize(run.path),
        metrics=read_table(run.metrics_file),
        evaluations=evaluations(run),
        warnings=_warnings(run),
        source=source if isinstance(source := run.status().get("from"), dict) else None,
        findings=diagnose(run),
        sizes={entry.name: _bytes(entry) for entry in sorted(run.path.iterdir()) if not entry.name.startswith(".")},
    )


def _warnings(run: RunDirectory) -> list[str]:
    status = run.status()
    counted = {
        "observations_outside": "observations outside their space",
        "observations_cast": "observations of another dtype than their space's",
        "failed_evaluations": "evaluations that failed",
    }
    found = [
        f"{count:,} {what}" for key, what in counted.items() if isinstance(count := status.get(key), int) and count
    ]
    return [*found, *([str(status["error"])] if status.get("error") else [])]


def _bytes(entry: Path) -> int:
    if entry.is_file():
        return entry.stat().st_size
    return sum(file.stat().st_size for file in entry.rglob("*") if file.is_file())


def show(run: RunDescription, json: str | None) -> None:
    """Print the description, or write it as JSON."""
    if json is not None:
        content = {**as_json(run.summary), "evaluations": run.evaluations, "metrics": run.metrics}
        found = {"warnings": run.warnings, "findings": diagnosis.as_json(run.findings)}
        output.write_result_json(json, {**content, **found, "bytes": run.sizes})
        return
    out, summary = output.out(), run.summary
    out.print(f"[bold]{summary.name}[/bold]: {summary.task}, {summary.algo}, seed {summary.seed}: {summary.state_text}")
    out.print(f"{summary.steps or 0:,} steps in {(summary.seconds or 0) / 60:.1f} minutes, started {summary.started}")
    if summary.best_return is not None:
        success = "" if summary.best_success is None else f"success {summary.best_success:.1%}, "
        out.print(f"best evaluation at step {summary.best_step:,}: {success}return {summary.best_return:.4g}")
    if run.source is not None:
        out.print(f"began with {run.source.get('policy')}, step {run.source.get('training_steps')}", markup=False)
    for key, value in summary.changes.items():
        out.print(f"differs from the task's recipe: {key} = {value}", markup=False)
    for warning in run.warnings:
        out.print(f"warning: {warning}", markup=False)
    for name in ("success", "return"):
        if curve := plot(run, name):
            out.print(curve, markup=False)
    _show_evaluations(run.evaluations)
    for finding in run.findings:
        out.print("\n".join(diagnosis.format_finding(finding)), markup=False)
    files = "  ".join(f"{name} {format_bytes(size)}" for name, size in run.sizes.items())
    out.print(f"files: {files}  in {summary.path}", markup=False)


def plot(run: RunDescription, name: str) -> str:
    """Draw a quantity over training steps, episodes of training as a line and evaluations as points; empty if none."""
    lines = [_points(rows, name) for rows in (run.metrics, run.evaluations)]
    if not any(lines):
        return ""
    import plotext

    is_utf8 = (sys.stdout.encoding or "").lower().replace("-", "") == "utf8"
    plotext.clear_figure()
    plotext.plotsize(*_PLOT_SIZE)
    plotext.title(f"{name} over steps")
    if name == "success":
        plotext.ylim(0, 1)
    for points, label, marker in zip(
        lines, ("training", "evaluations"), (("braille", "●") if is_utf8 else (".", "o")), strict=True
    ):
        if points:
            draw = plotext.plot if label == "training" else plotext.scatter
            draw(*zip(*points, strict=True), label=label, marker=marker)
    return str(plotext.uncolorize(plotext.build()))


def _points(rows: Rows, name: str) -> list[tuple[float, float]]:
    return [
        (steps, value)
        for row in rows
        if (steps := row.get("steps")) is not None and (value := row.get(name)) is not None
    ]


def _show_evaluations(rows: Rows) -> None:
    from rich.table import Table

    if not rows:
        output.out().print("no evaluation yet")
        return
    shown = rows[-_EVALUATIONS_SHOWN:]
    names = [name for name in rows[-1] if any(row.get(name) is not None for row in shown)]
    table = Table(box=None, pad_edge=False, title=None)
    for name in names:
        table.add_column(name, justify="right", header_style="bold")
    for row in shown:
        table.add_row(*(format_cell(name, row.get(name)) for name in names))
    if len(rows) > len(shown):
        output.out().print(f"the last {len(shown)} of {len(rows)} evaluations:")
    output.out().print(table)


def format_cell(name: str, value: float | None) -> str:
    """Return a value of a table of evaluations, by its column; empty for None."""
    if value is None:
        return ""
    if name in ("steps", "episodes"):
        return f"{value:,.0f}"
    return f"{value:.1%}" if name == "success" else f"{value:.4g}"
