"""The report of `rlctl gate`: text, JSON, Markdown, JUnit and SARIF."""

from pathlib import Path
from typing import Any

from rlctl import output
from rlctl.checking import formats, tool_formats
from rlctl.checking.check import CheckReport
from rlctl.evaluation import report as evaluation_report
from rlctl.evaluation.eval_request import NO_GATES
from rlctl.evaluation.evaluate import Evaluation
from rlctl.exporting import report as export_report
from rlctl.gating.gate import GateReport, Result
from rlctl.runs.compare import report as comparison_report
from rlctl.runs.compare.comparison import RunComparison
from rlctl.storage import files, junit

_STYLES = {Result.PASSED: "green", Result.FAILED: "red", Result.ERROR: "red", Result.SKIPPED: "dim"}


def show_step(result: object) -> None:
    """Print the result of a step, as the command of the step does."""
    if isinstance(result, CheckReport):
        formats.show_crashes(result)
        formats.show(result, "text", None)
    elif isinstance(result, Evaluation):
        evaluation_report.show(result, None, NO_GATES)
    elif isinstance(result, RunComparison):
        comparison_report.show(result, None)
    elif isinstance(result, list):
        export_report.show(result, None)
    output.out().print()


def show(
    report: GateReport,
    json: str | None,
    junit_file: Path | None = None,
    sarif_file: Path | None = None,
    markdown_file: Path | None = None,
) -> None:
    """Write the report to the files that are given, and print it, or JSON alone for `-`."""
    if junit_file is not None:
        junit.write(junit_file, report.make_suites())
    if sarif_file is not None and report.checked is not None:
        files.write_result(sarif_file, tool_formats.to_sarif(report.checked).encode())
    if markdown_file is not None:
        files.write_result(markdown_file, to_markdown(report).encode())
    if output.present(as_json(report), json):
        return
    from rich.text import Text

    rows = []
    for step in report.steps:
        lines = step.problems or (step.summary,)
        rows.append((step.name, Text(step.result, style=_STYLES[step.result]), f"{step.seconds:.0f} s", lines[0]))
        rows += [("", Text(""), "", line) for line in lines[1:]]
    output.print_table(("gate", "", "", ""), rows, left=("gate", ""))
    output.out().print(_conclude(report))


def _conclude(report: GateReport) -> str:
    verdict = "passed" if report.exit_code == 0 else "not passed"
    return f"{verdict}: {report.policy} on {report.task}"


def to_markdown(report: GateReport) -> str:
    """Return the report as Markdown, for the page of a pull request."""
    lines = [f"**rlctl gate {_conclude(report)}**", "", "| step | result | |", "|---|---|---|"]
    for step in report.steps:
        text = "<br>".join(step.problems or (step.summary,)).replace("|", "\\|")
        lines.append(f"| {step.name} | {step.result} | {text} |")
    return "\n".join(lines) + "\n"


def as_json(report: GateReport) -> dict[str, Any]:
    """Return the report as plain data, with the JSON of each step that was taken."""
    content: dict[str, Any] = {
        "format": "rlctl gate 1",
        "exit_code": report.exit_code,
        "passed": report.exit_code == 0,
        "task": report.task,
        "policy": str(report.policy),
        "gates": vars(report.gates),
        "steps": [{**vars(step), "result": str(step.result), "problems": list(step.problems)} for step in report.steps],
    }
    if report.checked is not None:
        content["check"] = tool_formats.describe(report.checked)
    if report.evaluation is not None:
        content["eval"] = evaluation_report.as_json(report.evaluation)
    if report.comparison is not None:
        content["compare"] = comparison_report.as_json(report.comparison)
    if report.exported:
        content["export"] = [exported.as_json() for exported in report.exported]
    return content
