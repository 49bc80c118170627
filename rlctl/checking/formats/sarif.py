"""A report as SARIF 2.1.0, which code scanning services read.

Format: OASIS, "Static Analysis Results Interchange Format (SARIF) Version 2.1.0".
"""

import json
from pathlib import Path
from typing import Any

from rlctl.checking.check import CheckReport
from rlctl.checking.formats.structured import plain
from rlctl.checking.rules import FAMILIES, RULES, Rule, RuleFinding, Severity
from rlctl.version import __version__

LEVELS = {Severity.ERROR: "error", Severity.WARNING: "warning", Severity.INFO: "note"}
SCHEMA = "https://json.schemastore.org/sarif-2.1.0.json"


def text(report: CheckReport) -> str:
    """Return a report as SARIF."""
    verdict = report.verdict
    known = {finding.rule for finding in (*verdict.findings, *verdict.waived, *verdict.known)}
    rules = [rule for rule in RULES.values() if rule.id in known]
    numbers = {rule.id: number for number, rule in enumerate(rules)}
    waivers = report.records.built.waivers if report.records.built else {}
    results = [_result(report, finding, numbers) for finding in verdict.findings]
    results += [{**_result(report, known, numbers), "baselineState": "unchanged"} for known in verdict.known]
    for finding in verdict.waived:
        suppression = {"kind": "inSource", "justification": waivers[finding.rule]}
        results.append({**_result(report, finding, numbers), "suppressions": [suppression]})
    run = {
        "tool": {"driver": {"name": "rlctl", "version": __version__, "rules": [_rule(rule) for rule in rules]}},
        "invocations": [_invocation(report)],
        "originalUriBaseIds": {"SRCROOT": {"uri": Path.cwd().as_uri() + "/"}},
        "results": results,
    }
    return json.dumps({"$schema": SCHEMA, "version": "2.1.0", "runs": [run]}, indent=2, allow_nan=False) + "\n"


def _rule(rule: Rule) -> dict[str, Any]:
    return {
        "id": rule.id,
        "name": "".join(word.capitalize() for word in rule.name.replace("(", " ").replace(")", " ").split()),
        "shortDescription": {"text": rule.name},
        "fullDescription": {"text": rule.meaning},
        "help": {"text": rule.fix},
        "defaultConfiguration": {"level": LEVELS[rule.severity]},
        "properties": {"tags": [FAMILIES[rule.id[:3]]]},
    }


def _result(report: CheckReport, finding: RuleFinding, numbers: dict[str, int]) -> dict[str, Any]:
    result: dict[str, Any] = {
        "ruleId": finding.rule,
        "ruleIndex": numbers[finding.rule],
        "level": LEVELS[finding.severity],
        "message": {"text": f"{finding.message}\nfix: {finding.fix}"},
        "partialFingerprints": {"rlctl/v1": report.fingerprint(finding)},
        "properties": {"task": report.task, "evidence": plain(finding.evidence)},
    }
    if (place := report.locate(finding)) is not None:
        file, line = place
        location = {"artifactLocation": _artifact(file.resolve()), "region": {"startLine": line}}
        result["locations"] = [{"physicalLocation": location}]
    return result


def _artifact(file: Path) -> dict[str, str]:
    if file.is_relative_to(Path.cwd()):
        return {"uri": file.relative_to(Path.cwd()).as_posix(), "uriBaseId": "SRCROOT"}
    return {"uri": file.as_uri()}


def _invocation(report: CheckReport) -> dict[str, Any]:
    verdict = report.verdict
    notes = [("error", f"{name} crashed:\n{trace}") for name, trace in verdict.crashed.items()]
    notes += [("note", f"{name} not judged: {reason}") for name, reason in verdict.not_judged.items()]
    return {
        "executionSuccessful": not verdict.crashed,
        "exitCode": report.exit_code,
        "toolExecutionNotifications": [{"level": level, "message": {"text": text}} for level, text in notes],
    }
