import os
import subprocess
import sys

import pytest

from rlctl.checking.experiments import episodes
from rlctl.checking.rules.rl503_episodes_never_end import ENOUGH_STEPS

pytest.register_assert_rewrite("tests.checking.judging")


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items):
    """Mark what needs PyBullet, and as slow all but the first quick mistake for each rule.

    All are in test_all_rules.py, slow.
    """
    rules = set()
    for item in items:
        if item.name.startswith("test_finds_the_mistake_and_only_that"):
            case = item.callspec.params["case"]
            if case.needs_pybullet:
                item.add_marker(pytest.mark.pybullet)
            if "test_all_rules" in item.nodeid:
                continue
            if item.get_closest_marker("slow"):
                continue
            if rules.issuperset(case.rules):
                item.add_marker(pytest.mark.slow)
            rules.update(case.rules)


@pytest.fixture(autouse=True)
def _cut_endless_episodes(monkeypatch):
    """Cut episodes that do not end as soon as that is judged, by steps: how many there is time for differs."""
    monkeypatch.setattr(episodes, "ENDLESS_STEPS", ENOUGH_STEPS)
    monkeypatch.setattr(episodes, "LATER_ENDLESS_STEPS", 100)


@pytest.fixture
def busy():
    """Three processes that keep a processor busy, which this process shares with them."""
    before = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {min(before)})
    code = "print('begun', flush=True)\nwhile True: pass"
    processes = [subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE) for _ in range(3)]
    for each in processes:
        assert each.stdout.readline() == b"begun\n"
    yield processes
    os.sched_setaffinity(0, before)
    for each in processes:
        each.kill()
        each.communicate()
