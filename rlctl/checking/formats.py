"""Prints a report: the worst first with a block per rule, or in a format for programs; and the texts of the rules."""

import io
import itertools
import sys
import textwrap
from collections.abc import Collection, Iterator, Sequence
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.padding import Padding
from rich.text import Text

from rlctl import output
from rlctl.checking.check import CheckReport
from rlctl.checking.junit import to_junit
from rlctl.checking.records import Records
from rlctl.checking.rule import RuleFinding, Severity
from rlctl.checking.rule_index import FAMILIES, RULES, find_rule
from rlctl.checking.speed import format_speed
from rlctl.checking.tool_formats import Row, action_rows, observation_rows, to_annotations, to_json, to_sarif
from rlctl.checking.working_copy import is_own
from rlctl.environments import registry
from rlctl.environments.places import format_place
from rlctl.errors import UsageError
from rlctl.recipe.recipe_files import read
from rlctl.storage import files
from rlctl.task.events.event import describe_randomization

STYLES = {Severity.ERROR: "bold red", Severity.WARNING: "yellow", Severity.INFO: "cyan"}
SHOWN_LINES = 3  # of what a dying process printed
SHOWN_ITEMS = 4  # How much of a list in the evidence is shown; JSON has it whole
_WITH_EVENTS = "; those of the recipe act with --set randomize=true"
ABOUT_GOALS = "RL622"  # whose reason applies to the others about goals, too
GOAL_WORDS = ("goal", "target", "desired", "distance")
SHOWN_ROWS = 16  # How many parts of the observation are shown


def show(report: CheckReport, form: str, target: str | None) -> None:
    """Print a report in one of `FORMATS`, or write it to a file (`-`: stdout) and say so on stderr."""
    if target not in (None, "-"):
        files.write_result(Path(str(target)), FORMATS[form](report).encode())
        print(f"{report.summarize()}; written to {target}", file=sys.stderr)
    elif form == "text":
        print_report(output.out(), report)
    else:
        output.results().write(FORMATS[form](report))
        output.results().flush()


def pair_targets(forms: Sequence[str], targets: Sequence[str]) -> list[tuple[str, str | None]]:
    """Return each format of a report with its file, or stdout; raises `UsageError` if not one at most goes there."""
    forms = list(forms) or ["text"]
    pairs: list[tuple[str, str | None]] = list(zip(forms, [*targets, *[None] * len(forms)], strict=False))
    if len(targets) > len(forms) or sum(target in (None, "-") for _, target in pairs) > 1:
        example = " ".join(f"--format {form} -o FILE" for form in forms)
        raise UsageError(f"give each --format its -o FILE after it; one at most goes to stdout: {example}")
    return pairs


PLACED = ("github", "sarif")  # formats whose readers show only what is in a file of the repository


def show_notes(report: CheckReport, forms: Collection[str]) -> None:
    """Print to stderr whether other code than this folder's was checked, which findings have no place in it, and what
    of the baseline was not found."""
    if report.outdated:
        print(report.outdated, file=sys.stderr)
    if resolved := report.verdict.resolved:
        count = output.format_count(len(resolved), "finding")
        print(f"{count} of the baseline no longer found: {'; '.join(resolved)}; write it again", file=sys.stderr)
    places = [report.locate(finding) for finding in report.verdict.findings if set(forms) & {*PLACED}]
    if outside := [place[0] for place in places if place is not None and not is_own(place[0])]:
        count = output.format_count(len(outside), "finding")
        print(f"{count} in files outside of this folder, not shown in its code: {outside[0]}", file=sys.stderr)


def show_crashes(report: CheckReport) -> None:
    """Print the tracebacks of rules that crashed to stderr."""
    for name, trace in report.verdict.crashed.items():
        print(f"{name} crashed, a bug in rlctl:\n{trace}", file=sys.stderr)


def to_text(report: CheckReport) -> str:
    """Return a report as plain text, a line for each thing."""
    stream = io.StringIO()
    plain: dict[str, Any] = {"markup": False, "highlight": False, "emoji": False, "soft_wrap": True}
    print_report(Console(file=stream, width=1000, color_system=None, **plain), report)
    return stream.getvalue()


FORMATS = {"text": to_text, "json": to_json, "sarif": to_sarif, "junit": to_junit, "github": to_annotations}


def print_report(out: Console, report: CheckReport) -> None:
    """Print a report as text."""
    for _, findings in itertools.groupby(report.verdict.findings, key=lambda finding: (finding.severity, finding.rule)):
        _print_rule(out, list(findings))
    out.print(report.summarize(), style="bold" if out.is_terminal else None)
    for line in _facts(report):
        out.print(line)


