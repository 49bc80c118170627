"""Judges an environment in this process, and the cases that every rule has: one that breaks it, one that does not."""

import contextlib
import dataclasses
import functools
import itertools
import re
import sys
from collections.abc import Sequence
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest

from rlctl.checking import child
from rlctl.checking.check import judge
from rlctl.checking.experiments.expressions import BY_EXPRESSIONS, noted_episodes
from rlctl.checking.instance import Budget, Context
from rlctl.checking.progress import read_clock
from rlctl.checking.records import Records
from rlctl.checking.rule_index import EXPERIMENTS, PROCESS_S, PROCESSES, RULES, find_needs
from rlctl.environments.bullet_clients import find_clients
from rlctl.environments.spec import EnvSpec
from rlctl.task.pybullet.library import pybullet

FOLDER = Path(__file__).parent
SECONDS = 10 * PROCESS_S
"""For the experiments of a process: a slow machine judges as a fast one does."""
PYBULLET_FILES = ("broken_models.py", "broken_physics.py", "broken_robots.py")
"""All of their environments need PyBullet."""
sys.dont_write_bytecode = False  # each experiment imports its environment's file anew


@dataclasses.dataclass(frozen=True)
class Case:
    """A mistake: what is found in an environment that makes it, and a twin that does not make it.

    The class that proves a rule has the rule's code at the beginning of its name, and so has its twin, unless that is
    the twin of other rules as well.
    """

    broken: str
    """`file.py:Class` in this folder, or any other task."""
    expected: frozenset[tuple[str, str]]
    """Every finding: rule and severity."""
    twin: str = "broken_envs.py:Clean"
    pybullet: bool = False
    """Whether one of them needs PyBullet."""
    slow: bool = False
    """Whether it takes seconds."""

    @property
    def needs_pybullet(self) -> bool:
        return self.pybullet or self.broken.startswith(PYBULLET_FILES)

    @property
    def rules(self) -> tuple[str, ...]:
        return tuple(sorted(rule for rule, _ in self.expected))

    @property
    def codes(self) -> tuple[str, ...]:
        """The rules that it proves: those whose codes the name of its class begins with."""
        name = self.broken.rpartition(":")[2]
        return tuple(re.findall(r"RL\d{3}", re.match(r"(RL\d{3})*", name)[0]))


def case(broken: str, *expected: tuple[str, str], **settings: Any) -> Case:
    return Case(broken, frozenset(expected), **settings)


def mark_slow(cases: Sequence[Case]) -> list[Any]:
    """Return the cases as parameters; all but the first quick one that expects the same findings are slow."""
    quick = {case.expected: case for case in reversed(cases) if not case.slow}.values()
    return [case if case in quick else pytest.param(case, marks=pytest.mark.slow) for case in cases]


IN_PROCESSES = [
    case("broken_envs.py:RL004ExitsWhenBuilt", ("RL004", "error")),
    case("broken_envs.py:RL208Segfaults", ("RL208", "error")),
    case("broken_envs.py:RL209Hangs", ("RL209", "error")),
    case("broken_envs.py:RL211Prints", ("RL211", "warning")),
    case("broken_interface.py:RL216Gui", ("RL216", "error"), pybullet=True),
    case("broken_repeats.py:RL305HashOrder", ("RL305", "error")),
]
"""What only shows with real child processes: tested in test_processes.py, and RL216 in test_interface.py."""


def list_cases():
    """The cases of all test files; those of robots first, which show a mistake where it happens."""
    files = sorted(FOLDER.glob("test_*.py"), key=lambda file: (file.stem != "test_robots", file.stem))
    modules = [import_module(f"tests.checking.{file.stem}") for file in files if file.stem != "test_all_rules"]
    return [*itertools.chain(*(getattr(module, "CASES", []) for module in modules)), *IN_PROCESSES]


def records_of(task, *experiments):
    """What some experiments find out, or all."""
    records = Records(_path(task))
    for process, names in PROCESSES.items():
        for message in _run(task, process, [name for name in names if not experiments or name in experiments]):
            records.add(message)
    return records


def shared_records_of(task, *experiments):
    """What some experiments find out, each in a process of its own, and once for all tests: many have one twin."""
    records = Records(_path(task))
    for experiment in itertools.chain(*PROCESSES.values()):
        if experiment == "build" or (experiment in experiments and records.built):
            for message in _play(task, experiment):
                records.add(message)
    return records


@functools.cache
def _play(task, experiment):
    (process,) = [process for process, names in PROCESSES.items() if experiment in names]
    return _run(task, process, [experiment])


def _run(task, process, experiments):
    """Run experiments of a process, which begins with nothing that an earlier one left."""
    for client in find_clients():  # of an environment that was not closed
        pybullet.disconnect(client)
    for module in [module for module in sys.modules if module.rpartition(".")[2].startswith("broken_")]:
        del sys.modules[module]
    return list(run_here(process, _path(task), experiments, SECONDS)) if experiments else []


def run_here(process, task, experiments, seconds, **options):
    """Run experiments, by name, as a child process does."""
    return child.run(process, EnvSpec(task), [EXPERIMENTS[name] for name in experiments], seconds, **options)


def _path(task):
    return str(FOLDER / task) if ".py:" in task else task


def verdict_of(task, *rules):
    """The verdict by some rules, from the experiments that they need; or by all, from one process after the other."""
    records = shared_records_of(task, *find_needs(rules)) if rules else _whole(task)
    verdict = judge(records, rules or tuple(RULES))
    assert verdict.crashed == {}
    return verdict


@functools.cache
def _whole(task):
    return records_of(task)


def findings(task, *rules):
    return verdict_of(task, *rules).findings


def found(task, *rules):
    return {(finding.rule, str(finding.severity)) for finding in findings(task, *rules)}


def rules_of(family):
    """The rules of a family."""
    return [rule for rule in RULES if rule.startswith(family)]


@contextlib.contextmanager
def notes_of(task):
    """What the expressions of a task's source are worth in short episodes, which can be played again meanwhile."""
    context = Context(EnvSpec(_path(task)))
    context.budget = Budget(read_clock() + SECONDS)
    with noted_episodes(context) as notes:
        yield notes


def found_in_source(task):
    """The findings by the expressions of the source alone, by rule."""
    return {one.rule: one for one in records_of(task, "build", "expressions").facts[BY_EXPRESSIONS]}


def check_case(case):
    """The mistake is found by its rules, and nothing by them in the twin. That no other rule finds anything in it is
    tested in test_all_rules.py."""
    assert found(case.broken, *case.rules) == case.expected
    assert found(case.twin, *case.rules) == set()
