"""A task whose source has changed since a training is not the task that was learned."""

import pytest

SOURCE = """
import gymnasium as gym
import numpy as np

class Toy(gym.Env):
    observation_space = gym.spaces.Box(-1, 1, (1,), np.float32)
    action_space = gym.spaces.Box(-1, 1, (1,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return np.zeros(1, np.float32), {}

    def step(self, action):
        return np.zeros(1, np.float32), float(action[0]), False, True, {}
"""
TINY = ("total_timesteps=64", "n_envs=1", "algo_kwargs.n_steps=32", "algo_kwargs.batch_size=32", "eval.episodes=2")
SETTINGS = [part for setting in TINY for part in ("--set", setting)]


@pytest.fixture
def changed_run(rlctl, write_module, tmp_path):
    """Two trainings, between which the reward was rewritten; return the folders, oldest first."""
    write_module("toy.py", SOURCE)
    for seed in (0, 1):
        done = rlctl("train", "toy.py:Toy", "--no-check", "--seed", seed, *SETTINGS)
        assert done.returncode == 0, done.stderr
        write_module("toy.py", SOURCE.replace("float(action[0])", "7.0"))
    return sorted((tmp_path / "runs" / "Toy").iterdir(), key=lambda path: path.name[-1])


@pytest.mark.slow
def test_a_rewritten_reward_is_noticed(rlctl, changed_run, write_module):
    old, new = changed_run
    is_changed = "toy.py has changed since the run began"
    assert is_changed in rlctl("eval", old, "--episodes", 2).stderr
    assert is_changed not in rlctl("eval", new, "--episodes", 2).stderr
    assert f"{is_changed}, in: Toy/{old.name}\n" in rlctl("runs").stdout
    assert is_changed in rlctl("runs", "show", old).stdout
    assert is_changed in rlctl("runs", "report", old, "--format", "md").stdout
    done = rlctl("runs", "compare", old, new, "--episodes", 2)
    assert done.returncode == 2
    assert is_changed in done.stderr
    assert "--force compares anyway" in done.stderr
    assert rlctl("runs", "compare", old, new, "--episodes", 2, "--force").returncode == 0
