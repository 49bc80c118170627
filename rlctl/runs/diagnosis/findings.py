"""Findings of a training, from its run folder: Q1 to Q14, each with its evidence and what to try.

A single sign proves little: in a perfect training of `reach`, three of four updates have `approx_kl > 0.03`. So a
finding is a combination of signs; `findings.yaml` has the combinations and all texts.
"""

import dataclasses
import enum
import functools
import inspect
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import yaml

from rlctl.errors import UsageError, check_name
from rlctl.recipe.hyperparameters import ON_POLICY
from rlctl.runs.diagnosis import episode_signs, record_signs, signs
from rlctl.runs.diagnosis.history import RunHistory
from rlctl.runs.directory import RunDirectory

_NOT = "not "
_FAR_OUT = 5.0
"""Factor outside of its usual range from which a hyperparameter is the first suspect."""


class Grade(enum.StrEnum):
    """How bad a finding is."""

    WARNING = "warning"  # the training is very likely wrong
    INFO = "info"  # worth knowing


@dataclasses.dataclass(frozen=True)
class Setting:
    """A hyperparameter that may need another value."""

    name: str
    value: Any  # the value in the recipe, or SB3's default
    advice: str  # its usual range and value, and what raising and lowering it does


@dataclasses.dataclass(frozen=True)
class Finding:
    """A problem that the records of a training show."""

    id: str  # Q1 to Q14
    name: str
    grade: Grade
    evidence: list[str]  # the numbers that show it
    meaning: str
    advice: list[str]
    settings: list[Setting]

    @property
    def line(self) -> str:
        """The finding in a line."""
        return f"{self.grade}: {self.id} {self.name}: {'; '.join(self.evidence)}"


@functools.cache
def _texts() -> dict[str, Any]:
    loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)  # ten times faster, where PyYAML has it
    text = Path(__file__).with_name("findings.yaml").read_text(encoding="utf-8")
    return yaml.load(text, loader)  # noqa: S506


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
    texts = _texts()["findings"]
    specific = [text for text in texts if not text.get("alone")]
    findings = [finding for text in specific if (finding := _check(text, read_sign, history)) is not None]
    if all(finding.grade != Grade.WARNING for finding in findings):
        general = [text for text in texts if text.get("alone")]
        findings += [finding for text in general if (finding := _check(text, read_sign, history)) is not None]
    return sorted(findings, key=lambda finding: list(Grade).index(finding.grade))


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
        settings=_settings(text["settings"], history),
    )


def _settings(names: Iterable[str], history: RunHistory) -> list[Setting]:
    """Return the hyperparameters that the algorithm has, those that are farthest out of their usual range first."""
    settings = []
    for name in names:
        row = _texts()["settings"][name]
        if name not in history.parameters or (row.get("on_policy") and history.recipe.get("algo") not in ON_POLICY):
            continue
        value = history.parameters[name]
        factor = _count_times_out(value, row["range"])
        advice = f"usually {row['range']}, often {row['common']}; raise: {row['raise']}; lower: {row['lower']}"
        if factor >= _FAR_OUT:
            advice = f"{factor:.0f} times out of its usual range; {advice}"
        settings.append((factor, Setting(name, value, advice)))
    ordered = sorted(settings, key=lambda pair: -pair[0] if pair[0] >= _FAR_OUT else 0.0)
    return [setting for _, setting in ordered]


def _count_times_out(value: object, usual: str) -> float:
    """Return by what factor a value is above or below the range `LOW to HIGH`; 1 inside."""
    low, high = (float(end) for end in usual.split(" to "))
    number = record_signs.read_first_value(value)
    if number is None or number <= 0:
        return 1.0
    return max(1.0, number / high, low / number)


def explain(code: str) -> list[str]:
    """Return what the findings of an id (`Q10`) mean, and what to try; raises `UsageError` for an unknown id."""
    findings = _texts()["findings"]
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


def format_end(findings: Sequence[Finding], run: str) -> list[str]:
    """Return the lines at the end of a training: warnings in full, other findings in one line."""
    warnings = [finding for finding in findings if finding.grade == Grade.WARNING]
    others = [f"{finding.id} {finding.name}" for finding in findings if finding.grade != Grade.WARNING]
    lines = [line for finding in warnings for line in format_finding(finding)]
    return [*lines, f"also noted: {', '.join(others)}; details: rlctl runs show {run}"] if others else lines
