"""For each task: a step's time, the part of it in `stepSimulation`, and a reset's time. Python outside is waste."""

from __future__ import annotations

import statistics
import time
from functools import partial
from typing import Any

import numpy as np

import rlctl
from rlctl.task.pybullet.library import pybullet
from tests.benchmarks.row import Row

STEPS = 500


def _row(task: str, part: float, repeat: int) -> Row:
    """`part` of a step's time is to be physics."""
    env: Any = rlctl.make(task).unwrapped
    rounds = [_measure_steps(env) for _ in range(repeat)]
    step_s, physics_s = (statistics.median(each) for each in zip(*rounds, strict=True))
    reset_s = statistics.median(_measure_reset(env, seed) for seed in range(20))
    env.close()
    share = physics_s / step_s
    return Row(
        task,
        f"{1e6 * step_s:,.0f} us a step",
        f"{1e6 * physics_s:,.0f} us in stepSimulation",
        f"{share:.0%}, reset {1e3 * reset_s:.2g} ms",
        f">= {part:.0%}, < 10 ms",
        share >= part and reset_s < 0.01,
        "random actions; the rest is act, observe, rewards and checks",
    )


def _measure_steps(env: Any) -> tuple[float, float]:
    """Return the time of a step and of its physics [s], means over `STEPS` steps without resets."""
    rng, physics_s, all_s = np.random.default_rng(0), 0.0, 0.0
    simulate = pybullet.stepSimulation

    def timed(**keywords: Any) -> None:
        nonlocal physics_s
        began = time.perf_counter()
        simulate(**keywords)
        physics_s += time.perf_counter() - began

    env.reset(seed=0)
    pybullet.stepSimulation = timed
    try:
        for _ in range(STEPS):
            action = rng.uniform(-1, 1, env.action_space.shape)
            began = time.perf_counter()
            _, _, terminated, truncated, _ = env.step(action)
            all_s += time.perf_counter() - began
            if terminated or truncated:
                env.reset()
    finally:
        pybullet.stepSimulation = simulate
    return all_s / STEPS, physics_s / STEPS


def _measure_reset(env: Any, seed: int) -> float:
    began = time.perf_counter()
    env.reset(seed=seed)
    return time.perf_counter() - began


# Half of a step is to be physics; 40 % in reach-sparse, where that is only 0.1 ms.
biped = partial(_row, "biped", 0.5)
biped_3d = partial(_row, "biped-3d", 0.5)
quadruped = partial(_row, "quadruped", 0.5)
kuka_grasp = partial(_row, "kuka-grasp", 0.5)
gear_arm = partial(_row, "gear-arm", 0.5)
reach_sparse = partial(_row, "reach-sparse", 0.4)
