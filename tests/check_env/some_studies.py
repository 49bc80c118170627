"""Judges an environment by one rule and a few studies, which is quicker than by all."""

import sys

from rlctl.check_env import studies
from rlctl.check_env.child_process import run_part
from rlctl.check_env.evidence import Evidence
from rlctl.check_env.judge import judge
from rlctl.check_env.rules.selection import find
from rlctl.env_spec import EnvSpec
from tests.check_env.judging import FOLDER


def verdict_by(task, rule, *names, seconds=studies.PART_S):
    task = str(FOLDER / task) if ".py:" in task else task
    evidence = Evidence(task)
    parts = {study.part for study in studies.STUDIES if study.name in names} | {"probe"}
    for part in studies.PARTS:
        for name in [name for name in sys.modules if name.startswith("broken_")]:
            del sys.modules[name]
        for header, arrays in run_part(part, EnvSpec(task), names, seconds) if part in parts else ():
            evidence.add(header, arrays)
    verdict = judge(evidence, [find(rule)])
    assert verdict.crashed == {}
    return verdict


def findings(task, rule, *names, seconds=studies.PART_S):
    return verdict_by(task, rule, *names, seconds=seconds).findings
