"""The two kinds of code that judge rules: experiments in child processes, and checks of what they have recorded."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Iterable, Iterator

from rlctl.checking.instance import Context
from rlctl.checking.records import ChildMessage, Records
from rlctl.checking.rules import RuleFinding

RunExperiment = Callable[[Context], Iterator[ChildMessage]]
RunCheck = Callable[[Records], Iterable[RuleFinding]]

RECORDING = ("comparisons", "episodes", "instances")
"""The experiments that record episodes for all rules: with random and other actions, alone and beside another."""


@dataclasses.dataclass(frozen=True)
class Experiment:
    """One thing to do with an environment in a child process."""

    name: str
    rules: tuple[str, ...]  # those it decides if it completes; may be empty
    share: float  # of the time of its process, relative to the others
    run: RunExperiment  # yields findings at once, so that a crash loses none


@dataclasses.dataclass(frozen=True)
class Check:
    """How the parent process judges a rule from what was recorded."""

    rule: str
    needs: tuple[str, ...]  # The experiments that record what it reads
    of_absence: bool  # it judges what never happened, so its experiments must be complete
    run: RunCheck


def experiment(name: str, *rules: str, share: float = 1.0) -> Callable[[RunExperiment], Experiment]:
    """Make an experiment of a function. It decides `rules`; see the package `families` for how."""
    return functools.partial(Experiment, name, rules, share)


def check(rule: str, *needs: str, of_absence: bool = False) -> Callable[[RunCheck], Check]:
    """Make the check of a rule of a function; by default it reads the recorded episodes."""
    return functools.partial(Check, rule, needs or RECORDING, of_absence)
