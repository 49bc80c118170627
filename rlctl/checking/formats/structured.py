"""A report as JSON (its schema is report.schema.json), and the ranges of observations and actions."""

import dataclasses
import json
import math
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlctl.checking.check import CheckReport
from rlctl.checking.families.speed import Speed
from rlctl.checking.leaves import Leaf, name_leaf
from rlctl.checking.records import Built, Records
from rlctl.checking.rules import RuleFinding
from rlctl.errors import ArtifactError
from rlctl.storage import files
from rlctl.version import __version__

SCHEMA = Path(__file__).parent.parent / "report.schema.json"
ELEMENTS_SHOWN = 8  # So many numbers without names get a row each; more of them share one


def text(report: CheckReport) -> str:
    """Return a report as JSON text."""
    return json.dumps(content(report), indent=2, allow_nan=False) + "\n"


def content(report: CheckReport) -> dict[str, Any]:
    """Return a report as plain data."""
    verdict, records = report.verdict, report.records
    return {
        "format": "rlctl check-env 2",
        "rlctl": __version__,
        "task": report.task,
        "exit_code": report.exit_code,
        "strict": report.strict,
        "findings": [_describe(report, finding) for finding in verdict.findings],
        "known": [_describe(report, finding) for finding in verdict.known],
        "waived": [
            {**_describe(report, finding), "reason": records.built.waivers[finding.rule] if records.built else ""}
            for finding in verdict.waived
        ],
        "judged": verdict.judged,
        "not_judged": [{"what": rule, "reason": why} for rule, why in verdict.not_judged.items()],
        "not_applicable": [{"rule": rule, "reason": why} for rule, why in verdict.not_applicable.items()],
        "crashed": [{"what": name, "traceback": trace} for name, trace in verdict.crashed.items()],
        "environment": _environment(report),
        "speed": _speed(report),
        "episodes": len(records.episodes),
        "steps": sum(trajectory.steps for trajectory in records.trajectories),
        "seconds": report.seconds,
        "budget_seconds": report.budget_s,
        "experiments": {name: end.seconds for name, end in records.finished.items()},
    }


def read_baseline(file: Path) -> set[str]:
    """Return the fingerprints of all findings of a JSON report; raises `ArtifactError` for another file."""
    try:
        report = files.read_json(file)
        return {finding["fingerprint"] for part in ("findings", "known") for finding in report[part]}
    except ArtifactError as error:
        raise ArtifactError(f"--baseline {error}; write one with rlctl check-env TASK --json {file}") from None
    except (KeyError, TypeError):
        raise ArtifactError(f"--baseline {file} is no report of rlctl check-env --json") from None


def _describe(report: CheckReport, finding: RuleFinding) -> dict[str, Any]:
    file, line = report.locate(finding) or (None, None)
    return {
        "rule": finding.rule,
        "name": finding.name,
        "severity": str(finding.severity),
        "message": finding.message,
        "evidence": plain(finding.evidence),
        "fix": finding.fix,
        "fingerprint": report.fingerprint(finding),
        "file": str(file) if file else None,
        "line": line,
    }


def plain(value: Any) -> Any:
    """Return a value as JSON can hold it: infinity and NaN become text."""
    if isinstance(value, float) and not math.isfinite(value):
        return str(value)
    if isinstance(value, dict):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(item) for item in value]
    return value


def _environment(report: CheckReport) -> dict[str, Any] | None:
    built = report.records.built
    if built is None:
        return None
    return {
        "observation_space": built.observation_space,
        "action_space": built.action_space,
        "observations": [plain(dataclasses.asdict(row)) for row in observation_rows(report.records)],
        "actions": [plain(dataclasses.asdict(row)) for row in action_rows(report.records)],
        "max_steps": built.max_steps,
        "randomized": any(built.events.values()),
        "uses_pybullet": built.uses_pybullet,
        "file": built.file,
        "line": built.line,
    }


def _speed(report: CheckReport) -> Any:
    speed: Speed | None = report.records.facts.get("speed")
    if speed is None or speed.step_s is None:
        return None
    return plain({**dataclasses.asdict(speed), "steps_per_second": 1 / speed.step_s})


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
            values = [episode.observations[index].values for episode in records.alone if index in episode.observations]
            flat = [value.reshape(len(value), -1).astype(np.float64) for value in values if value.size]
            rows += [_row(name, leaf, part, flat) for name, part in _parts(built, leaf).items()]
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
    low, high = (np.ravel(np.asarray(bound, np.float64))[part] for bound in (leaf.low, leaf.high))
    with np.errstate(invalid="ignore"):
        smallest, largest = ([float(function(value[:, part])) for value in values] for function in (np.min, np.max))
    observed = (float(np.min(smallest)), float(np.max(largest))) if values else None
    return Row(name, low.size, float(low.min()), float(high.max()), observed)
