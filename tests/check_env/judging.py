"""Judges an environment in this process, and the cases that every rule has: one that breaks it, one that does not."""

import dataclasses
import functools
import sys
from pathlib import Path

import pybullet

from rlctl.check_env import studies
from rlctl.check_env.bullet_clients import connected
from rlctl.check_env.child_process import run_part
from rlctl.check_env.evidence import Evidence
from rlctl.check_env.judge import judge
from rlctl.env_spec import EnvSpec

FOLDER = Path(__file__).parent
PARTS = tuple(studies.PARTS)


@dataclasses.dataclass(frozen=True)
class Case:
    """A mistake: what is found in an environment that makes it, and a twin that does not make it."""

    broken: str
    """`file.py:Class` in this folder, or any other task."""
    expected: frozenset[tuple[str, str]]
    """Every finding: rule and severity."""
    twin: str = "broken_envs.py:Clean"


def case(broken: str, *expected: tuple[str, str], twin: str = "broken_envs.py:Clean") -> Case:
    return Case(broken, frozenset(expected), twin)


def evidence_of(task, parts=PARTS):
    task = str(FOLDER / task) if ".py:" in task else task
    evidence = Evidence(task)
    for client in connected():  # of an environment that was not closed
        pybullet.disconnect(client)
    for part in parts:
        # As in a new process: nothing that an earlier part left in the module.
        for name in [name for name in sys.modules if name.startswith("broken_")]:
            del sys.modules[name]
        for header, arrays in run_part(part, EnvSpec(task)):
            evidence.add(header, arrays)
    return evidence


def verdict_of(task, parts=PARTS):
    verdict = judge(evidence_of(task, parts))
    assert verdict.crashed == {}
    return verdict


@functools.cache
def found(task):
    return {(finding.rule, str(finding.severity)) for finding in verdict_of(task).findings}


def check_case(case):
    """The mistake is found, and only that; and nothing of it in the twin."""
    assert found(case.broken) == case.expected
    assert not {rule for rule, _ in found(case.twin)} & {rule for rule, _ in case.expected}
