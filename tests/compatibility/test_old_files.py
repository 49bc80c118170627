"""Files of released versions, each in its folder, are still read."""

from pathlib import Path

import numpy as np
import pytest

import rlctl
from rlctl.play.episode import load_episode
from rlctl.runs.directory import RunDirectory
from rlctl.runs.tables import read_table
from rlctl.training import checkpoint_file

VERSIONS = sorted(path for path in Path(__file__).parent.iterdir() if path.name[0].isdigit())


@pytest.fixture(params=VERSIONS, ids=lambda path: path.name)
def files(request):
    return request.param


def test_there_are_some():
    assert next(path.name for path in VERSIONS) == "0.1.0"


@pytest.mark.parametrize("file", ["run/policies/best.safetensors", "run/policies/last.safetensors", "policy.onnx"])
def test_policies_act(files, file):
    policy = rlctl.load_policy(files / file)
    action = policy.predict(np.zeros(policy.info.env.spaces()[0].shape, np.float32))
    assert action.shape == (7,)
    assert np.isfinite(action).all()


def test_a_run_is_read(files):
    run = RunDirectory(files / "run")
    assert run.status()["status"] == "finished"
    assert run.recipe().algo == "ppo"
    assert [row["steps"] for row in read_table(run.evals_file)] == [4000]
    assert {"steps", "return", "success"} <= read_table(run.metrics_file)[0].keys()


def test_a_checkpoint_is_read(files):
    (folder,) = (files / "run" / "checkpoints").iterdir()
    assert checkpoint_file.read(folder).state.format == 1


def test_an_episode_is_read(files):
    episode = load_episode(files / "run" / "episodes" / "000000.npz")
    assert episode.actions.shape == (120, 7)
    assert episode.info.spec.task == "reach"


def test_a_policy_is_evaluated(files):
    result = rlctl.evaluate(files / "run" / "policies" / "best.safetensors", episodes=1, sim="mujoco")
    assert result.returns.mean < 0
