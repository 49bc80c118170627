"""Where PyBullet is not installed, as on Python 3.12 and later, MuJoCo simulates the tasks of rlctl."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

HIDDEN = str(Path(__file__).parent / "hidden")


@pytest.fixture
def rlctl_without(tmp_path, monkeypatch):
    """Run the command line in `tmp_path` with PyBullet hidden from it and from its workers."""
    monkeypatch.setenv("HIDE_PACKAGES", "pybullet pybullet_data")
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([HIDDEN, *filter(None, [os.environ.get("PYTHONPATH")])]))
    monkeypatch.setenv("NO_COLOR", "1")

    def run(*arguments):
        command = [sys.executable, "-m", "rlctl", *arguments]
        return subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=250)

    return run


@pytest.mark.slow
def test_a_task_with_a_model_of_pybullet_names_what_is_missing(rlctl_without):
    task = "tests.task.tasks:Stadium"
    done = rlctl_without("train", task, "-n", "100")
    assert done.returncode == 3
    last = done.stderr.splitlines()[-1]
    assert last.startswith(f"error: task '{task}': model file 'plane_stadium.sdf' not found")
    assert "If it is one of PyBullet's: pip install " in last
    assert "Traceback" not in done.stderr


@pytest.mark.slow
def test_kuka_grasp_needs_no_pybullet(rlctl_without):
    done = rlctl_without("eval", "kuka-grasp", "--pretrained", "--episodes", "4", "--min-success", "0.75")
    assert done.returncode == 0, done.stderr
    assert "warning" not in done.stderr


@pytest.mark.slow
def test_a_policy_of_pybullet_acts_in_mujoco_with_a_warning(rlctl_without):
    done = rlctl_without("eval", "reach", "--pretrained", "--episodes", "4", "--min-success", "1")
    assert done.returncode == 0, done.stderr
    assert "warning: trained in PyBullet, which is not installed, so MuJoCo simulates; scores may differ" in done.stderr
    assert "4 episodes, seed 0, MuJoCo, not randomised" in done.stdout


@pytest.mark.slow
def test_its_controller_is_verified_in_mujoco(rlctl_without, tmp_path):
    done = rlctl_without("export", "reach", "--pretrained", "--controller", "--onnx", "-o", "reach.onnx")
    assert done.returncode == 0, done.stderr
    assert "so MuJoCo simulates" in done.stderr
    assert (tmp_path / "reach.onnx").exists()
    assert (
        rlctl_without("export", "reach", "--pretrained", "--policy", "reach.safetensors", "--episodes", "2").returncode
        == 0
    )


@pytest.mark.slow
def test_pybullet_that_was_asked_for_is_an_error_that_says_how_to_install_it(rlctl_without):
    done = rlctl_without("eval", "reach", "--pretrained", "--set", "sim=pybullet")
    assert done.returncode == 2
    *_, missing, instead = done.stderr.splitlines()
    assert missing.startswith("error: PyBullet is not installed: pip install ")
    assert missing.endswith("pybullet")
    assert instead == "or simulate in MuJoCo, unless the task needs models of PyBullet: --sim mujoco"


@pytest.mark.slow
def test_the_demo_learns_in_mujoco(rlctl_without):
    for command in (
        ("train", "reach"),
        ("eval", "reach", "--min-success", "0.95"),
        ("export", "reach", "--onnx"),
        ("replay", "reach"),
        ("check-env", "reach"),
        ("tasks", "show", "reach"),
    ):
        done = rlctl_without(*command)
        assert done.returncode == 0, done.stdout + done.stderr


@pytest.mark.slow
def test_a_gymnasium_environment_is_recorded(rlctl_without):
    done = rlctl_without("replay", "Pendulum-v1", "--policy", "zero")
    assert done.returncode == 0, done.stderr


@pytest.mark.slow
@pytest.mark.parametrize("task", ["Pendulum-v1", "Reacher-v5"])
def test_a_gymnasium_environment_goes_through_every_verb(rlctl_without, task):
    for command in (
        ("check-env", task),
        ("train", task, "-n", "1000", "--set", "eval.episodes=2"),
        ("eval", "--episodes", "2"),
        ("export", "--onnx"),
        ("replay", "--episodes", "1"),
    ):
        done = rlctl_without(*command)
        assert done.returncode == 0, done.stderr
