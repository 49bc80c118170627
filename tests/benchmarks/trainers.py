"""How rlctl, RL Baselines3 Zoo and sbx train a task: their commands, and the evaluations that these leave.

RLCTL_ZOO names a Python with rl_zoo3 2.9.2 and rlctl, RLCTL_SBX one with sbx-rl 0.28 and rlctl.
"""

from __future__ import annotations

import contextlib
import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from rlctl.runs.directory import RunDirectory
from tests.benchmarks.shipped import read_csv
from tests.benchmarks.zoo import OFF_POLICY, PPO_REACH_OF_ZOO, ZOO_ENVS

_ZOO_ID = {
    "ant": "AntBulletEnv-v0",
    "half-cheetah": "HalfCheetahBulletEnv-v0",
    "hopper": "HopperBulletEnv-v0",
    "walker2d": "Walker2DBulletEnv-v0",
    "humanoid": "HumanoidBulletEnv-v0",
}
SCORES = dict.fromkeys(_ZOO_ID, "return") | {"humanoid": "length", "reach": "success"}
"""What is compared: a column of `evals.csv`, the mean of an evaluation."""
_IN_NPZ = {"return": "results", "length": "ep_lengths", "success": "successes"}
EPISODES = 10  # of a peer's evaluation; rlctl evaluates as its recipe says
_ZOO_EVERY = {"ppo": 20_000, "tqc": 10_000}
"""Steps between the evaluations of rl-zoo3: minutes of its TQC, seconds of its PPO."""


def train_rlctl(task: str, seed: int, folder: Path) -> tuple[list[str], Callable[[], list[float]]]:
    """Return the command of the shipped recipe, and a function that reads the scores of its evaluations."""

    def read() -> list[float]:
        file = RunDirectory(folder / "latest").evals_file
        return [float(row[SCORES[task]]) for row in read_csv(file)] if file.exists() else []

    return [sys.executable, "-m", "rlctl", "train", task, "--seed", str(seed), "-o", str(folder)], read


def train_zoo(task: str, seed: int, folder: Path) -> tuple[list[str], Callable[[], list[float]]]:
    """Return the zoo's command with its own tuned hyperparameters; for `reach`, those of an earlier recipe of rlctl."""
    algo, settings = _read_zoo_settings(task)
    file = folder / "zoo.yml"
    file.write_text(yaml.safe_dump({f"rlctl/{task}-v0": settings}))
    command = [
        *(os.environ["RLCTL_ZOO"], "-m", "rl_zoo3.train", "--algo", algo, "--env", f"rlctl/{task}-v0"),
        *("--gym-packages", "rlctl.gym", "--conf-file", str(file), "--vec-env", "subproc", "--seed", str(seed)),
        *("--eval-freq", str(_ZOO_EVERY[algo]), "--eval-episodes", str(EPISODES), "--save-freq", "-1"),
        *("-f", str(folder), "--device", "cpu"),
    ]
    return command, lambda: read_evaluations(folder, SCORES[task])


def _read_zoo_settings(task: str) -> tuple[str, dict[str, Any]]:
    if task == "reach":
        network = "dict(log_std_init=-2, net_arch=[64, 64])"
        settings = {**PPO_REACH_OF_ZOO, "policy_kwargs": network, "normalize": True, "n_timesteps": 1_000_000}
        return "ppo", {**settings, "n_envs": ZOO_ENVS, "policy": "MlpPolicy"}
    find = "import rl_zoo3, pathlib; print(pathlib.Path(rl_zoo3.__file__).parent / 'hyperparams/tqc.yml')"
    file = subprocess.run([os.environ["RLCTL_ZOO"], "-c", find], check=True, capture_output=True, text=True).stdout
    settings = yaml.safe_load(Path(file.strip()).read_text())[_ZOO_ID[task]]
    return "tqc", settings


def read_evaluations(folder: Path, score: str = "return") -> list[float]:
    """Return the means of the evaluations that Stable-Baselines3's `EvalCallback` has written below a folder."""
    for file in folder.rglob("evaluations.npz"):
        with contextlib.suppress(OSError, ValueError, EOFError), np.load(file) as arrays:  # while it is written
            return [float(mean) for mean in arrays[_IN_NPZ[score]].mean(axis=1)]
    return []


_SBX = """
import json, sys, gymnasium, sbx, rlctl.gym
from stable_baselines3.common.callbacks import EvalCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import SubprocVecEnv
job = json.loads(sys.argv[1])
if __name__ == "__main__":
    env = make_vec_env(job["env"], n_envs=job["n_envs"], vec_env_cls=SubprocVecEnv, seed=job["seed"])
    every = max(1, job["every"] // job["n_envs"])
    callback = EvalCallback(
        make_vec_env(job["env"]), n_eval_episodes=job["episodes"], eval_freq=every, log_path=job["folder"], verbose=0
    )
    model = getattr(sbx, job["algo"])(job.get("policy", "MlpPolicy"), env, seed=job["seed"], **job["settings"])
    model.learn(job["steps"], callback=callback)
    if "last_episodes" in job:
        score, _ = evaluate_policy(model, make_vec_env(job["env"]), job["last_episodes"])
        open(job["folder"] + "/last.txt", "w").write(str(score))
"""
_SBX_TQC = {**OFF_POLICY, "gradient_steps": 32, "policy_kwargs": {"net_arch": [256, 256]}}
_SBX_PPO = {"learning_rate": 1.2e-3, "n_steps": 320, "batch_size": 640, "n_epochs": 5, "gamma": 0.93}


def train_sbx(task: str, seed: int, folder: Path) -> tuple[list[str], Callable[[], list[float]]]:
    """Return the command of sbx's TQC with the zoo's learning rate, batch, gamma and tau; for `reach` its PPO."""
    algo, settings, steps = ("PPO", _SBX_PPO, 1_000_000) if task == "reach" else ("TQC", _SBX_TQC, 2_000_000)
    job = {
        "env": f"rlctl/{task}-v0",
        "algo": algo,
        "settings": settings,
        "seed": seed,
        "steps": steps,
        "n_envs": 8 if task == "reach" else 16,
        "episodes": EPISODES,
        "every": steps // 50,
        "folder": str(folder),
    }
    return write_sbx(job, folder), lambda: read_evaluations(folder, SCORES[task])


def write_sbx(job: dict[str, Any], folder: Path) -> list[str]:
    """Write the script that trains with sbx; return the command of a training."""
    script = folder / "train.py"
    script.write_text(_SBX)
    return [os.environ["RLCTL_SBX"], str(script), json.dumps(job)]


PEERS = {"rl-zoo3": "RLCTL_ZOO", "sbx": "RLCTL_SBX"}
"""The variable that names the Python of a tool."""
TRAINERS = {"rlctl": train_rlctl, "rl-zoo3": train_zoo, "sbx": train_sbx}
PACKAGES = {"rlctl": "rlctl", "rl-zoo3": "rl_zoo3", "sbx": "sbx-rl"}
"""The package of a tool, whose version the page names."""
