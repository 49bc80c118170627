"""Rules, and what they find. Their texts are in `rules.yaml`; the code that judges them is in `families`."""

from __future__ import annotations

import dataclasses
import enum
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml

from rlctl.errors import UsageError, did_you_mean


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
    """One thing that can be wrong with an environment, in words."""

    id: str
    name: str
    severity: Severity  # Of a finding, unless the check gives it another one
    meaning: str  # What it means and why it matters
    fix: str
    task_fix: str  # The same for a task of rlctl


def _load() -> tuple[dict[str, str], dict[str, Rule]]:
    loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)  # ten times faster, where PyYAML has it
    content = yaml.load(Path(__file__).with_name("rules.yaml").read_text(encoding="utf-8"), loader)  # noqa: S506
    rules = {}
    for key, text in content["rules"].items():
        (rule_id, severity), name = key.partition(": ")[0].split(), key.partition(": ")[2]
        meaning, fix, *task = (" ".join(part.split()) for part in re.split(r"\n(?:fix|task): ", text))
        rules[rule_id] = Rule(rule_id, name, Severity(severity), meaning, fix, task[0] if task else fix)
    return content["families"], rules


FAMILIES, RULES = _load()  # The families' titles by the beginning of their ids, and the rules by id


@dataclasses.dataclass(init=False)
class RuleFinding:
    """Something that is wrong, or may be, with one environment."""

    rule: str
    message: str
    evidence: Mapping[str, Any]  # plain data: seed, episode, step, value, expected
    severity: Severity
    fix: str
    where: tuple[str, int] | None  # File and line of the code that causes it, where they are known

    def __init__(
        self,
        rule: str,
        message: str,
        evidence: Mapping[str, Any] | None = None,
        severity: Severity | None = None,
        fix: str = "",
        where: tuple[str, int] | None = None,
    ) -> None:
        """Severity and fix are the rule's where left out."""
        self.rule, self.message, self.evidence = rule, message, evidence or {}
        self.severity, self.fix = Severity(severity or RULES[rule].severity), fix or RULES[rule].fix
        self.where = where

    def __str__(self) -> str:
        return f"{self.rule} {self.severity} ({self.name}): {self.message}"

    @property
    def name(self) -> str:
        """The rule's name."""
        return RULES[self.rule].name


def list_names(names: Sequence[str], most: int = 8) -> str:
    """Return some names, and how many more there are: `hip, knee and 3 more`."""
    return ", ".join(names[:most]) + (f" and {len(names) - most} more" if len(names) > most else "")


class NotJudged(Exception):
    """Raised by a check or an experiment that has too little data to judge; the text is the reason."""


class OutOfTime(NotJudged):
    """Raised if an experiment's time ends before a comparison does."""


class NotApplicable(Exception):
    """Raised by a check or an experiment that does not apply to this kind of environment; the text is the reason."""


def choose_rules(select: Sequence[str] = (), ignore: Sequence[str] = ()) -> list[str]:
    """Return the ids of the rules that begin with one of `select` (all, if it is empty) and with none of `ignore`;
    raises `UsageError` if no rule begins with one of these, and if no rule is left."""
    selected, ignored = tuple(_codes(select, "--select") or FAMILIES), tuple(_codes(ignore, "--ignore"))
    rules = [rule for rule in RULES if rule.startswith(selected) and not rule.startswith(ignored)]
    if not rules:
        raise UsageError("--select and --ignore leave no rule; rlctl check-env --list shows all")
    return rules


def find_rule(code: str) -> Rule:
    """Return the rule with an id; raises `UsageError` with the closest."""
    if code.upper() in RULES:
        return RULES[code.upper()]
    family = [rule for rule in RULES if rule.startswith(code.upper())]
    hint = f" The family has: {', '.join(family)}." if family else did_you_mean(code.upper().replace("O", "0"), RULES)
    raise UsageError(f"no rule {code!r}.{hint} rlctl check-env --list shows all.")


def _codes(texts: Sequence[str], option: str) -> list[str]:
    codes = [code.strip().upper() for text in texts for code in text.split(",") if code.strip()]
    for code in codes:
        if not any(rule.startswith(code) for rule in RULES):
            closest = did_you_mean(code.replace("O", "0"), RULES) or did_you_mean(code, FAMILIES)
            raise UsageError(f"{option} {code}: no such rule.{closest} rlctl check-env --list shows all.")
    return codes
