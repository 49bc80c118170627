"""Reports for programs: JSON (its schema is report.schema.json), SARIF 2.1.0, and annotations of GitHub Actions."""

import dataclasses
import json
import math
import os
import re
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlctl.checking.check import CheckReport
from rlctl.checking.records import Built, Records
from rlctl.checking.rule import RuleFinding, Severity
from rlctl.checking.rule_index import FAMILIES, RULES
from rlctl.checking.speed import Speed
from rlctl.environments.leaves import Leaf, name_leaf
from rlctl.errors import ArtifactError
from rlctl.storage import files, sarif
from rlctl.version import __version__

SCHEMA = Path(__file__).with_name("report.schema.json")
ELEMENTS_SHOWN = 8  # So many numbers without names get a row each; more of them share one
SARIF_LEVELS = {Severity.ERROR: "error", Severity.WARNING: "warning", Severity.INFO: "note"}
_CONTROL = re.compile(r"[\x00-\x1f\x7f]")
GITHUB_COMMANDS = SARIF_LEVELS | {Severity.INFO: "notice"}


def describe(report: CheckReport) -> dict[str, Any]:
    """Return a report as plain data."""
    verdict, records = report.verdict, report.records
    waivers = records.built.waivers if records.built else {}
    return {
        "format": "rlctl check-env 2",
        "rlctl": __version__,
        "task": report.task,
        "exit_code": report.exit_code,
        "strict": report.strict,
        "is_incomplete": report.is_incomplete,
        "findings": [_describe_finding(report, finding) for finding in verdict.findings],
        "known": [_describe_finding(report, finding) for finding in verdict.known],
        "waived": [{**_describe_finding(report, f), "reason": waivers[f.rule]} for f in verdict.waived],
        "judged": verdict.judged,
        "not_judged": [{"what": rule, "reason": why} for rule, why in verdict.not_judged.items()],
        "not_applicable": [{"rule": rule, "reason": why} for rule, why in verdict.not_applicable.items()],
        "crashed": [{"what": name, "traceback": trace} for name, trace in verdict.crashed.items()],
        "environment": _describe_environment(records),
        "speed": _describe_speed(records.facts.get("speed")),
        "episodes": len(records.role("episodes")),
        "steps": sum(trajectory.steps for trajectory in records.trajectories),
        "seconds": report.seconds,
        "budget_seconds": report.budget_s,
        "needed_budget_seconds": report.needed_budget if report.out_of_time else None,
        "experiments": {name: end.seconds for name, end in records.finished.items()},
    }


def _describe_finding(report: CheckReport, finding: RuleFinding) -> dict[str, Any]:
    file, line = report.locate(finding) or (None, None)
    return {
        "rule": finding.rule,
        "name": finding.name,
        "severity": str(finding.severity),
        "message": finding.message,
        "evidence": _make_finite(finding.evidence),
        "fix": finding.fix,
        "fingerprint": report.fingerprint(finding),
        "file": str(file) if file else None,
        "line": line,
    }


def _describe_environment(records: Records) -> dict[str, Any] | None:
    if (built := records.built) is None:
        return None
    return {
        "observation_space": built.observation_space,
        "action_space": built.action_space,
        "observations": [_make_finite(dataclasses.asdict(row)) for row in observation_rows(records)],
        "actions": [_make_finite(dataclasses.asdict(row)) for row in action_rows(records)],
        "max_steps": built.max_steps,
        "randomized": any(built.events.values()),
        "uses_pybullet": built.uses_pybullet,
        "file": built.file,
        "line": built.line,
    }


def _describe_speed(speed: Speed | None) -> Any:
    if speed is None or speed.step_s is None:
        return None
    return _make_finite({**dataclasses.asdict(speed), "steps_per_second": 1 / speed.step_s})