def _print_rule(out: Console, findings: list[RuleFinding]) -> None:
    first = findings[0]
    out.print(Text(f"{first.severity} {first.rule}", STYLES[first.severity]).append(f"  {first.name}", "bold"))
    body = Text()
    for finding in findings:
        _add(body, finding)
    for fix in dict.fromkeys(finding.fix for finding in findings):
        body.append("fix: ", "green").append(f"{fix}\n")
    body.rstrip()
    # Not wrapped in files and pipes: one line each is easier to search.
    lines = [Padding(body, (0, 0, 0, 2))] if out.is_terminal else [Text("  ") + line for line in body.split("\n")]
    out.print(*lines, "", sep="\n", soft_wrap=not out.is_terminal)


def _add(body: Text, finding: RuleFinding) -> None:
    body.append(f"{finding.message}\n")
    for line in str(finding.evidence.get("last_output", "")).splitlines()[-SHOWN_LINES:]:
        body.append(f"  {line}\n", "dim")
    texts = ("traceback", "last_output")
    shown = {key: value for key, value in finding.evidence.items() if key not in texts and value not in (None, [], "")}
    if finding.where is not None:
        shown["at"] = format_place(*finding.where)
    if shown:
        body.append(", ".join(f"{key.replace('_', ' ')} {_short(value)}" for key, value in shown.items()), "dim")
        body.append("\n")


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
    waived = {finding.rule for finding in verdict.waived}
    if built is not None and (
        unused := [rule for rule in built.waivers if rule in verdict.judged and rule not in waived]
    ):
        yield f"waived without need now: {', '.join(unused)}"
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
            unchecked = "" if any(built.events.values()) or not _randomizes(report.task) else _WITH_EVENTS
            yield f"events: {describe_randomization(built.events)}{unchecked}"
    if verdict.crashed:
        yield f"crashed: {', '.join(verdict.crashed)}; their findings are unknown"
    if built is None:
        reason = "" if verdict.findings else f"; the reason: rlctl check-env {report.task} --select RL0"
        yield f"not judged: the other rules, because no instance could be built{reason}"
        return
    if verdict.not_applicable:
        yield f"does not apply: {_list_rules(list(verdict.not_applicable))} (reasons: --json FILE)"
        yield from _explain_goals(report)
    for reason in dict.fromkeys(verdict.not_judged.values()):
        names = [name for name, why in verdict.not_judged.items() if why == reason]
        yield f"not judged: {_list_rules(names)}: {reason}"
    if shortened := report.records.shortened:
        yield f"slow environment: judged on {', '.join(shortened.values())}"
    if advice := report.advice:
        yield advice


def _explain_goals(report: CheckReport) -> Iterator[str]:
    """Say why the rules about goals do not apply to an environment whose names tell that it has a goal."""
    reason = report.verdict.not_applicable.get(ABOUT_GOALS)
    if reason is not None and any(word in name.lower() for word in GOAL_WORDS for name in _list_names(report.records)):
        names = [name for name, why in report.verdict.not_applicable.items() if why == reason]
        yield f"does not apply: {_list_rules(names)}: {reason}"


def _list_names(records: Records) -> set[str]:
    """Return the names of what is observed and of the numbers in info."""
    built = records.require_built()
    keys = {str(key) for leaf in built.leaves for key in leaf.path}
    return {*keys, *built.names, *(name for episode in records.trajectories for name in episode.infos)}


def _randomizes(task: str) -> bool:
    """Return whether the recipe that comes with a task lets events act."""
    file = registry.find_recipe_file(task)
    packaged = read(file) if file else {}
    return bool(packaged.get("randomize") or packaged.get("events"))


def _list_rules(names: list[str]) -> str:
    whole = [f for f in FAMILIES if {rule for rule in RULES if rule.startswith(f)} <= set(names)]
    others = [name for name in names if not name.startswith(tuple(whole))]
    return ", ".join([*(f"{family} {FAMILIES[family]}" for family in whole), *others])


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
    out = output.out()
    for family, title in FAMILIES.items():
        out.print(Text(f"{family} {title}", "bold"))
        for rule in RULES.values():
            if rule.id.startswith(family):
                severity = Text(f"{rule.severity:<8}", STYLES[rule.severity])
                out.print(Text(f"  {rule.id}  ").append_text(severity).append(rule.name))
    counts = [f"{sum(rule.severity is severity for rule in RULES.values())} {severity}s" for severity in Severity]
    out.print(f"{len(RULES)} rules: {', '.join(counts)}. rlctl check-env --explain RL001 explains a rule.")


def explain(code: str) -> None:
    """Print what a rule means, and what to do about it."""
    out, rule = output.out(), find_rule(code)
    out.print(Text(f"{rule.id}  {rule.name}", "bold"))
    out.print(Text(f"{rule.severity}, {FAMILIES[rule.id[:3]]}", STYLES[rule.severity]))
    out.print("\n" + textwrap.fill(rule.meaning, 100))
    out.print(f"\nfix: {textwrap.fill(rule.fix, 100)}")
    if rule.task_fix != rule.fix:
        out.print(f"in a task of rlctl: {textwrap.fill(rule.task_fix, 100)}")
    out.print(f'waive: rlctl_ignore = {{"{rule.id}": "why this is meant"}} on the class', style="dim")
