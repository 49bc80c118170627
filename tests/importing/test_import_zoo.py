"""Agents that rl-zoo3 trained and saved itself act the same as policies of ours.

The environment variable RLCTL_ZOO names a Python that has rl_zoo3 2.9.2 and rlctl installed.
"""

import os
import pickle
import subprocess

import numpy as np
import pytest
import yaml

from rlctl import load_policy
from rlctl.importing.import_model import import_model
from rlctl.policy.torch_policy import ALGORITHMS

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif("RLCTL_ZOO" not in os.environ, reason="RLCTL_ZOO names no Python with rl_zoo3"),
]

ON_POLICY = {"n_envs": 2, "n_timesteps": 512, "n_steps": 128, "batch_size": 64, "learning_rate": "lin_3e-4"}
OFF_POLICY = {"n_timesteps": 200, "learning_starts": 100, "policy": "MlpPolicy"}
AGENTS = [
    (
        *("ppo", "rlctl/reach-v0", "reach"),
        {
            **ON_POLICY,
            "policy": "MlpPolicy",
            "normalize": True,
            "use_sde": True,
            "env_wrapper": "sb3_contrib.common.wrappers.TimeFeatureWrapper",
            "policy_kwargs": "dict(log_std_init=-1, activation_fn=nn.ReLU, net_arch=dict(pi=[32], vf=[32]))",
        },
    ),
    ("ppo_lstm", "Pendulum-v1", "Pendulum-v1", {**ON_POLICY, "policy": "MlpLstmPolicy", "normalize": True}),
    ("tqc", "Pendulum-v1", "Pendulum-v1", {**OFF_POLICY, "use_sde": True}),
    ("dqn", "CartPole-v1", "CartPole-v1", {**OFF_POLICY, "n_timesteps": 512}),
]


@pytest.mark.parametrize(("algo", "env", "task", "settings"), AGENTS, ids=lambda value: str(value)[:12])
def test_a_zoo_agent_acts_as_the_model_does(tmp_path, algo, env, task, settings):
    (tmp_path / "zoo.yml").write_text(yaml.safe_dump({env: settings}))
    command = [os.environ["RLCTL_ZOO"], "-m", "rl_zoo3.train", "--algo", algo, "--env", env, "--seed", "1"]
    options = ["-conf", "zoo.yml", "-f", "logs", "--eval-freq", "-1", "--device", "cpu", "--gym-packages", "rlctl.gym"]
    done = subprocess.run([*command, *options], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    (file,) = tmp_path.rglob("*.zip")
    statistics = next(tmp_path.rglob("vecnormalize.pkl"), None)
    imported = import_model(file, task, normalization=statistics, output=tmp_path / "policy.safetensors")
    assert imported.info.spec.time_feature is (task == "reach")
    # Its schedules are classes of rl_zoo3, which is not installed here.
    schedules = {"learning_rate": 0.0, "lr_schedule": None, "clip_range": 0.2}
    model = ALGORITHMS["recurrent_ppo" if algo == "ppo_lstm" else algo].load(file, None, "cpu", schedules)
    normalize = pickle.loads(statistics.read_bytes()).normalize_obs if statistics else np.asarray  # noqa: S301 (ours)
    policy, rng, state = load_policy(imported.path), np.random.default_rng(0), None
    space = policy.observation_space
    for step in range(1000):
        observation = rng.normal(0, 2, space.shape).astype(space.dtype)
        expected, state = model.predict(
            normalize(observation), state=state, episode_start=np.array([step == 0]), deterministic=True
        )
        np.testing.assert_allclose(policy.predict(observation), expected, rtol=1e-5, atol=1e-5)
