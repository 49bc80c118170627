"""Tasks in MuJoCo: one world per call of Python, worlds in batches, and the whole training of `walk`."""

from __future__ import annotations

import csv
import json
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from rlctl.engine import MUJOCO, PYBULLET
from rlctl.environments.spec import EnvSpec
from tests.benchmarks.row import Row, side_by_side

STEPS, WORLDS = 1000, 128
_SHORT = ("eval.every_steps=55_000", "algo_kwargs.learning_rate=lin_1.6e-3", "algo_kwargs.batch_size=320")
"""What makes a training of 55,000 steps of `reach-batch` enough; the recipe's settings suit longer ones."""
TRAINED = 614_400  # steps, 100 rollouts


def one_world(repeat: int) -> Row:
    """Count steps/s of `reach` on one core: MuJoCo next to PyBullet."""
    mujoco, bullet = (EnvSpec("reach", sim=sim).make() for sim in (MUJOCO, PYBULLET))
    pair = side_by_side(lambda: _count_steps(mujoco), lambda: _count_steps(bullet), 3 * repeat)
    mujoco.close()
    bullet.close()
    note = "one core, random actions, whole steps of TaskEnv; theirs: PyBullet"
    ours, theirs = f"{pair.ours:,.0f} steps/s", f"{pair.theirs:,.0f} steps/s"
    return Row("reach in MuJoCo", ours, theirs, f"{pair.ratio:.2f}x", ">= 12,000 steps/s", pair.ours >= 12_000, note)


def _count_steps(env: Any) -> float:
    rng = np.random.default_rng(0)
    actions = rng.uniform(-1, 1, (STEPS, *env.action_space.shape)).astype(np.float32)
    env.reset(seed=0)
    began = time.perf_counter()
    for action in actions:
        _, _, terminated, truncated, _ = env.step(action)
        if terminated or truncated:
            env.reset()
    return STEPS / (time.perf_counter() - began)


def many_worlds(repeat: int) -> Row:
    """Count steps/s of `walk` on one core: a batch next to one world at a time."""
    spec = EnvSpec("walk").resolve()
    single = spec.make()
    batch = spec.make_worlds(WORLDS)
    rng = np.random.default_rng(0)

    def count() -> float:
        batch.reset(np.arange(WORLDS), list(range(WORLDS)))
        began = time.perf_counter()
        for _ in range(100):
            result = batch.step(rng.normal(0.0, 0.3, (WORLDS, 12)).astype(np.float32))
            ended = np.flatnonzero(result.terminated | result.truncated)
            if len(ended):
                batch.reset(ended, ended.tolist())
        return 100 * WORLDS / (time.perf_counter() - began)

    pair = side_by_side(count, lambda: _count_steps(single), repeat)
    batch.close()
    single.close()
    note = f"one core, {WORLDS} worlds; theirs: one world at a time"
    ours, theirs = f"{pair.ours:,.0f} steps/s", f"{pair.theirs:,.0f} steps/s"
    return Row("walk as a batch", ours, theirs, f"{pair.ratio:.1f}x", ">= 15,000 steps/s", pair.ours >= 15_000, note)


def walk(repeat: int) -> Row:
    """Count steps/s of whole trainings of `walk`."""
    return _train_all("walk", TRAINED, 25_000, repeat)


def reach_batch(repeat: int) -> Row:
    """Count steps/s of whole trainings of `reach-batch`."""
    return _train_all("reach-batch", 128_000, 35_000, repeat)


def reach_batch_learns(repeat: int) -> Row:
    """Time whole processes of `rlctl train reach-batch` whose policy then succeeds in 95 of 100 unseen episodes."""
    with tempfile.TemporaryDirectory() as folder:
        seconds, rates = zip(*(_learn_reach(seed, folder) for seed in range(repeat)), strict=True)
    typical, lowest = statistics.median(seconds), min(rates)
    reached = typical <= 5 and lowest >= 0.95
    note = f"from the start of the process to its end, no check; lowest success of {repeat} seeds"
    return Row("reach-batch, learned", f"{typical:.1f} s, {lowest:.0%}", "", "", "<= 5 s, >= 95 %", reached, note)


def _learn_reach(seed: int, folder: str) -> tuple[float, float]:
    began = time.perf_counter()
    settings = ("--no-check", *(word for key in _SHORT for word in ("--set", key)))
    _rlctl("train", "reach-batch", "--seed", str(seed), "-n", "55000", "-o", folder, *settings)
    seconds = time.perf_counter() - began
    (run,) = Path(folder).glob(f"reach-batch/*_s{seed}")
    return seconds, json.loads(_rlctl("eval", str(run), "--seed", "1000", "--json", "-"))["success_rate"]


def _rlctl(*args: str) -> str:
    return subprocess.run([sys.executable, "-m", "rlctl", *args], check=True, capture_output=True, text=True).stdout


def _train_all(task: str, steps: int, target: float, repeat: int) -> Row:
    """Return steps/s of trainings from the first step on, evaluations left out."""
    rate = statistics.median(_train(task, steps, seed) for seed in range(repeat))
    note = f"all cores, {steps:,} steps, median of seeds; playing and learning"
    return Row(
        f"{task}, whole training", f"{rate:,.0f} steps/s", "", "", f">= {target:,} steps/s", rate >= target, note
    )


def _train(task: str, steps: int, seed: int) -> float:
    with tempfile.TemporaryDirectory() as folder:
        settings = ("--set", f"eval.every_steps={steps}", "--set", "eval.episodes=1", "--no-check")
        _rlctl("train", task, "--seed", str(seed), "-n", str(steps), "-o", folder, *settings)
        (metrics,) = Path(folder).rglob("metrics.csv")
        with metrics.open() as file:
            rows = list(csv.DictReader(file))
    first, last = rows[0], rows[-1]
    return (float(last["steps"]) - float(first["steps"])) / (float(last["seconds"]) - float(first["seconds"]))
