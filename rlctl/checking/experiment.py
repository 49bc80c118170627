"""The code that judges rules: experiments in child processes, and judges of what they have recorded.

How a rule uses them is in the package `rules`; experiments that several rules share are in `experiments`.
"""

from __future__ import annotations

import dataclasses
import importlib
from collections.abc import Callable, Iterable, Iterator
from typing import Any, Generic, TypeVar

from rlctl.checking.instance import Context
from rlctl.checking.records import ChildMessage, Records
from rlctl.checking.rule import Rule, RuleFinding

RunExperiment = Callable[[Context], Iterator[ChildMessage]]
JudgeRecords = Callable[[Records], Iterable[RuleFinding]]
Shown = TypeVar("Shown")
Value = TypeVar("Value")

RECORDING = ("comparisons", "episodes", "instances")
"""The experiments that record episodes for all rules: with random and other actions, alone and beside another."""
PROBE, INSTANCES = "probe", "instances"
"""The child processes: in the first, one instance is played; in the second, several instances are built."""
HASH_SEEDS = {PROBE: 0, INSTANCES: 1}  # of Python's hashes: they differ, so that a dependence on their order shows


@dataclasses.dataclass(frozen=True)
class Experiment:
    """One thing to do with an environment in a child process."""

    name: str
    process: str
    place: int  # Among the experiments of its process: important rules first, and what may crash last
    share: float  # of the time of its process, relative to the others
    run: RunExperiment  # yields findings at once, so that a crash loses none
    own_rules: tuple[str, ...]
    hooks: tuple[JudgeHook[Any], ...]
    seeds_globals: bool = False  # see `Context.seeds_globals`
    alters: bool = False  # it changes attributes or the engine's state: what then raises is no failure of its own

    @property
    def rules(self) -> tuple[str, ...]:
        """The ids of the rules that it decides if it completes; may be empty."""
        hooked = [rule for hook in self.hooks for rule in hook.decided]
        return tuple(dict.fromkeys([*self.own_rules, *hooked]))


@dataclasses.dataclass(frozen=True)
class RecordsJudge:
    """How the parent process judges a rule from what was recorded."""

    rule: str  # its id
    needs: tuple[str, ...]  # The experiments that record what it reads
    of_absence: bool  # it judges what never happened, so its experiments must be complete
    run: JudgeRecords


class JudgeHook(Generic[Shown]):
    """Where rules register their part of a shared experiment, as a decorator: `@judges_worlds(RULE)`.

    The part is a function of what the experiment shows, which yields findings, or `Skipped` with the rule's id.
    """

    def __init__(self) -> None:
        self._parts: list[tuple[int, str, Callable[[Shown], Iterable[ChildMessage]]]] = []
        self.rules: list[str] = []  # The ids of all that registered
        self.decided: list[str] = []  # The ids of the rules that the experiment decides if it completes

    def __call__(
        self, rule: Rule, *, place: int = 0, decides: bool = True
    ) -> Callable[[Callable[[Shown], Iterable[ChildMessage]]], Callable[[Shown], Iterable[ChildMessage]]]:
        """Register a part; the parts run by their places, and then by their rules."""

        def register(part: Callable[[Shown], Iterable[ChildMessage]]) -> Callable[[Shown], Iterable[ChildMessage]]:
            self._parts.append((place, rule.id, part))
            self.rules.append(rule.id)
            if decides:
                self.decided.append(rule.id)
            return part

        return register

    def judge(self, shown: Shown) -> Iterator[ChildMessage]:
        """Yield what all parts yield."""
        for _, _, part in sorted(self._parts, key=lambda entry: entry[:2]):
            yield from part(shown)


def experiment(
    name: str,
    process: str,
    place: int,
    *rules: Rule,
    share: float = 1.0,
    hooks: tuple[JudgeHook[Any], ...] = (),
    seeds_globals: bool = False,
    alters: bool = False,
) -> Callable[[RunExperiment], Experiment]:
    """Make an experiment of a function. If it completes it decides `rules`, and those that register with its hooks.

    With `seeds_globals` it compares episodes also of an environment that draws from global generators (RL309). One that
    `alters` the environment's state judges nothing where a call raises.
    """

    def make(run: RunExperiment) -> Experiment:
        own = tuple(rule.id for rule in rules)
        return Experiment(name, process, place, share, run, own, hooks, seeds_globals, alters)

    return make


def import_experiments(modules: Iterable[str]) -> dict[str, Experiment]:
    """Return the experiments that some modules define, by name; raises `ValueError` for two of one name."""
    members = (vars(importlib.import_module(module)).values() for module in modules)
    found = (value for values in members for value in list(values) if isinstance(value, Experiment))
    return index((one.name, one) for one in found)


def index(pairs: Iterable[tuple[str, Value]]) -> dict[str, Value]:
    """Return a dictionary; raises `ValueError` for what would be in it twice."""
    found: dict[str, Value] = {}
    for name, value in pairs:
        if found.setdefault(name, value) is not value:
            raise ValueError(f"{name}: two of {type(value).__name__}; one is enough")
    return found


def judges_records(rule: Rule, *needs: str, of_absence: bool = False) -> Callable[[JudgeRecords], RecordsJudge]:
    """Make the judge of a rule of a function; by default it reads the recorded episodes."""

    def make(run: JudgeRecords) -> RecordsJudge:
        return RecordsJudge(rule.id, needs or RECORDING, of_absence, run)

    return make
