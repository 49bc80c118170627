"""Findings of a training, from its run folder: Q1 to Q16, each with its evidence and what to try.

A single sign proves little: in a perfect training of `reach`, three of four updates have `approx_kl > 0.03`. So a
finding is a combination of signs; `findings.yaml` has the combinations and all texts.
"""

import dataclasses
import enum
import functools
import inspect
from collections.abc import Callable, Sequence
from typing import Any

from rlctl.errors import UsageError, check_name
from rlctl.runs.diagnosis import episode_signs, record_signs, signs
from rlctl.runs.diagnosis.history import RunHistory
from rlctl.runs.diagnosis.usual_ranges import Setting, read_table
from rlctl.runs.directory import RunDirectory

_NOT = "not "
_UNUSUAL = "Q15"


class Grade(enum.StrEnum):
    """How bad a finding is."""

    WARNING = "warning"  # the training is very likely wrong
    INFO = "info"  # worth knowing


@dataclasses.dataclass(frozen=True)
class Finding:
    """A problem that the records of a training show."""

    id: str  # Q1 to Q16
    name: str
    grade: Grade
    evidence: list[str]  # the numbers that show it
    meaning: str
    advice: list[str]
    settings: list[Setting]
    follows: str = ""  # the id of another finding of the same run that probably causes this one

    @property
    def line(self) -> str:
        """The finding in a line."""
        return f"{self.grade}: {self.id} {self.name}: {'; '.join(self.evidence)}"


def _texts() -> Sequence[dict[str, Any]]:
    texts: Sequence[dict[str, Any]] = read_table("findings.yaml")["findings"]
    return texts


def list_signs() -> dict[str, signs.Sign]:
    """Return the function of every sign that `findings.yaml` may name."""
    return {
        name: function
        for module in (signs, episode_signs, record_signs)
        for name, function in inspect.getmembers(module, inspect.isfunction)
        if function.__module__ == module.__name__ and not name.startswith("_")
    }


def diagnose(run: RunDirectory | RunHistory) -> list[Finding]:
    """Return what the records of a run show, warnings first; raises `ArtifactError` for a table that is not CSV."""
    history = run if isinstance(run, RunHistory) else RunHistory(run)
    functions = list_signs()
    read_sign = functools.cache(lambda name: functions[name](history))
    texts = _texts()
    specific = [text for text in texts if not text.get("alone")]
    findings = [finding for text in specific if (finding := _check(text, read_sign, history)) is not None]
    if all(finding.grade != Grade.WARNING for finding in findings):
        general = [text for text in texts if text.get("alone")]
        findings += [finding for text in general if (finding := _check(text, read_sign, history)) is not None]
    findings = _mark_followers(_drop_unusual(findings))
    return sorted(findings, key=lambda finding: (list(Grade).index(finding.grade), bool(finding.follows)))


def _drop_unusual(findings: Sequence[Finding]) -> list[Finding]:
    """Leave `_UNUSUAL` out if a finding that explains others has all its values among its settings."""
    named = {
        setting.name
        for finding in findings
        if finding.id != _UNUSUAL and _list_explained(finding)
        for setting in finding.settings
    }
    return [
        finding
        for finding in findings
        if finding.id != _UNUSUAL or any(s.is_far_out and s.name not in named for s in finding.settings)
    ]


def _mark_followers(findings: Sequence[Finding]) -> list[Finding]:
    """Give each warning that another one probably causes the other one's id."""
    causes = {id: finding.id for finding in findings for id in _list_explained(finding)}
    return [
        dataclasses.replace(finding, follows=causes[finding.id])
        if finding.id in causes and finding.grade == Grade.WARNING
        else finding
        for finding in findings
    ]


def _list_explained(finding: Finding) -> list[str]:
    """Return the ids of the findings that this one explains."""
    return next(
        (text.get("explains", []) for text in _texts() if (text["id"], text["name"]) == (finding.id, finding.name)), []
    )


def _check(text: dict[str, Any], read_sign: Callable[[str], str | None], history: RunHistory) -> Finding | None:
    matches = [
        names
        for names in text["when"]
        if all((read_sign(name.removeprefix(_NOT)) is None) == name.startswith(_NOT) for name in names)
    ]
    if not matches:
        return None
    task = str(history.status.get("task", "TASK"))
    evidence = (read_sign(name) for names in matches for name in names if not name.startswith(_NOT))
    return Finding(
        id=text["id"],
        name=text["name"],
        grade=Grade(text["grade"]),
        evidence=list(dict.fromkeys(sign for sign in evidence if sign is not None)),
        meaning=text["meaning"],
        advice=[advice.replace("RUN", str(history.run.path)).replace("TASK", task) for advice in text["try"]],
        settings=history.list_settings(text["settings"]),
    )


def explain(code: str) -> list[str]:
    """Return what the findings of an id (`Q10`) mean, and what to try; raises `UsageError` for an unknown id."""
    findings = _texts()
    check_name(
        code.upper(), dict.fromkeys(text["id"] for text in findings), "no finding", UsageError, listed="There are"
    )
    lines = []
    for text in (text for text in findings if text["id"] == code.upper()):
        lines += [f"{text['id']} {text['name']} ({text['grade']})", f"  {text['meaning']}"]
        lines += [f"  try: {advice}" for advice in text["try"]]
        if text["settings"]:
            lines.append(f"  settings: {', '.join(text['settings'])}")
    return lines


def format_finding(finding: Finding) -> list[str]:
    """Return a finding with its evidence, its meaning and what to try."""
    settings = [
        f"  {setting.name} is {'not set' if setting.value is None else setting.value}: {setting.advice}"
        for setting in finding.settings
    ]
    return [finding.line, f"  {finding.meaning}", *(f"  try: {advice}" for advice in finding.advice), *settings]


def format_findings(findings: Sequence[Finding]) -> list[str]:
    """Return findings in full, and in a line those that probably follow from another one."""
    lines = [line for finding in findings if not finding.follows for line in format_finding(finding)]
    return [*lines, *list_followers(findings)]


def list_followers(findings: Sequence[Finding]) -> list[str]:
    """Return a line for each finding that others probably follow from."""
    followers: dict[str, list[str]] = {}
    for finding in findings:
        if finding.follows:
            followers.setdefault(finding.follows, []).append(f"{finding.id} {finding.name}")
    return [f"may follow from {cause}: {', '.join(names)}" for cause, names in followers.items()]


def format_end(findings: Sequence[Finding], run: str) -> list[str]:
    """Return the lines at the end of a training: warnings as `format_findings`, other findings in one line."""
    warnings = [finding for finding in findings if finding.grade == Grade.WARNING]
    others = [f"{finding.id} {finding.name}" for finding in findings if finding.grade != Grade.WARNING]
    lines = format_findings(warnings)
    return [*lines, f"also noted: {', '.join(others)}; details: rlctl runs show {run}"] if others else lines
