"""Every case of the other files by all rules: no rule but the expected finds anything. Half an hour; hence slow.

That its own rules find nothing in its twin is for the other files: all rules there would take as long again.
"""

from importlib import import_module

import pytest

from tests.checking.judging import FOLDER, PYBULLET_FILES, found

MODULES = [import_module(f"tests.checking.{file.stem}") for file in sorted(FOLDER.glob("test_*.py"))]
CASES = [case for module in MODULES for case in getattr(module, "CASES", [])]
CLEAN = [
    pytest.param(task, marks=pytest.mark.pybullet if task.startswith(PYBULLET_FILES) else ())
    for module in MODULES
    for task in getattr(module, "CLEAN", [])
]

# A number in other units than the rest is on another scale, too: one message for a table, one for a network.
CONSEQUENCES = {"RL119": {("RL118", "info")}}

pytestmark = pytest.mark.slow


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.broken)
def test_finds_the_mistake_and_only_that(case):
    consequences = {one for rule in case.rules for one in CONSEQUENCES.get(rule, ())}
    assert found(case.broken) - consequences == case.expected - consequences


@pytest.mark.parametrize("task", CLEAN)
def test_clean_is_clean(task):
    assert found(task) == set()
