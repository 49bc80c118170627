"""What a rule says, what it finds, and how: by experiments in a child process, and checks of what these recorded.

The texts of the rules are data, in rules.yaml beside this module.
"""

from __future__ import annotations

import dataclasses
import enum
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import yaml

from rlctl.errors import UsageError, did_you_mean

if TYPE_CHECKING:
    from rlctl.checking.instance import Context
    from rlctl.checking.messages import Message
    from rlctl.checking.records import Records


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
class Rule:
    """One thing that can be wrong with an environment, in words."""

    id: str
    name: str
    severity: Severity
    """Of a finding, unless the check gives it another one."""
    meaning: str
    """What it means and why it matters."""
    fix: str


def _load() -> tuple[dict[str, str], dict[str, Rule]]:
    loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)  # ten times faster, where PyYAML has it
    content = yaml.load(Path(__file__).with_name("rules.yaml").read_text(encoding="utf-8"), loader)  # noqa: S506
    rules = [Rule(**{**text, "severity": Severity(text["severity"])}) for text in content["rules"]]
    return content["families"], {rule.id: rule for rule in rules}


FAMILIES, RULES = _load()
"""The families' titles by the beginning of their ids, and the rules by id."""


@dataclasses.dataclass(init=False)
class Finding:
    """Something that is wrong, or may be, with one environment."""

    rule: str
    message: str
    evidence: Mapping[str, Any]
    """Numbers and names that JSON can hold: seed, episode, step, value, expected."""
    severity: Severity
    fix: str

    def __init__(
        self,
        rule: str,
        message: str,
        evidence: Mapping[str, Any] | None = None,
        severity: Severity | None = None,
        fix: str = "",
    ) -> None:
        """Severity and fix are the rule's where left out."""
        self.rule, self.message, self.evidence = rule, message, evidence or {}
        self.severity, self.fix = Severity(severity or RULES[rule].severity), fix or RULES[rule].fix

    @property
    def name(self) -> str:
        """The rule's name."""
        return RULES[self.rule].name


RECORDING = ("comparisons", "episodes", "instances")
"""The experiments that record episodes for all rules: with random and other actions, alone and beside another."""


@dataclasses.dataclass(frozen=True)
class Experiment:
    """One thing to do with an environment in a child process."""

    name: str
    run: Callable[[Context], Iterator[Message]]
    """Yields what it finds, each as soon as it is known, so that what comes before a crash is not lost."""
    rules: tuple[str, ...]
    """Those it decides: they are judged if it comes to its end. Empty for one that only records."""
    share: float
    """Its part of the time there is, relative to the other experiments of the same process."""


@dataclasses.dataclass(frozen=True)
class Check:
    """How the parent process judges a rule from what was recorded."""

    rule: str
    run: Callable[[Records], Iterable[Finding]]
    needs: tuple[str, ...]
    """The experiments that record what it reads."""


def experiment(
    name: str, *rules: str, share: float = 1.0
) -> Callable[[Callable[[Context], Iterator[Message]]], Experiment]:
    """Make an experiment of a function. It decides `rules`; see the package `families` for how."""

    def decorate(run: Callable[[Context], Iterator[Message]]) -> Experiment:
        assert all(rule in RULES for rule in rules)
        return Experiment(name, run, rules, share)

    return decorate


def check(rule: str, *needs: str) -> Callable[[Callable[[Records], Iterable[Finding]]], Check]:
    """Make the check of a rule of a function; by default it reads the recorded episodes."""

    def decorate(run: Callable[[Records], Iterable[Finding]]) -> Check:
        assert rule in RULES
        return Check(rule, run, needs or RECORDING)

    return decorate


def list_names(names: Sequence[str], most: int) -> str:
    """Return some names, and how many more there are: `hip, knee and 3 more`."""
    return ", ".join(names[:most]) + (f" and {len(names) - most} more" if len(names) > most else "")


class NotJudged(Exception):
    """Raised by a check or an experiment that has too little to go by; the text says why."""


class NotApplicable(Exception):
    """Raised by a check or an experiment that has nothing to look at in this kind of environment; the text says why."""


def choose_rules(select: Sequence[str] = (), ignore: Sequence[str] = ()) -> list[str]:
    """Return the ids of the rules that begin with one of `select` (all, if it is empty) and with none of `ignore`.

    Raises `UsageError` for what no rule's id begins with, and where nothing is left.
    """
    selected, ignored = _codes(select, "--select"), _codes(ignore, "--ignore")
    rules = [rule for rule in RULES if rule.startswith(tuple(selected or FAMILIES))]
    rules = [rule for rule in rules if not rule.startswith(tuple(ignored))]
    if not rules:
        raise UsageError("--select and --ignore leave no rule; rlctl check-env --list shows all")
    return rules


def find_rule(code: str) -> Rule:
    """Return the rule with an id or a name; raises `UsageError` with the closest."""
    for rule in RULES.values():
        if code.upper() == rule.id or code == rule.name:
            return rule
    family = [rule for rule in RULES if rule.startswith(code.upper())]
    hint = f" The family has: {', '.join(family)}." if family else did_you_mean(code.upper(), RULES)
    raise UsageError(f"no rule {code!r}.{hint} rlctl check-env --list shows all.")


def _codes(texts: Sequence[str], option: str) -> list[str]:
    codes = [code.strip().upper() for text in texts for code in text.split(",") if code.strip()]
    for code in codes:
        if not any(rule.startswith(code) for rule in RULES):
            closest = did_you_mean(code, RULES) or did_you_mean(code, FAMILIES)
            raise UsageError(f"{option} {code}: no such rule.{closest} rlctl check-env --list shows all.")
    return codes
