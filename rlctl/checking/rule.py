"""What a rule is, and what it finds. The rules themselves are in the package `rules`, a file each."""

from __future__ import annotations

import dataclasses
import enum
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml


class Severity(enum.StrEnum):
    """How bad a finding is."""

    ERROR = "error"  # Training on this is wrong, or fails
    WARNING = "warning"  # Likely wrong
    INFO = "info"  # Worth knowing

    @property
    def rank(self) -> int:
        """0 for the worst."""
        return list(Severity).index(self)


@dataclasses.dataclass(frozen=True)
class Rule:
    """One thing that can be wrong with an environment, in words. Line breaks of the texts do not matter."""

    id: str
    name: str
    severity: Severity  # Of a finding, unless the finding has another one
    meaning: str  # What it means and why it matters
    fix: str
    task_fix: str = ""  # The same for a task of rlctl; empty if it is the same
    is_about_space: bool = False  # Whether its findings are about what a space declares
    shows_one: bool = False
    """Whether a finding shows one element of all that are wrong: without a seed, another one in another run."""
    needs_instance: bool = True  # Whether nothing is judged if no instance could be built
    allows_old_gym: bool = False
    """Whether its findings follow from RL008: today's libraries cannot read or call what is written for the old gym."""

    def __post_init__(self) -> None:
        for name in ("meaning", "fix", "task_fix"):
            text = getattr(self, name) or self.fix
            object.__setattr__(self, name, " ".join(text.split()))


OF_SPACES = ("RL103", "RL106", "RL108", "RL109")  # rules about what a space declares
OF_OLD_GYM = ("RL106", "RL109", "RL207")  # which today's libraries cannot read or call: not faults of their own
OF_AN_EXAMPLE = ("RL3", "RL120", "RL406", "RL407", "RL409", "RL810", "RL811", "RL814", "RL815", "RL816", "RL820")
LOADING = ("RL0", "RL216")  # judged even if no instance could be built


def _load() -> dict[str, Rule]:
    loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)  # ten times faster, where PyYAML has it
    content = yaml.load(Path(__file__).with_name("rules.yaml").read_text(encoding="utf-8"), loader)  # noqa: S506
    rules = {}
    for key, text in content["rules"].items():
        (rule_id, severity), name = key.partition(": ")[0].split(), key.partition(": ")[2]
        meaning, fix, *task = re.split(r"\n(?:fix|task): ", text)
        more = {
            "is_about_space": rule_id in OF_SPACES,
            "shows_one": rule_id.startswith(OF_AN_EXAMPLE),
            "needs_instance": not rule_id.startswith(LOADING),
            "allows_old_gym": rule_id in OF_OLD_GYM,
        }
        rules[rule_id] = Rule(rule_id, name, Severity(severity), meaning, fix, *task, **more)  # type: ignore[arg-type]
    return rules


UNMOVED = _load()  # Rules that have no file yet, by id


@dataclasses.dataclass(init=False)
class RuleFinding:
    """Something that is wrong, or may be, with one environment."""

    rule: str  # its id
    name: str  # of the rule
    message: str
    evidence: Mapping[str, Any]  # plain data: seed, episode, step, value, expected
    severity: Severity
    fix: str
    where: tuple[str, int] | None  # File and line of the code that causes it, where they are known

    def __init__(
        self,
        rule: Rule | str,
        message: str,
        evidence: Mapping[str, Any] | None = None,
        severity: Severity | None = None,
        fix: str = "",
        where: tuple[str, int] | None = None,
    ) -> None:
        """Severity and fix are the rule's where left out."""
        rule = UNMOVED[rule] if isinstance(rule, str) else rule
        self.rule, self.name, self.message, self.evidence = rule.id, rule.name, message, evidence or {}
        self.severity, self.fix = Severity(severity or rule.severity), fix or rule.fix
        self.where = where

    def __str__(self) -> str:
        return f"{self.rule} {self.severity} ({self.name}): {self.message}"


def list_names(names: Sequence[str], most: int = 8) -> str:
    """Return some names, and how many more there are: `hip, knee and 3 more`."""
    return ", ".join(names[:most]) + (f" and {len(names) - most} more" if len(names) > most else "")


class NotJudged(Exception):
    """Raised by an experiment or a judge that has too little data to judge; the text is the reason."""


class OutOfTime(NotJudged):
    """Raised if an experiment's time ends before a comparison does."""


class NotApplicable(Exception):
    """Raised by an experiment or a judge that does not apply to this kind of environment; the text is the reason."""
