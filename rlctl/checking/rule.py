"""What a rule is, and what it finds. The rules themselves are in the package `rules`, a file each."""

from __future__ import annotations

import dataclasses
import enum
from collections.abc import Collection, Mapping, Sequence
from typing import Any


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
    same: Collection[str]  # ids of rules: what an experiment has found for one of them shows this already

    def __init__(
        self,
        rule: Rule,
        message: str,
        evidence: Mapping[str, Any] | None = None,
        severity: Severity | None = None,
        fix: str = "",
        where: tuple[str, int] | None = None,
        same: Collection[str] = (),
    ) -> None:
        """Severity and fix are the rule's where left out."""
        self.rule, self.name, self.message, self.evidence = rule.id, rule.name, message, evidence or {}
        self.severity, self.fix = Severity(severity or rule.severity), fix or rule.fix
        self.where, self.same = where, same

    def __str__(self) -> str:
        return f"{self.rule} {self.severity} ({self.name}): {self.message}"


def list_names(names: Sequence[str], most: int = 8) -> str:
    """Return some names, and how many more there are: `hip, knee and 3 more`."""
    return ", ".join(names[:most]) + (f" and {len(names) - most} more" if len(names) > most else "")


def list_others(names: Sequence[str], most: int = 4) -> str:
    """Return all names but the first, for the end of a message about that one: ` (likewise knee, ankle)`; empty where
    there is no other."""
    return f" (likewise {list_names(names[1:], most)})" if len(names) > 1 else ""


class NotJudged(Exception):
    """Raised by an experiment or a judge that has too little data to judge; the text is the reason."""


class OutOfTime(NotJudged):
    """Raised if an experiment's time ends before a comparison does."""


class NotApplicable(Exception):
    """Raised by an experiment or a judge that does not apply to this kind of environment; the text is the reason."""
