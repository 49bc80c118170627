"""Tasks in MuJoCo: one world per call of Python, worlds in batches, and the whole training of `walk`."""

from __future__ import annotations

import csv
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from rlctl.environments.spec import EnvSpec
from tests.benchmarks.row import Row, side_by_side

STEPS, WORLDS = 1000, 128
TRAINED = 614_400  # steps, 100 rollouts


def one_world(repeat: int) -> Row:
    """Count steps/s of `reach` on one core: MuJoCo next to PyBullet."""
    mujoco, bullet = (EnvSpec("reach", sim=sim).make() for sim in ("mujoco", "pybullet"))
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
    batch = spec.make_batch(single, WORLDS)
    assert batch is not None
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
    """Count steps/s of whole trainings of `walk`: from the first step on, evaluations left out."""
    rates = [_train(seed) for seed in range(repeat)]
    rate = statistics.median(rates)
    return Row(
        "walk, whole training",
        f"{rate:,.0f} steps/s",
        "",
        "",
        ">= 25,000 steps/s",
        rate >= 25_000,
        f"all cores, {TRAINED:,} steps, median of seeds; playing and learning",
    )


def _train(seed: int) -> float:
    with tempfile.TemporaryDirectory() as folder:
        settings = ("--set", f"eval.every_steps={TRAINED}", "--set", "eval.episodes=1", "--no-check")
        command = ["train", "walk", "--seed", str(seed), "-n", str(TRAINED), "-o", folder, *settings]
        subprocess.run([sys.executable, "-m", "rlctl", *command], check=True, capture_output=True)
        (metrics,) = Path(folder).rglob("metrics.csv")
        with metrics.open() as file:
            rows = list(csv.DictReader(file))
    first, last = rows[0], rows[-1]
    return (float(last["steps"]) - float(first["steps"])) / (float(last["seconds"]) - float(first["seconds"]))
