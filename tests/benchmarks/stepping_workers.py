"""Processes that take one step of each environment at a time: the fixed program to compare acting workers with.

It is how `Workers.step` was: actions, observations, rewards and flags in shared memory, and at every step a message to
each process and an answer from it, in JSON.
"""

from __future__ import annotations

import json
import os
from multiprocessing.connection import Connection
from typing import Any

import numpy as np
from gymnasium import spaces

import rlctl
from rlctl.rollout.child_process import ChildProcess, anonymous_file
from rlctl.rollout.running_episode import RunningEpisode
from rlctl.rollout.shared_arrays import Layout, map_arrays


class SteppingWorkers:
    """`n_envs` environments of a task with Box spaces on `n_workers` processes; episodes follow one another."""

    def __init__(self, task: str, n_envs: int, n_workers: int) -> None:
        env = rlctl.make(task)
        assert isinstance(env.action_space, spaces.Box)
        self._memory = anonymous_file()
        arrays = map_arrays(self._memory, layout := _layout(env, n_envs))
        env.close()
        self.observation, self.action = arrays["observation"], arrays["action"]
        plain = [(name, list(shape), str(dtype)) for name, (shape, dtype) in layout.items()]
        self._processes = [
            ChildProcess(
                "tests.benchmarks.stepping_workers:main",
                {"task": task, "memory": self._memory, "layout": plain, "envs": [int(each) for each in envs]},
                stdout=2,
                stderr=2,
                descriptors=(self._memory,),
            )
            for envs in np.array_split(np.arange(n_envs), n_workers)
        ]
        self._wait()

    def _wait(self) -> list[Any]:
        return [result for each in self._processes for result in json.loads(each.connection.recv_bytes())["ended"]]

    def step(self) -> list[Any]:
        """Step all environments with the rows of `action`; return the episodes that ended."""
        for each in self._processes:
            each.connection.send_bytes(json.dumps({"message": "Step"}).encode())
        return self._wait()

    def close(self) -> None:
        """End the processes."""
        for each in self._processes:
            each.close()
        os.close(self._memory)


def _layout(env: Any, n_envs: int) -> Layout:
    return {
        "action": ((n_envs, *env.action_space.shape), env.action_space.dtype),
        "observation": ((n_envs, *env.observation_space.shape), env.observation_space.dtype),
        "final": ((n_envs, *env.observation_space.shape), env.observation_space.dtype),
        "reward": ((n_envs,), np.dtype(np.float64)),
        "done": ((n_envs, 2), np.dtype(np.bool_)),
    }


def main(connection: Connection, task: str, memory: int, layout: list[Any], envs: list[int]) -> None:
    """Step environments until the connection closes."""
    arrays = map_arrays(memory, {name: (tuple(shape), np.dtype(dtype)) for name, shape, dtype in layout})
    episodes = [RunningEpisode(rlctl.make(task), index) for index in envs]
    for episode in episodes:
        arrays["observation"][episode.index] = episode.start(episode.index)
    ended: list[Any] = []
    while True:
        connection.send_bytes(json.dumps({"ended": ended}).encode())
        try:
            connection.recv_bytes()
        except EOFError:
            return
        ended = []
        for episode in episodes:
            index = episode.index
            episode.step += 1
            observation, reward, terminated, truncated, info = episode.take_step(arrays["action"][index])
            arrays["reward"][index], arrays["done"][index] = reward, (terminated, truncated)
            if terminated or truncated:
                arrays["final"][index] = observation
                ended.append(vars(episode.summarize(info, 0, {})))
                observation = episode.start(episode.seed + 1)
            arrays["observation"][index] = observation
