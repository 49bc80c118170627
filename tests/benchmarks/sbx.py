"""How fast it trains against sbx, Stable-Baselines3's sibling on JAX: same task, hyperparameters, updates. Minutes.

The environment variable RLCTL_SBX names a Python that has sbx-rl 0.28 and rlctl installed.
"""

from __future__ import annotations

import dataclasses
import functools
import json
import os
import subprocess
import tempfile
from pathlib import Path
from typing import Any

import yaml

from tests.benchmarks import shipped
from tests.benchmarks.row import Row, side_by_side
from tests.benchmarks.zoo import OFF_POLICY

TARGET = 1.3
CHUNK = OFF_POLICY["train_freq"]  # steps of each environment between updates
_PEER = """
import json, sys, time, gymnasium, sbx, torch, rlctl.gym
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv
torch.set_num_threads(1)
job = json.loads(sys.argv[1])
if __name__ == "__main__":
    kind = {"dummy": DummyVecEnv, "subproc": SubprocVecEnv}[job["envs"]]
    env = make_vec_env(job["env"], n_envs=job["n_envs"], vec_env_cls=kind)
    network = dict(net_arch=job["net_arch"])
    model = getattr(sbx, job["algo"])("MlpPolicy", env, seed=0, policy_kwargs=network, **job["settings"])
    model.learn(4_000)  # compiles
    began = time.perf_counter()
    model.learn(job["steps"])
    print(job["steps"] / (time.perf_counter() - began))
    env.close()
"""


@dataclasses.dataclass(frozen=True)
class _Training:
    """What both train; `env` is the peer's name of the task."""

    algo: str
    net_arch: list[int]
    updates: int  # after every `CHUNK` steps of each environment
    task: str = "half-cheetah"
    env: str = "rlctl/half-cheetah-v0"
    n_envs: int = 16
    steps: int = 20_000
    policy_delay: int = 1

    @property
    def settings(self) -> dict[str, Any]:
        settings = {**OFF_POLICY, "gradient_steps": self.updates, "policy_delay": self.policy_delay}
        if self.algo == "CrossQ":
            del settings["tau"]  # it has no target networks
        return settings


def _row(training: _Training, repeat: int) -> Row:
    peer = os.environ.get("RLCTL_SBX")
    if not peer:
        raise RuntimeError("set RLCTL_SBX to a Python with sbx-rl 0.28 and rlctl")
    job = {**dataclasses.asdict(training), "settings": training.settings}
    pair = side_by_side(
        lambda: _our_speed(training),
        # One of the two is the faster, depending on the machine.
        lambda: max(_peer_speed(peer, {**job, "envs": kind}) for kind in ("dummy", "subproc")),
        repeat,
    )
    return Row(
        f"{training.algo} {training.net_arch}, against sbx",
        f"{pair.ours:,.0f} steps/s",
        f"{pair.theirs:,.0f} steps/s",
        f"{pair.ratio:.2f}x",
        f">= {TARGET}x",
        pair.ratio >= TARGET,
        f"{training.task}, {training.n_envs} environments, {training.updates} updates for "
        f"{CHUNK * training.n_envs} steps; {training.steps:,} steps of both",
    )


def _our_speed(training: _Training) -> float:
    recipe = {
        "algo": training.algo.lower(),
        "algo_kwargs": {**training.settings, "n_steps": 1, "use_sde": False},  # unlike the task's recipe
        "policy_kwargs": {"net_arch": training.net_arch},
        "n_envs": training.n_envs,
        "stages": [],
        "normalize": None,  # as the peer
        "total_timesteps": training.steps + 4_000,
        "eval": {"every_steps": 10**9, "episodes": 1},
    }
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "recipe.yaml"
        file.write_text(yaml.safe_dump(recipe))
        shipped.rlctl_command("train", training.task, "--config", str(file), "--no-check", "-o", folder)
        return shipped.Training((Path(folder) / "latest").resolve(), None).steps_per_second


def _peer_speed(peer: str, job: dict[str, Any]) -> float:
    with tempfile.NamedTemporaryFile("w", suffix=".py") as script:
        script.write(_PEER)
        script.flush()
        done = subprocess.run([peer, script.name, json.dumps(job)], check=True, text=True, capture_output=True)
    return float(done.stdout.split()[-1])


def _of(training: _Training) -> functools.partial[Row]:
    return functools.partial(_row, training)


tqc_128 = _of(_Training("TQC", [128, 128], 32))
sac_128 = _of(_Training("SAC", [128, 128], 32))
sac_256 = _of(_Training("SAC", [256, 256], 8))
_CHEETAH = {"task": "HalfCheetah-v5", "env": "HalfCheetah-v5", "n_envs": 1, "steps": 6_000}
sac_mujoco = _of(_Training("SAC", [256, 256], CHUNK, **_CHEETAH))
crossq_mujoco = _of(_Training("CrossQ", [256, 256], CHUNK, **_CHEETAH, policy_delay=3))
