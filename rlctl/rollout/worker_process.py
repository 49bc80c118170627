"""What runs in a worker: a few environments, stepped in turn. Started by `workers.py`; imports no torch.

Messages are JSON. The main process sends a command; the worker answers once, with `error` if one was raised, and
with the episodes that ended. Observations, actions, rewards and flags travel in shared memory.
"""

from __future__ import annotations

import contextlib
import fcntl
import gc
import itertools
import json
import math
import os
import signal
import sys
import threading
import traceback
from collections.abc import Callable
from multiprocessing.connection import Connection
from typing import Any

import numpy as np
from gymnasium import spaces

from rlctl.env_spec import EnvSpec
from rlctl.errors import RlctlError
from rlctl.rollout.shared_arrays import SINGLE, SharedArrays, observation_fields
from rlctl.run.env_info import describe
from rlctl.task.env import TaskEnv


class _Episode:
    """One environment and the episode it is in."""

    def __init__(self, env: Any, index: int) -> None:
        self.env = env
        self.index = index
        self.seed = -1
        self.step = 0
        self.active = False
        self._return = 0.0
        self._sums: dict[str, float] = {}

    def start(self, seed: int) -> Any:
        self.seed, self.step, self.active = seed, 0, True
        self._return, self._sums = 0.0, {}
        observation, _ = self.env.reset(seed=seed)
        return observation

    def count(self, reward: float, info: dict[str, Any]) -> None:
        self._return += reward
        sums = self._sums
        for name, value in info.get("reward_terms", {}).items():
            sums[name] = sums.get(name, 0.0) + value

    def summary(self, info: dict[str, Any]) -> dict[str, Any]:
        success = info.get("is_success")
        distance = info.get("metrics", info).get("distance")
        if not isinstance(distance, int | float | np.number):  # a plain environment may mean something else by it
            distance = None
        return {
            "env": self.index,
            "seed": self.seed,
            "return": self._return,
            "length": self.step,
            "success": None if success is None else bool(success),
            "terms": {name: float(value) for name, value in self._sums.items()},
            "final_distance": None if distance is None else float(distance),
        }


class _Worker:
    def __init__(self, descriptor: int, spec: EnvSpec, first: int, count: int, total: int) -> None:
        envs = [spec.make() for _ in range(count)]
        self.info = describe(envs[0])
        self.first = first
        self.term_names = list(self.info.reward_weights)
        self.episodes = [_Episode(env, first + i) for i, env in enumerate(envs)]
        space = envs[0].observation_space
        self.fields = observation_fields(space)
        self.space = space
        # A task's environment has looked at its observation itself.
        self.checked = isinstance(envs[0], TaskEnv) and not isinstance(space, spaces.Dict)
        self.action_space = envs[0].action_space
        self.discrete = isinstance(self.action_space, spaces.Discrete)
        self.total = total
        self.descriptor = descriptor
        self.arrays: SharedArrays

    def attach(self) -> None:
        self.arrays = SharedArrays(self.descriptor, self.total, self.space, self.action_space, len(self.term_names))

    def store(self, place: dict[str, Any], episode: _Episode, observation: Any) -> None:
        if self.checked:
            place[SINGLE][episode.index] = observation
            return
        parts = observation if isinstance(observation, dict) else {SINGLE: observation}
        if parts.keys() != place.keys():
            raise ValueError(f"observation has the keys {sorted(parts)}, the space has {sorted(place)}")
        for key, value in parts.items():
            row = place[key]
            shape, _ = self.fields[key]
            value = np.asarray(value)
            if value.shape != shape:
                what = f"observation {key!r}" if key else "observation"
                raise ValueError(f"{what} has shape {value.shape}, the space has {shape}")
            # A sum is finite unless an element is not, or it overflows: the slow check then tells.
            if (
                value.dtype.kind == "f"
                and not math.isfinite(np.add.reduce(value, None))
                and not np.isfinite(value).all()
            ):
                bad = int(np.flatnonzero(~np.isfinite(value))[0])
                raise ValueError(f"observation is not finite: element {bad} is {value.ravel()[bad]}")
            row[episode.index] = value

    def reset(self, pairs: list[tuple[int, int]]) -> list[dict[str, Any]]:
        for index, seed in pairs:
            episode = self.episodes[index - self.first]
            if seed < 0:
                episode.active = False
            else:
                self.guarded(episode, self.begin, seed)
        return []

    def relive(self, episodes: list[tuple[int, int, int]], data: bytes) -> list[dict[str, Any]]:
        """Begin episodes, (environment, seed, steps) each, and take the steps that led to where they were."""
        row = self.arrays.action[0]
        actions = iter(np.frombuffer(data, row.dtype).reshape(-1, *row.shape))
        ended: list[dict[str, Any]] = []
        for index, seed, steps in episodes:
            episode = self.episodes[index - self.first]
            self.arrays.next_seed[index] = -1
            self.guarded(episode, self.begin, seed)
            for action in itertools.islice(actions, steps):
                self.arrays.action[index] = action
                if episode.active:
                    self.guarded(episode, self.step_one, ended)
        return ended

    def begin(self, episode: _Episode, seed: int) -> None:
        self.arrays.inside[episode.index] = seed, 0
        self.store(self.arrays.observation, episode, episode.start(seed))

    def close(self) -> None:
        for episode in self.episodes:
            episode.env.close()
        self.episodes = []

    def step(self) -> list[dict[str, Any]]:
        ended: list[dict[str, Any]] = []
        for episode in self.episodes:
            if episode.active:
                self.guarded(episode, self.step_one, ended)
        return ended

    def step_one(self, episode: _Episode, ended: list[dict[str, Any]]) -> None:
        arrays, index = self.arrays, episode.index
        action = arrays.action[index]
        episode.step += 1
        arrays.inside[index, 1] = episode.step
        observation, reward, terminated, truncated, info = episode.env.step(
            int(action) if self.discrete else action.copy()
        )
        reward = float(reward)
        if not math.isfinite(reward):
            raise ValueError(f"reward is {reward}")
        episode.count(reward, info)
        arrays.reward[index] = reward
        arrays.terminated[index] = terminated
        arrays.truncated[index] = truncated
        if arrays.record[index]:
            arrays.terms[index] = list(info["metrics"].values())
        if not (terminated or truncated):
            self.store(arrays.observation, episode, observation)
            return
        self.store(arrays.final, episode, observation)
        ended.append(episode.summary(info))
        seed = int(arrays.next_seed[index])
        if seed >= 0:
            self.begin(episode, seed)
        else:
            episode.active = False

    def guarded(self, episode: _Episode, call: Callable[[_Episode, Any], None], argument: Any) -> None:
        try:
            call(episode, argument)
        except BaseException as error:  # a plugin may raise anything, SystemExit too
            raise _EpisodeFailed(episode) from error
        self.arrays.inside[episode.index, 1] = -1


