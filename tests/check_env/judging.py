"""Judges an environment in this process, and the cases that every rule has: one that breaks it, one that does not."""

import dataclasses
import functools
import sys
from pathlib import Path

import pybullet

from rlctl.check_env import child, families
from rlctl.check_env.bullet_worlds import find_clients
from rlctl.check_env.finding import RULES
from rlctl.check_env.judge import judge
from rlctl.check_env.messages import Finished
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
    """What some experiments find out, or all."""
    records = Records(_path(task))
    for name, process in families.PROCESSES.items():
        wanted = [each.name for each in process.experiments if not experiments or each.name in experiments]
        for message in _run(task, name, wanted, seconds):
            records.add(message)
    return records


def shared_records_of(task, *experiments):
    """What some experiments find out, each in a process of its own, and once for all tests: many have one twin."""
    records = Records(_path(task))
    for experiment in families.EXPERIMENTS:
        for message in _play(task, experiment) if experiment in ("build", *experiments) else ():
            records.add(message)
    return records


@functools.cache
def _play(task, experiment):
    (process,) = [
        name for name, each in families.PROCESSES.items() if families.EXPERIMENTS[experiment] in each.experiments
    ]
    messages = _run(task, process, [experiment])
    built = [i for i, each in enumerate(messages) if isinstance(each, Finished) and each.experiment == "build"]
    return messages[built[0] + 1 :] if built and experiment != "build" else messages


def _run(task, process, experiments, seconds=families.PROCESS_S):
    """Run experiments of a process, which begins with nothing that an earlier one left."""
    for client in find_clients():  # of an environment that was not closed
        pybullet.disconnect(client)
    for module in [module for module in sys.modules if module.startswith("broken_")]:
        del sys.modules[module]
    wanted = [*(["build"] if process == "probe" else []), *experiments]
    return list(child.run(process, EnvSpec(_path(task)), wanted, seconds)) if wanted else []


def _path(task):
    return str(FOLDER / task) if ".py:" in task else task


def verdict_of(task, *rules, also_needs=()):
    """The verdict by some rules, from the experiments that they need; or by all, from one process after the other."""
    needed = {*families.find_needs(rules), *also_needs}
    records = shared_records_of(task, *needed) if rules else _whole(task)
    verdict = judge(records, rules or tuple(RULES))
    assert verdict.crashed == {}
    return verdict


@functools.cache
def _whole(task):
    return records_of(task)


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
