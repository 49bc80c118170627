import subprocess
from pathlib import Path

import psutil
import pytest

from rlctl.environments.spec import EnvSpec
from rlctl.play.workers import Workers
from rlctl.processes import child_process
from tests import fork_server

ENVS = Path(__file__).with_name("envs.py")


@pytest.fixture
def spec():
    """Return the spec of an environment of envs.py."""

    def of(name: str, **parameters) -> EnvSpec:
        return EnvSpec(f"{ENVS}:{name}", parameters)

    return of


@pytest.fixture
def start():
    """Start workers that are closed at the end."""
    started = []

    def make(spec: EnvSpec, n_envs: int, **options) -> Workers:
        started.append(Workers(spec, n_envs, **options))
        return started[-1]

    yield make
    for workers in started:
        workers.close()


@pytest.fixture
def fresh_interpreters():
    """Start workers as a user's process does, and not as forks of a warm one."""
    child_process.start_process = subprocess.Popen
    yield
    child_process.start_process = fork_server.start


@pytest.fixture
def children():
    """Return the processes that the test has started, in that order."""
    fork_server.for_workers()
    before = set(psutil.Process().children())
    return lambda: [child for child in psutil.Process().children() if child not in before]
