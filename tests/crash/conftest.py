"""What runs trials, a core for each process of tests, and the runs that nothing interrupted."""

import collections
import itertools
import os

import pytest

from tests.crash.trials import ARGUMENTS, Trials

pytest.register_assert_rewrite("tests.crash.contract", "tests.training.comparing")

PARTS = 101
"""A test that repeats itself is in so many parts; of some the first runs with all other tests."""

ALGORITHMS = ["ppo", pytest.param("sac", marks=pytest.mark.crash)]


parts = pytest.mark.parts
"""Lets a test run in parts: it takes those of its trials whose number leaves `part` when divided by `PARTS`, or by so
many times `PARTS` as the argument says."""


def pytest_generate_tests(metafunc):
    """Make the parts of a test; those that only `make test-crash` runs are not even made where none of them is."""
    if marker := metafunc.definition.get_closest_marker("parts"):
        times = marker.args[0] if marker.args else 1
        count = 1 if "not crash" in metafunc.config.getoption("markexpr") else times * PARTS
        values = [pytest.param(part, marks=pytest.mark.crash if part else ()) for part in range(count)]
        metafunc.parametrize("part", values)


@pytest.fixture(scope="session")
def trials():
    number = int(os.environ.get("PYTEST_XDIST_WORKER", "gw0").removeprefix("gw"))
    cores = sorted(os.sched_getaffinity(0))
    return Trials(cores[number % len(cores)])


@pytest.fixture(scope="session")
def whole(trials, tmp_path_factory):
    """How an algorithm's training ends that nothing interrupts, by name."""
    ended = {}

    def get(name):
        if name not in ended:
            ended[name] = trials.run(ARGUMENTS[name], tmp_path_factory.mktemp(name))
            assert ended[name].code == 0, ended[name].stderr
        return ended[name]

    return get


@pytest.fixture
def folders(request, tmp_path):
    """Folders for trials, each a new one."""
    return _counted(request.node.user_properties, tmp_path)


def _counted(properties, folder):
    for number in itertools.count():
        properties.append(("trial", number))
        yield folder / str(number)


def pytest_terminal_summary(terminalreporter):
    """Write a table of how many trials there were, and how many survived them."""
    tried, died = collections.Counter(), collections.Counter()
    for outcome in ("passed", "failed"):
        for report in terminalreporter.stats.get(outcome, ()):
            if not report.nodeid.startswith("tests/crash/"):
                continue
            kind = report.nodeid.rpartition("/")[2].partition("[")[0]
            trials = [name for name, _ in report.user_properties].count("trial")
            tried[kind] += trials or 1  # a test that has no folders is a trial
            died[kind] += outcome == "failed"
    if not tried:
        return
    terminalreporter.section("trials")
    for kind, count in {**tried, "all": tried.total()}.items():
        survived = count - (died.total() if kind == "all" else died[kind])
        terminalreporter.write_line(f"{survived:6,} of {count:6,} survived  {kind}")
