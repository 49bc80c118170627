import os
import time

import pytest

from rlctl.runs.train_request import TrainRequest
from tests.cluster import fake_slurm
from tests.evaluation.conftest import block_run as block_run
from tests.training.conftest import ENVS, TINY

LINE = f"{ENVS}:Line"

TOY = """
import os, pathlib, time
here = pathlib.Path(__file__).parent
with (here / "pids").open("a") as file:
    print(os.getpid(), file=file)
while not (here / "go").exists():
    time.sleep(0.05)
"""


def wait_for(condition, seconds=60):
    deadline = time.monotonic() + seconds
    while not (result := condition()):
        assert time.monotonic() < deadline
        time.sleep(0.05)
    return result


@pytest.fixture
def request_of_line(tmp_path, monkeypatch):
    """A training of a second, in a folder that is the current one."""
    monkeypatch.chdir(tmp_path)
    return TrainRequest(LINE, settings=TINY, root=tmp_path / "runs", check=False)


class Toy:
    """A task whose import waits for `go` and then fails, as there is no class: a child that imports no torch."""

    def __init__(self, folder):
        self._folder = folder
        (folder / "toy.py").write_text(TOY)
        self.task = f"{folder / 'toy.py'}:Toy"

    def read_pids(self):
        """Return the processes that have begun the import."""
        file = self._folder / "pids"
        return [int(line) for line in file.read_text().split()] if file.exists() else []

    def go(self):
        """Let all imports end."""
        (self._folder / "go").touch()


@pytest.fixture
def toy(tmp_path):
    return Toy(tmp_path)


@pytest.fixture
def slurm(tmp_path, monkeypatch):
    """A fake SLURM; returns the folder of its jobs."""
    folder = tmp_path / "slurm"
    fake_slurm.install(folder)
    monkeypatch.setenv("PATH", f"{folder / 'bin'}:{os.environ['PATH']}")
    monkeypatch.setenv("FAKE_SLURM", str(folder))
    return folder
