"""Run folders with a status and an empty policy, below runs/ of a temporary current folder."""

import pytest

from rlctl.run.directory import RunDirectory


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