def _make_finite(value: Any) -> Any:
    """Return a value as JSON can hold it: infinity and NaN become text."""
    if isinstance(value, float) and not math.isfinite(value):
        return str(value)
    if isinstance(value, dict):
        return {str(key): _make_finite(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_make_finite(item) for item in value]
    return value


def to_json(report: CheckReport) -> str:
    """Return a report as JSON."""
    return _dump(describe(report))


def _dump(content: dict[str, Any]) -> str:
    return json.dumps(content, indent=2, allow_nan=False) + "\n"


def read_baseline(file: Path) -> set[str]:
    """Return the fingerprints of all findings of a JSON report; raises `ArtifactError` for another file."""
    try:
        report = files.read_json(file)
        return {finding["fingerprint"] for part in ("findings", "known") for finding in report[part]}
    except ArtifactError as error:
        raise ArtifactError(f"--baseline {error}; write one with rlctl check-env TASK --json {file}") from None
    except (KeyError, TypeError):
        raise ArtifactError(f"--baseline {file} is not a report of rlctl check-env --json") from None


@dataclasses.dataclass(frozen=True)
class Row:
    """A part of an observation or an action that has a name."""

    name: str
    size: int
    low: float  # The lowest declared bound of its numbers
    high: float
    observed: tuple[float, float] | None = None  # smallest and largest value


def observation_rows(records: Records) -> list[Row]:
    """Return the parts of the observation, in order."""
    built, rows = records.built, []
    for index, leaf in enumerate(built.leaves if built else ()):
        if built is not None and leaf.supported and 0 not in leaf.shape:
            values = [episode.observations[index].rows for episode in records.alone if index in episode.observations]
            rows += [_row(name, leaf, part, values) for name, part in _parts(built, leaf).items()]
    return rows


def action_rows(records: Records) -> list[Row]:
    """Return the parts of the action, in order, without the values that were played: a learner plays others."""
    leaves = records.built.action_leaves if records.built else []
    named = [(name_leaf(leaf, "action"), leaf) for leaf in leaves if leaf.supported and 0 not in leaf.shape]
    return [_row(name, leaf, slice(None), []) for name, leaf in named]


def _parts(built: Built, leaf: Leaf) -> dict[str, slice]:
    size = int(np.prod(leaf.shape))
    if leaf.path or not leaf.shape or size > ELEMENTS_SHOWN:
        return built.parts or {name_leaf(leaf): slice(0, size)}
    return built.parts or {built.element(0, i): slice(i, i + 1) for i in range(size)}


def _row(name: str, leaf: Leaf, part: slice, values: list[NDArray[np.float64]]) -> Row:
    low, high = (bound[part] for bound in leaf.flat_bounds)
    with np.errstate(invalid="ignore"):
        ends = [(value[:, part].min(), value[:, part].max()) for value in values if value.size]
        observed = (float(np.min(ends)), float(np.max(ends))) if ends else None
    return Row(name, low.size, float(low.min()), float(high.max()), observed)


def to_sarif(report: CheckReport) -> str:
    """Return a report as SARIF, which code scanning services read."""
    verdict, built = report.verdict, report.records.built
    known = {finding.rule for finding in (*verdict.findings, *verdict.waived, *verdict.known)}
    rules = [rule for rule in RULES if rule in known]
    results = [_describe_result(report, finding, rules) for finding in verdict.findings]
    results += [{**_describe_result(report, f, rules), "baselineState": "unchanged"} for f in verdict.known]
    for finding in verdict.waived:
        suppression = {"kind": "inSource", "justification": built.waivers[finding.rule] if built else ""}
        results.append({**_describe_result(report, finding, rules), "suppressions": [suppression]})
    notes = [("error", f"{name} crashed:\n{trace}") for name, trace in verdict.crashed.items()]
    if report.advice:
        notes.append(("error" if report.fails_for_time else "warning", report.advice))
    notes += [("note", f"{name} not judged: {reason}") for name, reason in verdict.not_judged.items()]
    notifications = [{"level": level, "message": {"text": text}} for level, text in notes]
    invocation = {"executionSuccessful": not verdict.crashed, "exitCode": report.exit_code}
    driver = {"name": "rlctl", "version": __version__, "rules": [_describe_rule(rule) for rule in rules]}
    run = {
        "tool": {"driver": driver},
        "automationDetails": {"id": f"rlctl/{report.task}/"},  # services keep one result of an upload with equal ids
        "invocations": [{**invocation, "toolExecutionNotifications": notifications}],
        "originalUriBaseIds": {"SRCROOT": {"uri": Path.cwd().as_uri() + "/"}},
        "results": results,
    }
    return _dump(sarif.make_log(run))


def _describe_rule(id: str) -> dict[str, Any]:
    rule = RULES[id]
    return {
        "id": id,
        "name": "".join(word.capitalize() for word in rule.name.replace("(", " ").replace(")", " ").split()),
        "shortDescription": {"text": rule.name},
        "fullDescription": {"text": rule.meaning},
        "help": {"text": rule.fix},
        "defaultConfiguration": {"level": SARIF_LEVELS[rule.severity]},
        "properties": {"tags": [FAMILIES[id[:3]]]},
    }


def _describe_result(report: CheckReport, finding: RuleFinding, rules: list[str]) -> dict[str, Any]:
    result: dict[str, Any] = {
        "ruleId": finding.rule,
        "ruleIndex": rules.index(finding.rule),
        "level": SARIF_LEVELS[finding.severity],
        "message": {"text": f"{finding.message}\nfix: {finding.fix}"},
        "partialFingerprints": {"rlctl/v1": report.fingerprint(finding)},
        "properties": {"task": report.task, "evidence": _make_finite(finding.evidence)},
    }
    if (place := report.locate(finding)) is not None:
        file, root = place[0].resolve(), Path.cwd()
        artifact = {"uri": file.as_uri()}
        if file.is_relative_to(root):
            artifact = {"uri": file.relative_to(root).as_posix(), "uriBaseId": "SRCROOT"}
        location = {"artifactLocation": artifact, "region": {"startLine": place[1]}}
        result["locations"] = [{"physicalLocation": location}]
    return result


def to_annotations(report: CheckReport) -> str:
    """Return a report as workflow commands of GitHub Actions, which show findings next to the code."""
    lines = []
    for finding in report.verdict.findings:
        title = _escape_property(f"{finding.rule} {finding.name}")
        message = _escape_data(f"{finding.message}\nfix: {finding.fix}")
        command = f"::{GITHUB_COMMANDS[finding.severity]} {_annotate_place(report, finding)}"
        lines.append(f"{command}title={title}::{message}")
    lines += [f"::error title={name} crashed::a bug in rlctl" for name in report.verdict.crashed]
    if cut := report.out_of_time:
        severity = "error" if report.fails_for_time else "warning"
        advice = f"time ran out for {', '.join(cut)}: --budget {report.needed_budget}"
        lines.append(f"::{severity} title={len(cut)} rules not judged::{advice}")
    return "\n".join([*lines, report.summarize()]) + "\n"


def _annotate_place(report: CheckReport, finding: RuleFinding) -> str:
    # Only files of the repository can be annotated.
    root = Path(os.environ.get("GITHUB_WORKSPACE", Path.cwd())).resolve()
    place = report.locate(finding)
    if place is None or not place[0].resolve().is_relative_to(root):
        return ""
    return f"file={_escape_property(place[0].resolve().relative_to(root).as_posix())},line={place[1]},"


def _escape_data(text: str) -> str:
    escaped = text.replace("%", "%25").replace("\r", "%0D").replace("\n", "%0A")
    return _CONTROL.sub("?", escaped)


def _escape_property(text: str) -> str:
    return _escape_data(text).replace(":", "%3A").replace(",", "%2C")
