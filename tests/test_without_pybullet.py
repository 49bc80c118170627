"""Where PyBullet is not installed, as on Python 3.12 and later, everything but tasks of rlctl works."""

import os
import subprocess
import sys

import pytest

GONE = "raise ModuleNotFoundError('not installed', name={0!r})"


@pytest.fixture
def rlctl_without(tmp_path, monkeypatch):
    """Run the command line in `tmp_path` with PyBullet hidden from it and from its workers."""
    for name in ("pybullet", "pybullet_data"):
        (tmp_path / "hidden").mkdir(exist_ok=True)
        (tmp_path / "hidden" / f"{name}.py").write_text(GONE.format(name))
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(tmp_path / "hidden"), os.environ.get("PYTHONPATH", "")]))
    monkeypatch.setenv("NO_COLOR", "1")

    def run(*arguments):
        command = [sys.executable, "-m", "rlctl", *arguments]
        return subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=250)

    return run


@pytest.mark.parametrize(
    "command",
    [("train", "reach", "-n", "100"), pytest.param(("eval", "reach", "--pretrained"), marks=pytest.mark.slow)],
)
def test_a_task_of_rlctl_names_what_is_missing(rlctl_without, command):
    done = rlctl_without(*command)
    assert done.returncode == 2
    error = done.stderr.splitlines()[-1]
    assert error.startswith("error: tasks of rlctl need PyBullet, which is not installed: pip install ")
    assert error.endswith(" pybullet")


def test_a_gymnasium_environment_is_recorded(rlctl_without):
    done = rlctl_without("replay", "Pendulum-v1", "--policy", "zero")
    assert done.returncode == 0, done.stderr


@pytest.mark.slow
@pytest.mark.parametrize("task", ["Pendulum-v1", "Reacher-v5"])
def test_a_gymnasium_environment_goes_through_every_verb(rlctl_without, task):
    if task == "Reacher-v5":
        pytest.importorskip("mujoco")
    for command in (
        ("check-env", task),
        ("train", task, "-n", "1000", "--set", "eval.episodes=2"),
        ("eval", "--episodes", "2"),
        ("export", "--onnx"),
        ("replay", "--episodes", "1"),
    ):
        done = rlctl_without(*command)
        assert done.returncode == 0, done.stderr
