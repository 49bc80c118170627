"""Shows a report: the worst first, a block per finding, and a line of what was judged; or as JSON."""

from __future__ import annotations

import sys
from collections import Counter
from typing import TYPE_CHECKING, Any

from rlctl import output
from rlctl.check_env.check import Report
from rlctl.check_env.finding import Finding, Severity

if TYPE_CHECKING:
    from rich.console import Console

STYLES = {Severity.ERROR: "bold red", Severity.WARNING: "yellow", Severity.INFO: "cyan"}
LONG = ("traceback", "last_output")
"""Evidence that is text of several lines; JSON has it whole."""
SHOWN_LINES = 3
"""How much of what a dying process printed is shown; a traceback's place is in the message."""


def show(report: Report, json: str | None) -> None:
    """Print a report, or write it as JSON to a file or, for `-`, to stdout."""
    for rule, trace in report.verdict.crashed.items():
        print(f"{rule} crashed, a bug in rlctl:\n{trace}", file=sys.stderr)
    if json is not None:
        output.write_result_json(json, as_json(report))
        return
    out = output.out()
    for finding in report.verdict.findings:
        _print(out, finding)
    for line in _summary(report):
        out.print(line, markup=False)


def as_json(report: Report) -> dict[str, Any]:
    """Return a report as plain data."""
    built = report.evidence.built
    return {
        "task": report.task,
        "findings": [_finding_json(each) for each in report.verdict.findings],
        "judged": report.verdict.judged,
        "not_judged": [{"rule": rule, "reason": why} for rule, why in report.verdict.not_judged.items()],
        "crashed": [{"rule": rule, "traceback": trace} for rule, trace in report.verdict.crashed.items()],
        "steps_per_second": report.steps_per_second,
        "reset_ms": report.reset_ms,
        "episodes": len(report.evidence.episodes),
        "steps": sum(each.steps for each in report.evidence.episodes),
        "seconds": report.seconds,
        "spaces": {"observation": built.observation_space, "action": built.action_space} if built else None,
        "exit_code": report.exit_code,
    }


def _finding_json(finding: Finding) -> dict[str, Any]:
    return {
        "rule": finding.rule,
        "name": finding.name,
        "severity": str(finding.severity),
        "message": finding.message,
        "evidence": {key: _json_value(value) for key, value in finding.evidence.items()},
        "fix": finding.fix,
    }


def _json_value(value: Any) -> Any:
    """JSON has no infinity and no NaN."""
    if isinstance(value, float) and value - value != 0:
        return str(value)
    if isinstance(value, list):
        return [_json_value(each) for each in value]
    return value


def _print(out: Console, finding: Finding) -> None:
    from rich.padding import Padding
    from rich.text import Text

    head = Text(f"{finding.severity} {finding.rule}", STYLES[finding.severity])
    out.print(head.append(f"  {finding.name}", "bold"))
    body = Text(f"{finding.message}\n")
    for line in str(finding.evidence.get("last_output", "")).splitlines()[-SHOWN_LINES:]:
        body.append(f"  {line}\n", "dim")
    if numbers := _numbers(finding):
        body.append(f"{numbers}\n", "dim")
    body.append("fix: ", "green").append(finding.fix)
    if out.is_terminal:
        out.print(Padding(body, (0, 0, 1, 2)))
        return
    # Lines are not wrapped where nobody looks at them: one line each is easier to search.
    out.print(Text("\n").join(Text("  ").append_text(line) for line in body.split("\n")))
    out.print()


def _numbers(finding: Finding) -> str:
    shown = {key: value for key, value in finding.evidence.items() if key not in LONG and value is not None}
    return ", ".join(f"{key.replace('_', ' ')} {_short(value)}" for key, value in shown.items())


def _short(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, list):
        return f"[{', '.join(_short(each) for each in value)}]"
    if isinstance(value, dict):
        return ", ".join(f"{key} {_short(each)}" for key, each in value.items())
    return str(value)


def _summary(report: Report) -> list[str]:
    verdict, built = report.verdict, report.evidence.built
    counts = Counter(finding.severity for finding in verdict.findings)
    found = ", ".join(f"{counts[s]} {s}{'s' if counts[s] != 1 else ''}" for s in Severity if counts[s])
    rules = f"{len(verdict.judged)} rules judged"
    lines = [f"{report.task}: {found or 'no findings'}; {rules} in {report.seconds:.1f} s"]
    if built:
        lines.append(f"observation {built.observation_space}, action {built.action_space}; {_speed(report)}")
    if verdict.crashed:
        lines.append(f"crashed: {', '.join(verdict.crashed)}; what they would find is not known")
    if built is None:
        return [*lines, "not judged: everything else, because no instance could be built"]
    reasons: dict[str, list[str]] = {}
    for name, reason in verdict.not_judged.items():
        reasons.setdefault(reason, []).append(name)
    return lines + [f"not judged: {', '.join(names)}: {reason}" for reason, names in reasons.items()]


def _speed(report: Report) -> str:
    episodes = report.evidence.episodes
    if not episodes or report.steps_per_second is None or report.reset_ms is None:
        return "no step was taken"
    steps = sum(each.steps for each in episodes)
    return (
        f"{steps:,} steps in {len(episodes)} episodes at {report.steps_per_second:,.0f} steps/s, "
        f"reset {report.reset_ms:.3g} ms"
    )
