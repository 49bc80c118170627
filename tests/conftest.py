"""Fixtures for all tests: the command line, how its processes start, installed plugins, and processes left behind."""

import os

# Each of the processes that run the tests has a core: threads of a library would only wait for each other.
os.environ.update(dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1"))

import collections
import contextlib
import gc
import importlib.util
import signal
import subprocess
import sys
import textwrap
from pathlib import Path

import psutil
import pytest

from rlctl.processes import child_process
from tests import fork_server

gc.disable()  # until all is collected: what is imported and collected stays
# Under nohup, or in the background of a script, what is started here would ignore these.
signal.signal(signal.SIGHUP, signal.SIG_DFL)
signal.signal(signal.SIGINT, signal.default_int_handler)
ALL_CORES = sorted(os.sched_getaffinity(0))
if name := os.environ.get("PYTEST_XDIST_WORKER"):  # so what it trains and evaluates has one worker and not one per core
    os.sched_setaffinity(0, {ALL_CORES[int(name.removeprefix("gw")) % len(ALL_CORES)]})


@pytest.hookimpl(tryfirst=True)  # before `-m` selects
def pytest_collection_modifyitems(config, items):
    _mark_slow_rows(items, is_complete=not any("[" in argument for argument in config.args))
    if importlib.util.find_spec("pybullet") is None:
        for item in items:
            if item.get_closest_marker("pybullet"):
                item.add_marker(pytest.mark.skip(reason="needs PyBullet, which is not installed"))


def _mark_slow_rows(items, is_complete):
    """Mark as slow all rows of a parametrised test but those that its `slow_except` names, which must exist, or but the
    first ones: `slow_except(first=2)`."""
    missing = set()
    found = set()
    quick = collections.Counter()
    for item in items:
        marker = item.get_closest_marker("slow_except")
        if marker is None:
            continue
        function, _, row = item.nodeid.removesuffix("]").partition("[")
        missing.update((function, name) for name in marker.args)
        found.add((function, row))
        is_first = quick[function] < marker.kwargs.get("first", 0)
        if row not in marker.args and not is_first:
            item.add_marker(pytest.mark.slow)
        elif item.get_closest_marker("slow") is None:
            quick[function] += 1
    missing -= found
    if missing and is_complete:
        raise pytest.UsageError(f"slow_except names rows that do not exist: {sorted(missing)}")


def pytest_collection_finish():
    gc.freeze()  # modules and tests stay: collections need not look through them again and again
    gc.enable()


@pytest.fixture(scope="session", autouse=True)
def _forked_workers():
    """Fork workers from a warm process, which is launched when the first is started."""
    child_process.start_process = fork_server.start
    yield
    child_process.start_process = subprocess.Popen
    fork_server.close()


@pytest.fixture(scope="session", autouse=True)
def _logs_of_sb3(tmp_path_factory):
    """Collect in one folder what models log that tests train with Stable-Baselines3 alone: a folder each."""
    os.environ["SB3_LOGDIR"] = str(tmp_path_factory.mktemp("sb3"))


@pytest.fixture
def rlctl(tmp_path):
    """Run the command line in a forked process, in `tmp_path`; `path` goes before the installed packages."""

    def run(*arguments, path=None, env=None, **options) -> subprocess.CompletedProcess:
        environment = {**os.environ, "NO_COLOR": "1", **(env or {})}
        if path is not None:
            environment["PYTHONPATH"] = str(path)
        command = [sys.executable, "-m", "rlctl", *map(str, arguments)]
        return fork_server.for_commands().run(
            command, **{"cwd": tmp_path, "timeout": 250, "env": environment, **options}
        )

    return run


@pytest.fixture
def installed_rlctl(tmp_path):
    """Run the command line as a user does, in an interpreter of its own, in `tmp_path`."""

    def run(*arguments, **options) -> subprocess.CompletedProcess:
        return subprocess.run(
            [sys.executable, "-m", "rlctl", *map(str, arguments)],
            **{"cwd": tmp_path, "capture_output": True, "text": True, "timeout": 250, **options},
        )

    return run


@pytest.fixture
def write_module(tmp_path):
    """Write a Python file into `tmp_path` and return its path."""

    def write(name: str, source: str) -> Path:
        file = tmp_path / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(textwrap.dedent(source))
        return file

    return write


@pytest.fixture
def install(tmp_path):
    """Install a distribution without pip: a folder for `sys.path` with the metadata that pip would write."""

    def installed(name: str, tasks, files: dict[str, str] | None = None, version="1.2", group="rlctl.tasks") -> Path:
        folder = tmp_path / "site"
        metadata = folder / f"{name.replace('-', '_')}-{version}.dist-info"
        metadata.mkdir(parents=True)
        (metadata / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n")
        points = "".join(f"{task} = {target}\n" for task, target in tasks.items())
        (metadata / "entry_points.txt").write_text(f"[{group}]\n{points}")
        for file, source in (files or {}).items():
            (folder / file).parent.mkdir(parents=True, exist_ok=True)
            (folder / file).write_text(textwrap.dedent(source))
        return folder

    return installed


@pytest.fixture(scope="session")
def use_cores():
    """Let this process and those that it starts use so many cores only, or all, as long as the result is entered."""

    @contextlib.contextmanager
    def limit(count=None):
        before = os.sched_getaffinity(0)
        os.sched_setaffinity(0, ALL_CORES[:count])
        try:
            yield
        finally:
            os.sched_setaffinity(0, before)

    return limit


@pytest.fixture
def no_child_left(request):
    """Fail if the test leaves a process behind."""
    fork_server.for_workers()
    if "rlctl" in request.fixturenames:
        fork_server.for_commands()
    before = set(psutil.Process().children(recursive=True))
    yield
    left = [child for child in psutil.Process().children(recursive=True) if child not in before]
    _, alive = psutil.wait_procs(left, timeout=60)
    assert alive == []