class _EpisodeFailed(Exception):
    def __init__(self, episode: _Episode) -> None:
        super().__init__()
        self.where = {"env": episode.index, "seed": episode.seed, "step": episode.step}


def _error(error: BaseException) -> dict[str, Any]:
    where = error.where if isinstance(error, _EpisodeFailed) else {}
    cause = error.__cause__ if isinstance(error, _EpisodeFailed) and error.__cause__ else error
    ours = isinstance(cause, RlctlError)
    return {
        "message": str(cause) if ours else f"{type(cause).__name__}: {cause}",
        "kind": type(cause).__name__ if ours else None,
        "traceback": "".join(traceback.format_exception(cause)),
        **where,
    }


def _end_with_parent(parent: int, lifeline: int) -> None:
    """End this process when its parent ends, even while an environment is stuck in a step."""
    with contextlib.suppress(AttributeError, OSError):  # Linux only
        # By the system itself: no thread of ours runs while a library is stuck that holds Python's lock.
        fcntl.fcntl(lifeline, fcntl.F_SETOWN, os.getpid())
        fcntl.fcntl(lifeline, fcntl.F_SETSIG, signal.SIGKILL)
        fcntl.fcntl(lifeline, fcntl.F_SETFL, os.O_ASYNC)

    def watch() -> None:
        import select
        import time

        with contextlib.suppress(AttributeError, OSError):  # not on every system, nor in every sandbox
            descriptor = os.pidfd_open(parent)
            if os.getppid() == parent:
                select.select([descriptor], [], [])
        while os.getppid() == parent:
            time.sleep(1.0)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def main() -> None:
    """Serve commands until the connection closes. Arguments: connection, descriptor, and the job as JSON."""
    sys.stdout.reconfigure(line_buffering=True)  # type: ignore[union-attr]  # what is printed is told at once
    job = json.loads(sys.argv[3])
    _end_with_parent(job["parent"], int(sys.argv[4]))
    with contextlib.suppress(BrokenPipeError, ConnectionResetError):  # the main process has heard enough
        _serve(job)


def _serve(job: dict[str, Any]) -> None:
    connection = Connection(int(sys.argv[1]))

    def answer(**content: Any) -> None:
        connection.send_bytes(json.dumps(content).encode())

    try:
        worker = _built(job, job["spec"])
    except BaseException as error:
        answer(error=_error(error))
        return
    answer(info=worker.info.model_dump())
    while True:
        try:
            message = connection.recv_bytes()
        except (EOFError, OSError):
            break
        try:
            if message == b"step":
                ended = worker.step()
            elif message == b"attach":
                worker.attach()
                ended = []
            elif message.startswith(b"{"):
                worker.close()
                gc.unfreeze()
                gc.collect()  # environments may hold themselves in cycles
                worker = _built(job, json.loads(message))
                answer(info=worker.info.model_dump())
                continue
            elif message.startswith(b"relive "):
                ended = worker.relive(json.loads(message.removeprefix(b"relive ")), connection.recv_bytes())
            else:
                ended = worker.reset(json.loads(message))
        except BaseException as error:
            answer(error=_error(error))
            continue
        if ended:
            answer(ended=ended)
        else:
            connection.send_bytes(b"")
    worker.close()


def _built(job: dict[str, Any], spec: dict[str, Any]) -> _Worker:
    worker = _Worker(int(sys.argv[2]), EnvSpec(**spec), job["first"], job["count"], job["total"])
    gc.freeze()  # what is there now stays; collections need not look at it again
    return worker
