"""What the shell offers after TAB."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from rlctl.arguments import complete_algorithm, complete_run, complete_task
from rlctl.recipe import recipe


def test_tasks_and_files(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "rear.py").write_text("")
    assert complete_task("rea") == ["reach", "reach-batch", "reach-sparse", "rear.py"]
    assert {"ant", "hopper", "reach"} <= set(complete_task(""))


def test_algorithms():
    assert complete_algorithm("t") == ["td3", "tqc"]
    assert tuple(complete_algorithm("")) == recipe.ALGORITHMS


def test_runs(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert complete_run("") == []
    for name in ("reach/2026-01-01_10-00-00_s0", "ant/2026-01-02_10-00-00_s0"):
        (tmp_path / "runs" / name).mkdir(parents=True)
        (tmp_path / "runs" / name / "run.json").write_text("{}")
    (tmp_path / "mine.onnx").write_bytes(b"")
    newest, oldest = "runs/ant/2026-01-02_10-00-00_s0", "runs/reach/2026-01-01_10-00-00_s0"
    assert complete_run("") == ["latest", "ant", "reach", newest, oldest, "mine.onnx"]
    assert complete_run("runs/r") == [oldest]


@pytest.mark.slow
def test_the_shell_gets_them(tmp_path):
    words = {"_RLCTL_COMPLETE": "complete_bash", "COMP_WORDS": "rlctl train rea", "COMP_CWORD": "2"}
    done = subprocess.run(
        [Path(sys.executable).with_name("rlctl")],
        env={**os.environ, **words}, cwd=tmp_path, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert "reach" in done.stdout.split(), done.stderr
