"""What a rule is, and what it finds."""

from __future__ import annotations

import dataclasses
import enum
import inspect
import re
from collections.abc import Callable, Iterable, Mapping
from typing import Any

from rlctl.check_env.evidence import Complaint, Evidence
from rlctl.check_env.studies import CHECKERS, LIVES


class Severity(enum.StrEnum):
    """How bad a finding is."""

    ERROR = "error"
    """Training on this is wrong, or fails."""
    WARNING = "warning"
    """Likely wrong."""
    INFO = "info"
    """Worth knowing."""

    @property
    def rank(self) -> int:
        """0 for the worst."""
        return list(Severity).index(self)


@dataclasses.dataclass(frozen=True)
class Finding:
    """Something that is wrong, or may be, with one environment."""

    rule: str
    severity: Severity
    name: str
    message: str
    evidence: Mapping[str, Any]
    """Numbers and names that JSON can hold: seed, episode, step, value, expected."""
    fix: str


@dataclasses.dataclass(frozen=True)
class Seen:
    """What a rule's check yields; the rule adds its id, and severity and fix where they are left out."""

    message: str
    evidence: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    severity: Severity | None = None
    fix: str | None = None


class NotJudged(Exception):
    """Raised by a check that has too little to go by; the text says why."""


class NotApplicable(Exception):
    """Raised by a check that has nothing to look at in this kind of environment; the text says why."""


Check = Callable[[Evidence], Iterable[Seen]]


@dataclasses.dataclass(frozen=True)
class Rule:
    """One thing that can be wrong with an environment."""

    id: str
    name: str
    severity: Severity
    fix: str
    meaning: str
    """What it means and why it matters."""
    check: Check
    needs: tuple[str, ...]
    """The studies whose results it reads."""
    complaints: tuple[re.Pattern[str], ...]
    """What the libraries' checkers say about the same thing."""
    only_complaints: bool
    """Whether nothing but a complaint can break it."""

    def finding(self, seen: Seen) -> Finding:
        """Return what the check saw as a finding."""
        severity = seen.severity or self.severity
        return Finding(self.id, severity, self.name, seen.message, seen.evidence, seen.fix or self.fix)

    def owns(self, complaint: Complaint) -> bool:
        """Say whether a complaint is about this."""
        return any(pattern.search(complaint.text) for pattern in self.complaints)


def rule(
    id: str,
    name: str,
    severity: Severity,
    fix: str,
    *,
    needs: Iterable[str] = LIVES,
    complaints: Iterable[str] = (),
    only_complaints: bool = False,
) -> Callable[[Check], Rule]:
    """Make a rule of a check; the check's docstring says what the rule means and why it matters."""

    def decorate(check: Check) -> Rule:
        patterns = tuple(re.compile(pattern, re.IGNORECASE) for pattern in complaints)
        meaning = inspect.getdoc(check) or ""
        studies = CHECKERS if only_complaints else tuple(needs)
        return Rule(id, name, severity, fix, meaning, check, studies, patterns, only_complaints)

    return decorate
