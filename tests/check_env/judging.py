"""Judges an environment in this process, and the cases that every rule has: one that breaks it, one that does not."""

import dataclasses
import functools
import sys
from pathlib import Path

import pybullet

from rlctl.check_env import child, families
from rlctl.check_env.bullet_worlds import connected
from rlctl.check_env.finding import RULES
from rlctl.check_env.judge import judge
from rlctl.check_env.records import Records
from rlctl.env_spec import EnvSpec

FOLDER = Path(__file__).parent


@dataclasses.dataclass(frozen=True)
class Case:
    """A mistake: what is found in an environment that makes it, and a twin that does not make it."""

    broken: str
    """`file.py:Class` in this folder, or any other task."""
    expected: frozenset[tuple[str, str]]
    """Every finding: rule and severity."""
    twin: str = "broken_envs.py:Clean"
    also_needs: tuple[str, ...] = ()
    """Experiments that find the mistake beside those that the rule needs: a library's checker."""

    @property
    def rules(self) -> tuple[str, ...]:
        return tuple(sorted(rule for rule, _ in self.expected))


def case(
    broken: str,
    *expected: tuple[str, str],
    twin: str = "broken_envs.py:Clean",
    also_needs: tuple[str, ...] = (),
) -> Case:
    return Case(broken, frozenset(expected), twin, also_needs)


def records_of(task, *experiments, seconds=families.PROCESS_S):
    """What some experiments find out, or all; each process begins with nothing that an earlier one left."""
    task = str(FOLDER / task) if ".py:" in task else task
    records = Records(task)
    for client in connected():  # of an environment that was not closed
        pybullet.disconnect(client)
    for name, process in families.PROCESSES.items():
        wanted = [each.name for each in process.experiments if not experiments or each.name in experiments]
        for module in [module for module in sys.modules if module.startswith("broken_")]:
            del sys.modules[module]
        if name == "probe":
            wanted.append("build")
        for message in child.run(name, EnvSpec(task), wanted, seconds) if wanted else ():
            records.add(message)
    return records


@functools.cache
def verdict_of(task, *rules, seconds=families.PROCESS_S, also_needs=()):
    """The verdict by some rules, from the experiments that they need; or by all."""
    needed = families.find_needs(rules) | {"build", *also_needs} if rules else ()
    verdict = judge(records_of(task, *needed, seconds=seconds), rules or tuple(RULES))
    assert verdict.crashed == {}
    return verdict


def findings(task, *rules, **settings):
    return verdict_of(task, *rules, **settings).findings


def found(task, *rules, **settings):
    return {(finding.rule, str(finding.severity)) for finding in findings(task, *rules, **settings)}


def rules_of(family):
    """The rules of a family that need no library's checker, which costs seconds."""
    return [rule for rule in RULES if rule.startswith(family) and rule in {**families.CHECKS, **families.DECIDED_BY}]


def check_case(case):
    """The mistake is found by its rules, and nothing by them in the twin. That no other rule finds anything in it is
    tested in test_all_rules.py."""
    assert found(case.broken, *case.rules, also_needs=case.also_needs) == case.expected
    assert found(case.twin, *case.rules) == set()
