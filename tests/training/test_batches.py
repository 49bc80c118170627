"""Trainings of tasks in batches: equal on any number of workers, and what is done with their policies."""

import json

import pytest

from tests.task.batches import MODEL
from tests.training.comparing import assert_same_run

pytest.importorskip("mujoco")

STOOL = "tests.task.batches:Stool"
SMALL = {
    "n_envs": 6,
    "randomize": True,
    "total_timesteps": 600,
    "eval": {"episodes": 5, "every_steps": 300},
}
PPO = {**SMALL, "algo_kwargs": {"n_steps": 25, "batch_size": 50, "n_epochs": 2}}
SAC = {**SMALL, "algo": "sac", "total_timesteps": 240, "algo_kwargs": {"learning_starts": 24, "batch_size": 16}}
SAC["eval"] = {"episodes": 3, "every_steps": 120}
CASES = {
    "ppo": PPO,
    "ppo with gSDE": {**PPO, "algo_kwargs": {**PPO["algo_kwargs"], "use_sde": True}},
    "recurrent_ppo": {**PPO, "algo": "recurrent_ppo", "policy_kwargs": {"lstm_hidden_size": 8}},
    "sac": SAC,
}


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES)
def test_equal_on_any_number_of_workers(train, monkeypatch, case):
    runs = []
    for count in (1, 2, 3):
        monkeypatch.setattr("rlctl.play.workers.available_cores", lambda count=count: count)
        runs.append(train(STOOL, CASES[case]).run)
    for run in runs[1:]:
        assert_same_run(runs[0], run)


@pytest.fixture
def trained(rlctl, tmp_path):
    """Train the stool from the command line, in a module of the user's."""
    (tmp_path / "stool.urdf").write_text(MODEL.read_text())
    (tmp_path / "stool.py").write_text(MODEL.with_name("batches.py").read_text())
    settings = [f"--set={key}={json.dumps(value)}" for key, value in PPO.items() if key != "total_timesteps"]
    result = rlctl("train", "stool.py:Stool", "-n", "300", "--no-check", *settings)
    assert result.returncode == 0, result.stderr
    return rlctl


@pytest.mark.slow
def test_what_is_done_with_its_policy(trained, tmp_path):
    rlctl = trained
    result = rlctl("eval", "--episodes", "20", "--json", "-")
    assert result.returncode == 0, result.stderr
    assert len(json.loads(result.stdout)["episodes"]) == 20
    result = rlctl("export", "--onnx")
    assert result.returncode == 0, result.stderr
    assert list(tmp_path.glob("runs/*/*/exports/*.onnx"))
    result = rlctl("replay", "--episodes", "1")
    assert result.returncode == 0, result.stderr
    episode = sorted(tmp_path.glob("runs/*/*/episodes/*.npz"))[0]
    result = rlctl("replay", "--verify", episode)
    assert result.returncode == 0, result.stderr
