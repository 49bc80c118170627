"""How fast it trains against RL Baselines3 Zoo: the same task, hyperparameters and updates, no evaluation. Minutes.

The environment variable RLCTL_ZOO names a Python that has rl_zoo3 2.9.2 and rlctl installed.
"""

from __future__ import annotations

import os
import re
import subprocess
import tempfile
from pathlib import Path
from typing import Any

import yaml

from tests.benchmarks import shipped
from tests.benchmarks.row import Row, side_by_side

ZOO_ENVS = 8
PPO = {
    "learning_rate": 3e-5,
    "n_steps": 512,
    "batch_size": 128,
    "n_epochs": 20,
    "gamma": 0.99,
    "gae_lambda": 0.9,
    "clip_range": 0.4,
    "use_sde": True,
    "sde_sample_freq": 4,
}
PPO_NETWORK = {"net_arch": [256, 256], "log_std_init": -2, "ortho_init": False, "activation_fn": "relu"}
OFF_POLICY = {
    "learning_rate": 7.3e-4,
    "buffer_size": 300_000,
    "batch_size": 256,
    "gamma": 0.98,
    "tau": 0.02,
    "train_freq": 8,
    "learning_starts": 1000,
}
"""What SAC and TQC share; against sbx too."""
SAC = {**OFF_POLICY, "gradient_steps": 8, "use_sde": True}
PPO_REACH: dict[str, Any] = {
    "learning_rate": "lin_1.2e-3",
    "n_steps": 40,
    "batch_size": 640,
    "n_epochs": 5,
    "gamma": 0.93,
    "use_sde": True,
    "sde_sample_freq": 8,
}
PPO_REACH_NETWORK, PPO_REACH_ENVS = {"net_arch": [64, 64], "log_std_init": -2}, 64
PPO_REACH_OF_ZOO = {**PPO_REACH, "n_steps": PPO_REACH_ENVS * PPO_REACH["n_steps"] // ZOO_ENVS}
"""Rollouts that are as long, from the peer's environments."""
SAC_NETWORK = {"net_arch": [400, 300], "log_std_init": -3}


def ppo_reach(repeat: int) -> Row:
    """Hyperparameters that are written down here, so that the row stays what it is when reach's recipe changes.

    They are the recipe's when the number to reach was set; since then it makes twice as many, smaller minibatches.
    """
    ours = {"algo": "ppo", "algo_kwargs": PPO_REACH, "policy_kwargs": PPO_REACH_NETWORK, "n_envs": PPO_REACH_ENVS}
    return _row("reach", "ppo", ours, PPO_REACH_OF_ZOO, PPO_REACH_NETWORK, True, 102_400, 5.0, repeat)


def ppo_half_cheetah(repeat: int) -> Row:
    """The zoo's PPO: 640 updates for 4,096 steps."""
    ours = {"algo": "ppo", "algo_kwargs": PPO, "policy_kwargs": PPO_NETWORK, "n_envs": ZOO_ENVS, "stages": []}
    return _row("half-cheetah", "ppo", ours, PPO, PPO_NETWORK, True, 16_384, 3.0, repeat)


def sac_half_cheetah(repeat: int) -> Row:
    """The zoo's SAC: eight updates for 64 steps."""
    return _off_policy("sac", repeat)


def tqc_half_cheetah(repeat: int) -> Row:
    """The zoo's TQC: eight updates for 64 steps."""
    return _off_policy("tqc", repeat)


def _off_policy(algo: str, repeat: int) -> Row:
    kwargs = {**SAC, "n_steps": 1, "policy_delay": 1}  # the task's own recipe has others
    settings = {"algo": algo, "algo_kwargs": kwargs, "policy_kwargs": SAC_NETWORK, "n_envs": ZOO_ENVS, "stages": []}
    return _row("half-cheetah", algo, settings, SAC, SAC_NETWORK, False, 8_000, 2.0, repeat)


def _row(
    task: str,
    algo: str,
    ours: dict[str, Any],
    theirs: dict[str, Any],
    network: dict[str, Any],
    normalize: bool,
    steps: int,
    target: float,
    repeat: int,
) -> Row:
    peer = os.environ.get("RLCTL_ZOO")
    if not peer:
        raise RuntimeError("set RLCTL_ZOO to a Python with rl_zoo3 2.9.2 and rlctl")
    pair = side_by_side(
        lambda: _our_speed(task, {**ours, "total_timesteps": steps}),
        lambda: _zoo_speed(peer, task, algo, {"n_timesteps": steps, **theirs}, network, normalize),
        repeat,
    )
    return Row(
        f"{algo} on {task}, against rl-zoo3",
        f"{pair.ours:,.0f} steps/s",
        f"{pair.theirs:,.0f} steps/s",
        f"{pair.ratio:.2f}x",
        f">= {target:g}x",
        pair.ratio >= target,
        f"environment steps per second, playing and learning; {steps:,} steps",
    )


def _our_speed(task: str, settings: dict[str, Any]) -> float:
    with tempfile.TemporaryDirectory() as folder:
        recipe = Path(folder) / "recipe.yaml"
        recipe.write_text(yaml.safe_dump({**settings, "eval": {"every_steps": 10**9, "episodes": 1}}))
        shipped.rlctl_command("train", task, "--config", str(recipe), "--no-check", "-o", folder)
        return shipped.Training((Path(folder) / "latest").resolve(), None).steps_per_second


def _zoo_speed(
    peer: str, task: str, algo: str, kwargs: dict[str, Any], network: dict[str, Any], normalize: bool
) -> float:
    env_id = f"rlctl/{task}-v0"
    activation = {"relu": "nn.ReLU", "tanh": "nn.Tanh"}.get(network.get("activation_fn", ""))
    arguments = [f"{key}={value!r}" for key, value in network.items() if key != "activation_fn"]
    arguments += [f"activation_fn={activation}"] if activation else []
    settings = {**kwargs, "n_envs": ZOO_ENVS, "policy": "MlpPolicy", "policy_kwargs": f"dict({', '.join(arguments)})"}
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "zoo.yml"
        file.write_text(yaml.safe_dump({env_id: {**settings, **({"normalize": True} if normalize else {})}}))
        done = subprocess.run(
            [
                *(peer, "-m", "rl_zoo3.train", "--algo", algo, "--env", env_id, "--gym-packages", "rlctl.gym"),
                *("--conf-file", str(file), "--vec-env", "subproc", "--eval-freq", "-1", "--save-freq", "-1"),
                *("--seed", "0", "-f", folder, "--device", "cpu", "--log-interval", "1"),
            ],
            check=True,
            text=True,
            capture_output=True,
        )
    return float(re.findall(r"fps\s*\|\s*(\d+)", done.stdout)[-1])
