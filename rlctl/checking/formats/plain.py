"""What a terminal shows: a report, the worst first with a block per rule, and the texts of `--list` and `--explain`."""

from __future__ import annotations

import io
import itertools
import textwrap
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rlctl import output
from rlctl.checking.check import CheckReport
from rlctl.checking.families.speed import format_speed
from rlctl.checking.formats.structured import Row, action_rows, observation_rows
from rlctl.checking.rules import FAMILIES, RULES, RuleFinding, Severity, find_rule

if TYPE_CHECKING:
    from rich.console import Console
    from rich.text import Text

STYLES = {Severity.ERROR: "bold red", Severity.WARNING: "yellow", Severity.INFO: "cyan"}
LONG = ("traceback", "last_output")  # Evidence that is text of several lines; JSON has it whole
SHOWN_LINES = 3  # of what a dying process printed
SHOWN_ITEMS = 4  # How much of a list in the evidence is shown; JSON has it whole
SHOWN_ROWS = 16  # How many parts of the observation are shown


def show(report: CheckReport) -> None:
    """Print a report to stdout."""
    _print(output.out(), report)


def text(report: CheckReport) -> str:
    """Return a report as plain text, a line for each thing."""
    from rich.console import Console

    stream = io.StringIO()
    plain: dict[str, Any] = {"markup": False, "highlight": False, "emoji": False, "soft_wrap": True}
    _print(Console(file=stream, width=1000, color_system=None, **plain), report)
    return stream.getvalue()


def summary(report: CheckReport) -> str:
    """Say in a line what was found."""
    verdict = report.verdict
    counts = Counter(finding.severity for finding in verdict.findings)
    counted = ", ".join(output.format_count(counts[s], s) for s in Severity if counts[s])
    waived = f", {len(verdict.waived)} waived" if verdict.waived else ""
    waived += f", {len(verdict.known)} known from the baseline" if verdict.known else ""
    rules = f"{output.format_count(len(verdict.judged), 'rule')} judged"
    return f"{report.task}: {counted or 'no findings'}{waived}; {rules} in {report.seconds:.1f} s"


def _print(out: Console, report: CheckReport) -> None:
    for _, findings in itertools.groupby(report.verdict.findings, key=lambda finding: (finding.severity, finding.rule)):
        _print_rule(out, list(findings))
    out.print(summary(report), style="bold" if out.is_terminal else None)
    for line in _facts(report):
        out.print(line)


def _print_rule(out: Console, findings: list[RuleFinding]) -> None:
    from rich.padding import Padding
    from rich.text import Text

    first = findings[0]
    out.print(Text(f"{first.severity} {first.rule}", STYLES[first.severity]).append(f"  {first.name}", "bold"))
    body = Text()
    for finding in findings:
        _add(body, finding)
    for fix in dict.fromkeys(finding.fix for finding in findings):
        body.append("fix: ", "green").append(f"{fix}\n")
    body.rstrip()
    if out.is_terminal:
        out.print(Padding(body, (0, 0, 1, 2)))
        return
    # Not wrapped in files and pipes: one line each is easier to search.
    out.print(Text("\n").join(Text("  ").append_text(line) for line in body.split("\n")))
    out.print()


def _add(body: Text, finding: RuleFinding) -> None:
    body.append(f"{finding.message}\n")
    for line in str(finding.evidence.get("last_output", "")).splitlines()[-SHOWN_LINES:]:
        body.append(f"  {line}\n", "dim")
    if numbers := _numbers(finding):
        body.append(f"{numbers}\n", "dim")


def _numbers(finding: RuleFinding) -> str:
    shown = {key: value for key, value in finding.evidence.items() if key not in LONG and value not in (None, [], "")}
    if finding.where is not None:
        shown["at"] = f"{Path(finding.where[0]).name}:{finding.where[1]}"
    return ", ".join(f"{key.replace('_', ' ')} {_short(value)}" for key, value in shown.items())


