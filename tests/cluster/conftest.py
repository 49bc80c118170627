import os
import time

import pytest

from rlctl.run.train_request import TrainRequest
from tests.cluster import fake_slurm
from tests.evaluation.conftest import block_run as block_run
from tests.training.conftest import ENVS, TINY

LINE = f"{ENVS}:Line"


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


@pytest.fixture
def slurm(tmp_path, monkeypatch):
    """A fake SLURM; returns the folder of its jobs."""
    folder = tmp_path / "slurm"
    fake_slurm.install(folder)
    monkeypatch.setenv("PATH", f"{folder / 'bin'}:{os.environ['PATH']}")
    monkeypatch.setenv("FAKE_SLURM", str(folder))
    return folder
