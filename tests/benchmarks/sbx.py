"""How fast it trains against sbx, Stable-Baselines3's sibling on JAX: same task, hyperparameters, updates. Minutes.

The environment variable RLCTL_SBX names a Python that has sbx-rl 0.28 and rlctl installed.
"""

from __future__ import annotations

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

TASK, ENVS, STEPS, TARGET = "half-cheetah", 16, 20_000, 1.3
CHUNK = OFF_POLICY["train_freq"]  # steps of each environment between updates: 128 of all
_PEER = """
import json, sys, time, gymnasium, sbx, torch, rlctl.gym
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv
torch.set_num_threads(1)
job = json.loads(sys.argv[1])
if __name__ == "__main__":
    kind = {"dummy": DummyVecEnv, "subproc": SubprocVecEnv}[job["envs"]]
    env = make_vec_env(f"rlctl/{job['task']}-v0", n_envs=job["n_envs"], vec_env_cls=kind)
    network = dict(net_arch=job["net_arch"])
    model = getattr(sbx, job["algo"])("MlpPolicy", env, seed=0, policy_kwargs=network, **job["settings"])
    model.learn(4_000)  # compiles
    began = time.perf_counter()
    model.learn(job["steps"])
    print(job["steps"] / (time.perf_counter() - began))
    env.close()
"""


def _row(algo: str, net_arch: list[int], updates: int, repeat: int) -> Row:
    peer = os.environ.get("RLCTL_SBX")
    if not peer:
        raise RuntimeError("set RLCTL_SBX to a Python with sbx-rl 0.28 and rlctl")
    settings = {**OFF_POLICY, "gradient_steps": updates}
    job = {"algo": algo, "task": TASK, "n_envs": ENVS, "net_arch": net_arch, "settings": settings, "steps": STEPS}
    pair = side_by_side(
        lambda: _our_speed(algo, net_arch, settings),
        # One of the two is the faster, depending on the machine.
        lambda: max(_peer_speed(peer, {**job, "envs": kind}) for kind in ("dummy", "subproc")),
        repeat,
    )
    return Row(
        f"{algo} {net_arch}, against sbx",
        f"{pair.ours:,.0f} steps/s",
        f"{pair.theirs:,.0f} steps/s",
        f"{pair.ratio:.2f}x",
        f">= {TARGET}x",
        pair.ratio >= TARGET,
        f"{TASK}, {ENVS} environments, {updates} updates for {CHUNK * ENVS} steps; {STEPS:,} steps of both",
    )


def _our_speed(algo: str, net_arch: list[int], settings: dict[str, Any]) -> float:
    recipe = {
        "algo": algo.lower(),
        "algo_kwargs": {**settings, "n_steps": 1, "policy_delay": 1, "use_sde": False},  # unlike the task's recipe
        "policy_kwargs": {"net_arch": net_arch},
        "n_envs": ENVS,
        "stages": [],
        "normalize": None,  # as the peer
        "total_timesteps": STEPS + 4_000,
        "eval": {"every_steps": 10**9, "episodes": 1},
    }
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "recipe.yaml"
        file.write_text(yaml.safe_dump(recipe))
        shipped.rlctl_command("train", TASK, "--config", str(file), "--no-check", "-o", folder)
        return shipped.Training((Path(folder) / "latest").resolve(), None).steps_per_second


def _peer_speed(peer: str, job: dict[str, Any]) -> float:
    with tempfile.NamedTemporaryFile("w", suffix=".py") as script:
        script.write(_PEER)
        script.flush()
        done = subprocess.run([peer, script.name, json.dumps(job)], check=True, text=True, capture_output=True)
    return float(done.stdout.split()[-1])


tqc_128 = functools.partial(_row, "TQC", [128, 128], 32)
sac_128 = functools.partial(_row, "SAC", [128, 128], 32)
sac_256 = functools.partial(_row, "SAC", [256, 256], 8)
