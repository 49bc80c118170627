"""How fast the five classics are, against pybullet-envs-gymnasium: the same task, the same actions, in one process."""

from __future__ import annotations

import time
from functools import partial
from typing import Any

import gymnasium
import numpy as np
import pybullet_envs_gymnasium  # noqa: F401  # registers the reference
from numpy.typing import NDArray

import rlctl
from tests.benchmarks.row import Row, side_by_side

STEPS = 500  # in a round
REFERENCES = {
    "ant": "AntBulletEnv-v0",
    "half-cheetah": "HalfCheetahBulletEnv-v0",
    "hopper": "HopperBulletEnv-v0",
    "walker2d": "Walker2DBulletEnv-v0",
    "humanoid": "HumanoidBulletEnv-v0",
}


def _row(task: str, target: float, repeat: int) -> Row:
    ours: Any = rlctl.make(task)
    theirs = gymnasium.make(REFERENCES[task]).unwrapped
    actions = np.random.default_rng(0).uniform(-1, 1, (STEPS, *ours.action_space.shape)).astype(np.float32)
    for env in (ours, theirs):
        _steps_per_second(env, actions)
    pair = side_by_side(
        lambda: _steps_per_second(ours, actions), lambda: _steps_per_second(theirs, actions), 4 * repeat + 1
    )
    ours.close()
    theirs.close()
    return Row(
        task,
        f"{pair.ours:,.0f} steps/s",
        f"{pair.theirs:,.0f} steps/s",
        f"{pair.ratio:.2f}x",
        f">= {target}x",
        pair.ratio >= target,
        f"{REFERENCES[task]} without Gymnasium's wrappers; random actions, bit-equal episodes, resets not counted",
    )


def _steps_per_second(env: Any, actions: NDArray[np.float32]) -> float:
    env.reset(seed=0)
    seconds = 0.0
    for action in actions:
        began = time.perf_counter()
        _, _, terminated, _, _ = env.step(action)
        seconds += time.perf_counter() - began
        if terminated:
            env.reset()
    return len(actions) / seconds


ant = partial(_row, "ant", 1.6)
half_cheetah = partial(_row, "half-cheetah", 1.6)
hopper = partial(_row, "hopper", 1.6)
walker2d = partial(_row, "walker2d", 1.6)
humanoid = partial(_row, "humanoid", 1.3)
