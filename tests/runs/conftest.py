"""Run folders as a training leaves them, without the training."""

import fcntl
import json
import os

import pytest

from rlctl.runs.directory import RunDirectory

METRICS = "steps,seconds,return,success\n"
EVALS = "steps,seconds,episodes,success,return\n"


@pytest.fixture
def write_run(tmp_path, monkeypatch):
    """Write a run folder below runs/ of the current folder, which is `tmp_path`."""
    monkeypatch.chdir(tmp_path)

    def write(name, status="finished", evals=((1000, 0.5, 1.0),), metrics=((500, 0.1, -1.0), (1000, 0.6, 2.0)), **more):
        folder = tmp_path / "runs" / name
        (folder / "checkpoints" / "000001000").mkdir(parents=True)
        (folder / "checkpoints" / "000001000" / "state.json").write_text("x" * 5000)
        (folder / ".lock").touch()
        (folder / "recipe.yaml").write_text("algo: ppo\n")
        content = {"status": status, "task": name.split("/")[0], "algo": "ppo", "seed": 0, "seconds": 90.0, **more}
        (folder / "run.json").write_text(json.dumps(content))
        rows = (f"{steps},{steps / 100},{value},{success}\n" for steps, success, value in metrics)
        (folder / "metrics.csv").write_text(METRICS + "".join(rows))
        shown = ((steps, "" if success is None else success, value) for steps, success, value in evals)
        rows = (f"{steps},{steps / 100},100,{success},{value}\n" for steps, success, value in shown)
        (folder / "evals.csv").write_text(EVALS + "".join(rows))
        return folder

    return write


@pytest.fixture
def hold_lock():
    """Hold the lock of a run folder, as the process that trains it does."""
    held = []

    def hold(folder):
        held.append(os.open(folder / ".lock", os.O_RDWR))
        fcntl.flock(held[-1], fcntl.LOCK_EX)

    yield hold
    for descriptor in held:
        os.close(descriptor)


@pytest.fixture
def root(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path / "runs"


@pytest.fixture
def make_run(root):
    def make(task: str, name: str, policy: str | None = "best") -> RunDirectory:
        run = RunDirectory(root / task / name)
        run.path.mkdir(parents=True)
        run.write_status({"task": task})
        if policy:
            (run.path / "policies").mkdir()
            (run.path / "policies" / f"{policy}.safetensors").write_bytes(b"")
        return run

    return make
