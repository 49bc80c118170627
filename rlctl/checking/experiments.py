"""How rules are judged: by experiments in a child process, and by checks of what these recorded."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Iterator

from rlctl.checking.finding import RULES, RuleFinding
from rlctl.checking.instance import Context
from rlctl.checking.messages import ChildMessage
from rlctl.checking.records import Records

RECORDING = ("comparisons", "episodes", "instances")
"""The experiments that record episodes for all rules: with random and other actions, alone and beside another."""


@dataclasses.dataclass(frozen=True)
class Experiment:
    """One thing to do with an environment in a child process."""

    name: str
    run: Callable[[Context], Iterator[ChildMessage]]
    """Yields what it finds, each as soon as it is known, so that what comes before a crash is not lost."""
    rules: tuple[str, ...]
    """Those it decides: they are judged if it comes to its end. Empty for one that only records."""
    share: float
    """Its part of the time there is, relative to the other experiments of the same process."""


@dataclasses.dataclass(frozen=True)
class Check:
    """How the parent process judges a rule from what was recorded."""

    rule: str
    run: Callable[[Records], Iterable[RuleFinding]]
    needs: tuple[str, ...]
    """The experiments that record what it reads."""


def experiment(
    name: str, *rules: str, share: float = 1.0
) -> Callable[[Callable[[Context], Iterator[ChildMessage]]], Experiment]:
    """Make an experiment of a function. It decides `rules`; see the package `families` for how."""

    def decorate(run: Callable[[Context], Iterator[ChildMessage]]) -> Experiment:
        assert all(rule in RULES for rule in rules)
        return Experiment(name, run, rules, share)

    return decorate


def check(rule: str, *needs: str) -> Callable[[Callable[[Records], Iterable[RuleFinding]]], Check]:
    """Make the check of a rule of a function; by default it reads the recorded episodes."""

    def decorate(run: Callable[[Records], Iterable[RuleFinding]]) -> Check:
        assert rule in RULES
        return Check(rule, run, needs or RECORDING)

    return decorate
