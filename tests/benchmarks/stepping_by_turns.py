"""The program that acting workers are compared with; it runs with the rlctl of `acting.BEFORE`, not with today's.

Every environment takes one step at a time in a worker, and between two steps torch computes all actions at once. Reads
how many segments to play, a line each, and writes environment steps per second.
"""

from __future__ import annotations

import importlib
import itertools
import sys
import time
from typing import Any

import numpy as np
import torch

# Where they were in that commit.
EnvSpec: Any = importlib.import_module("rlctl.env_spec").EnvSpec
Workers: Any = importlib.import_module("rlctl.rollout.workers").Workers


def main(task: str, n_envs: int, steps: int, hidden: int) -> None:
    torch.set_num_threads(1)
    workers: Any = Workers(EnvSpec(task), n_envs)
    arrays = workers.arrays
    workers.reset({env: env for env in range(n_envs)})
    arrays.next_seed[:] = np.arange(n_envs)
    observation_space, action_space = workers.info.spaces()
    rng = np.random.default_rng(0)
    sizes = [observation_space.shape[0], hidden, hidden, action_space.shape[0]]
    weights = [
        torch.from_numpy((0.1 * rng.standard_normal((before, after))).astype(np.float32))
        for before, after in itertools.pairwise(sizes)
    ]
    mean, scale = np.zeros(sizes[0]), np.ones(sizes[0])
    print("ready", flush=True)
    for line in sys.stdin:
        began = time.perf_counter()
        for _ in range(int(line) * steps):
            value = torch.from_numpy(np.clip((workers.observations() - mean) / scale, -10, 10).astype(np.float32))
            with torch.no_grad():
                for weight in weights[:-1]:
                    value = torch.tanh(value @ weight)
                action = torch.normal(value @ weights[-1], 0.5).numpy()
            arrays.action[:] = np.clip(action, action_space.low, action_space.high)
            workers.step()
        print(int(line) * steps * n_envs / (time.perf_counter() - began), flush=True)
    workers.close()


if __name__ == "__main__":
    main(sys.argv[1], *(int(text) for text in sys.argv[2:]))
