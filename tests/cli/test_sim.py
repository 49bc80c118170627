"""`--sim`: the physics engine of a task, for every verb that builds one."""

import json
import subprocess
import sys

import pytest

from rlctl.engine import Engine
from rlctl.policy.file import PolicyFile

pytestmark = pytest.mark.pybullet  # which of two engines is taken


@pytest.fixture
def rlctl(tmp_path, monkeypatch):
    monkeypatch.setenv("NO_COLOR", "1")

    def run(*arguments):
        command = [sys.executable, "-m", "rlctl", *map(str, arguments)]
        return subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=250)

    return run


@pytest.mark.slow
@pytest.mark.parametrize(
    ("sim", "engine"), [((), "PyBullet"), pytest.param(("--sim", "mujoco"), "MuJoCo", marks=pytest.mark.slow)]
)
def test_an_evaluation_says_where_it_was_played(rlctl, sim, engine):
    done = rlctl("eval", "reach", "--policy", "zero", "--episodes", "2", *sim)
    assert done.returncode == 0, done.stderr
    assert f"2 episodes, seed 0, {engine}, not randomised" in done.stdout


@pytest.mark.slow
def test_a_policy_contains_the_engine_of_its_training(rlctl, tmp_path):
    done = rlctl("train", "reach", "--sim", "mujoco:0.01", "-n", "200", "--n-envs", "2", "--no-check", "--json", "-")
    assert done.returncode == 0, done.stderr
    assert "train reach (ppo, MuJoCo)" in done.stderr
    run = tmp_path / json.loads(done.stdout)["run"]
    assert "sim: mujoco:0.01" in (run / "recipe.yaml").read_text()
    assert PolicyFile.read(run / "policies" / "last.safetensors").info.spec.sim == Engine("mujoco", 0.01)
    played = rlctl("eval", run, "--checkpoint", "last", "--episodes", "2")
    assert "2 episodes, seed 0, MuJoCo" in played.stdout, played.stderr
    other = rlctl("eval", run, "--checkpoint", "last", "--episodes", "2", "--sim", "pybullet")
    assert "2 episodes, seed 0, PyBullet" in other.stdout, other.stderr


@pytest.mark.slow
def test_a_batch_has_no_worlds_in_pybullet(rlctl):
    done = rlctl("eval", "walk", "--policy", "zero", "--episodes", "1", "--sim", "pybullet")
    assert done.returncode == 2
    assert done.stderr == "error: Walk simulates its worlds in MuJoCo: sim: mujoco, or --sim mujoco\n"


VERBS = [
    "check-env",
    "train",
    "eval",
    "replay",
    "play",
    "export",
    "robot",
    "serve",
    "identify",
    "diagnose",
    "distill",
    "tune",
]


@pytest.mark.slow
@pytest.mark.parametrize("verb", ["check-env", pytest.param("eval", marks=pytest.mark.slow)])
def test_an_engine_that_does_not_exist(rlctl, verb):
    done = rlctl(verb, "reach", "--sim", "mujocoo")
    assert done.returncode == 2
    assert done.stderr == (
        "error: --sim 'mujocoo': no such engine. Did you mean 'mujoco'? "
        "Give pybullet, mujoco, or mujoco:SOLREF with 0 < SOLREF < 1 s\n"
    )


@pytest.mark.slow
def test_a_look_in_mujoco(rlctl):
    done = rlctl("replay", "reach", "--policy", "zero", "--sim", "mujoco", "--json", "-")
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["episodes"][0]["length"] == 120


@pytest.mark.slow
def test_the_engine_leaves_the_events_as_they_are(rlctl):
    """`--sim` is the engine and nothing else: not whether the world is randomised."""
    done = rlctl("eval", "walk", "--policy", "zero", "--episodes", "1", "--sim", "mujoco", "--set", "randomize=true")
    assert done.returncode == 0, done.stderr
    assert "1 episode, seed 0, MuJoCo, randomised" in done.stdout
    assert done.stderr.startswith("--sim mujoco plays in one engine; to vary the stiffness of its contacts: --vary sim")
