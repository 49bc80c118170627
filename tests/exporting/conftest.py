"""Policies to export: SB3 models of a few updates, with normalisation that has seen something odd."""

from pathlib import Path

import numpy as np
import pytest
import torch
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from rlctl.environments.info import describe
from rlctl.environments.spec import EnvSpec
from rlctl.policy.torch_policy import ALGORITHMS, policy_name
from rlctl.recipe.recipe import NormalizeSettings
from rlctl.training.algorithms import keep_compiler_out, wrap_normalize
from rlctl.training.snapshot import pack

SMALL = f"{Path(__file__).parent / 'envs.py'}:Small"
ON_POLICY = {
    "ppo": {"n_steps": 32, "batch_size": 32, "n_epochs": 1},
    "a2c": {"n_steps": 16},
    "recurrent_ppo": {"n_steps": 32, "batch_size": 32, "n_epochs": 1},
}
OFF_POLICY = {"learning_starts": 16, "buffer_size": 200, "batch_size": 16}


keep_compiler_out()  # for the models of all tests: importing it takes longer than training them


@pytest.fixture(autouse=True)
def _one_thread():
    torch.set_num_threads(1)


@pytest.fixture
def small():
    """Return the spec of a small environment."""

    def spec(observation="vector", action="box", **parameters):
        return EnvSpec(SMALL, {"observation": observation, "action": action, **parameters})

    return spec


@pytest.fixture
def train():
    """Return a model of `steps` steps and its environments, normalised as far as the recipe's default would."""

    def trained(algo, spec, steps=32, **kwargs):
        env = wrap_normalize(DummyVecEnv([spec.make]), NormalizeSettings(), 0.99)
        name = policy_name(algo, env.observation_space)
        network = {"net_arch": [16, 16], **({"lstm_hidden_size": 16} if algo == "recurrent_ppo" else {})}
        settings = {**ON_POLICY.get(algo, OFF_POLICY), "policy_kwargs": network, **kwargs}
        model = ALGORITHMS[algo](name, env, device="cpu", seed=0, **settings)
        if steps:
            model.learn(steps)
        for part in model.get_parameters()["policy"].values():
            # Actions far from zero, so that a difference would show.
            part.add_(0.05 * torch.randn(part.shape)) if part.is_floating_point() and part.dim() > 1 else None
        return model

    return trained


@pytest.fixture
def write(tmp_path):
    """Write a model's policy file and return its path."""

    def written(model, algo, spec, name="policy"):
        path = tmp_path / f"{name}.safetensors"
        pack(model, algo, spec, describe(spec.make())).write(path)
        return path

    return written


@pytest.fixture
def odd_statistics():
    """Make a normalisation hard: an element that hardly varies, one with a large mean, one with a wide range."""

    def set_statistics(model):
        env = model.get_vec_normalize_env()
        assert isinstance(env, VecNormalize)
        env.training = False
        rms = env.obs_rms
        for statistics in rms.values() if isinstance(rms, dict) else [rms]:
            statistics.mean = np.array([0.3, -50.0, 0.1])
            statistics.var = np.array([1e-12, 2000.0, 1.7])

    return set_statistics
