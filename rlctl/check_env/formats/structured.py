"""A report as JSON; its schema is report.schema.json beside the package's modules."""

from __future__ import annotations

import dataclasses
import json
import math
from pathlib import Path
from typing import Any

from rlctl import __version__
from rlctl.check_env.check import Report
from rlctl.check_env.families.speed import Speed
from rlctl.check_env.finding import Finding
from rlctl.check_env.formats.ranges import Row, action_rows, observation_rows

SCHEMA = Path(__file__).parent.parent / "report.schema.json"


def text(report: Report) -> str:
    """Return a report as JSON text."""
    return json.dumps(content(report), indent=2, allow_nan=False) + "\n"


def content(report: Report) -> dict[str, Any]:
    """Return a report as plain data."""
    verdict, records = report.verdict, report.records
    return {
        "format": "rlctl check-env 1",
        "rlctl": __version__,
        "task": report.task,
        "exit_code": report.exit_code,
        "strict": report.strict,
        "findings": [finding_json(each) for each in verdict.findings],
        "waived": [
            {**finding_json(each), "reason": records.built.waivers[each.rule] if records.built else ""}
            for each in verdict.waived
        ],
        "judged": verdict.judged,
        "not_judged": [{"what": rule, "reason": why} for rule, why in verdict.not_judged.items()],
        "not_applicable": [{"rule": rule, "reason": why} for rule, why in verdict.not_applicable.items()],
        "crashed": [{"what": name, "traceback": trace} for name, trace in verdict.crashed.items()],
        "environment": _environment(report),
        "speed": _speed(report),
        "episodes": len(records.episodes),
        "steps": sum(each.steps for each in records.trajectories),
        "seconds": report.seconds,
        "budget_seconds": report.budget_s,
        "experiments": records.seconds,
    }


def finding_json(finding: Finding) -> dict[str, Any]:
    """Return a finding as plain data."""
    return {
        "rule": finding.rule,
        "name": finding.name,
        "severity": str(finding.severity),
        "message": finding.message,
        "evidence": plain(finding.evidence),
        "fix": finding.fix,
    }


def plain(value: Any) -> Any:
    """Return a value as JSON can hold it: infinity and NaN become text."""
    if isinstance(value, float) and not math.isfinite(value):
        return str(value)
    if isinstance(value, dict):
        return {str(key): plain(each) for key, each in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(each) for each in value]
    return value


def _environment(report: Report) -> dict[str, Any] | None:
    built = report.records.built
    if built is None:
        return None
    return {
        "observation_space": built.observation_space,
        "action_space": built.action_space,
        "observations": [_row(row) for row in observation_rows(report.records)],
        "actions": [_row(row) for row in action_rows(report.records)],
        "max_steps": built.max_steps,
        "randomized": any(built.events.values()),
        "uses_pybullet": built.uses_pybullet,
        "file": built.file,
        "line": built.line,
    }


def _speed(report: Report) -> Any:
    """What one process does; null where no step could be timed."""
    speed: Speed | None = report.records.facts.get("speed")
    if speed is None or speed.step_s is None:
        return None
    return plain({**dataclasses.asdict(speed), "steps_per_second": 1 / speed.step_s})


def _row(row: Row) -> Any:
    return plain(dataclasses.asdict(row))