def _short(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, list):
        more = f" and {len(value) - SHOWN_ITEMS} more" if len(value) > SHOWN_ITEMS else ""
        return f"[{', '.join(_short(item) for item in value[:SHOWN_ITEMS])}{more}]"
    if isinstance(value, dict):
        return ", ".join(f"{key} {_short(item)}" for key, item in value.items())
    return str(value)


def _facts(report: CheckReport) -> Iterator[str]:
    verdict, built = report.verdict, report.records.built
    for rule, findings in itertools.groupby(verdict.waived, key=lambda finding: finding.rule):
        reason = built.waivers[rule] if built else ""
        yield f"waived {rule} ({'; '.join(finding.message for finding in findings)}): {reason}"
    if built is not None:
        yield f"observation {built.observation_space}"
        yield from _table(observation_rows(report.records))
        yield f"action {built.action_space}"
        if len(built.action_leaves) > 1:
            yield from _table(action_rows(report.records))
        if built.model:
            yield f"MuJoCo model {built.model}"
        yield f"speed {format_speed(report.records) or 'not measured'}"
        if built.events:
            from rlctl.environments.info import describe_randomization

            yield f"events: {describe_randomization(built.events)}"
    if verdict.crashed:
        yield f"crashed: {', '.join(verdict.crashed)}; what they would find is not known"
    if built is None:
        yield "not judged: everything else, because no instance could be built"
        return
    if verdict.not_applicable:
        yield f"does not apply: {', '.join(_families(list(verdict.not_applicable)))} (--json FILE says why)"
    reasons: dict[str, list[str]] = {}
    for name, reason in verdict.not_judged.items():
        reasons.setdefault(reason, []).append(name)
    yield from (f"not judged: {', '.join(_families(names))}: {reason}" for reason, names in reasons.items())


def _families(names: list[str]) -> list[str]:
    whole = [f for f in FAMILIES if {rule for rule in RULES if rule.startswith(f)} <= set(names)]
    return [f"{family} {FAMILIES[family]}" for family in whole] + [n for n in names if not n.startswith(tuple(whole))]


def _table(rows: list[Row]) -> Iterator[str]:
    shown = rows[:SHOWN_ROWS]
    names = [f"{row.name}{f' ({row.size})' if row.size > 1 else ''}" for row in shown]
    width = max((len(name) for name in names), default=0)
    for name, row in zip(names, shown, strict=True):
        observed = f", observed {row.observed[0] + 0.0:.4g} to {row.observed[1] + 0.0:.4g}" if row.observed else ""
        yield f"  {name:<{width}}  {row.low + 0.0:.4g} to {row.high + 0.0:.4g}{observed}"
    if len(rows) > SHOWN_ROWS:
        yield f"  and {len(rows) - SHOWN_ROWS} more"


def show_list() -> None:
    """Print every rule, by family."""
    from rich.text import Text

    out = output.out()
    for family, title in FAMILIES.items():
        out.print(Text(f"{family} {title}", "bold"))
        for rule in RULES.values():
            if rule.id.startswith(family):
                severity = Text(f"{rule.severity:<8}", STYLES[rule.severity])
                out.print(Text(f"  {rule.id}  ").append_text(severity).append(rule.name))
    counts = ", ".join(
        f"{sum(rule.severity is severity for rule in RULES.values())} {severity}s" for severity in Severity
    )
    out.print(f"{len(RULES)} rules: {counts}. rlctl check-env --explain {next(iter(RULES))} says more.")


def explain(code: str) -> None:
    """Print what a rule means, and what to do about it."""
    from rich.text import Text

    out, rule = output.out(), find_rule(code)
    out.print(Text(f"{rule.id}  {rule.name}", "bold"))
    out.print(Text(f"{rule.severity}, {FAMILIES[rule.id[:3]]}", STYLES[rule.severity]))
    out.print("\n" + textwrap.fill(rule.meaning, 100))
    out.print(f"\nfix: {textwrap.fill(rule.fix, 100)}")
    if rule.task_fix != rule.fix:
        out.print(f"in a task of rlctl: {textwrap.fill(rule.task_fix, 100)}")
    out.print(f'waive: rlctl_ignore = {{"{rule.id}": "why this is meant"}} on the class', style="dim")
