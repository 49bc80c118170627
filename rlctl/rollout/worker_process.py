"""What runs in a worker: a few environments, stepped in turn. Started by `workers.py`; imports no torch.

Messages are JSON. The main process sends a command; the worker answers once, with `error` if one was raised, and
with the episodes that ended. Observations, actions, rewards and flags travel in shared memory.
"""

from __future__ import annotations

import gc
import itertools
import json
import math
import sys
from collections.abc import Callable
from multiprocessing.connection import Connection
from typing import Any

import numpy as np
from gymnasium import spaces

from rlctl.dict_spaces import SINGLE, split, split_space
from rlctl.env_spec import EnvSpec, make_several
from rlctl.errors import describe_exception
from rlctl.rollout import goal_rewards, returned_values
from rlctl.rollout.failures import FailedInEpisode, encode_error
from rlctl.rollout.process_group import end_with_parent
from rlctl.rollout.returned_values import InvalidReturn
from rlctl.rollout.shared_arrays import SharedArrays, observation_fields
from rlctl.rollout.worker_output import write_stderr
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
        observation, info = returned_values.check_tuple(self.env.reset(seed=seed), returned_values.RESET, "reset")
        returned_values.check_info(info)
        return observation

    def count(self, reward: float, info: dict[str, Any]) -> None:
        self._return += reward
        sums = self._sums
        try:
            for name, value in info.get("reward_terms", {}).items():
                sums[name] = sums.get(name, 0.0) + value
        except (TypeError, AttributeError):
            raise InvalidReturn(f"info['reward_terms'] is {info['reward_terms']!r}, not a dict of numbers") from None

    def summary(self, info: dict[str, Any]) -> dict[str, Any]:
        success = info.get("is_success")
        metrics = info.get("metrics")  # of a plain environment it may be anything
        distance = (metrics if isinstance(metrics, dict) else info).get("distance")
        if not isinstance(distance, int | float | np.number):  # a plain environment may mean something else by it
            distance = None
        return {
            "env": self.index,
            "seed": self.seed,
            "return": self._return,
            "length": self.step,
            "success": None if success is None else bool(returned_values.to_float(success, "info['is_success']")),
            "terms": {
                str(name): returned_values.to_float(value, f"reward term {name}") for name, value in self._sums.items()
            },
            "final_distance": None if distance is None else float(distance),
        }


class _Worker:
    def __init__(self, descriptor: int, spec: EnvSpec, first: int, count: int, total: int) -> None:
        envs = make_several(spec, count)
        self.info = describe(envs[0])
        self.first = first
        self.term_names = list(self.info.reward_weights)
        self.episodes = [_Episode(env, first + i) for i, env in enumerate(envs)]
        space = envs[0].observation_space
        self.fields = observation_fields(space)
        self.categories = {key: returned_values.category_bounds(part) for key, part in split_space(space).items()}
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

    def store(self, target: dict[str, Any], episode: _Episode, observation: Any) -> None:
        if self.checked:
            target[SINGLE][episode.index] = observation
            return
        parts = split(observation)
        if parts.keys() != target.keys():
            raise InvalidReturn(f"observation has the keys {sorted(parts)}, the space has {sorted(target)}")
        for key, value in parts.items():
            row = target[key]
            shape, dtype = self.fields[key]
            value = np.asarray(value)
            if value.shape != shape:
                raise InvalidReturn(f"{_named(key)} has shape {value.shape}, the space has {shape}")
            if value.dtype is not dtype:
                self.note_cast(episode, key, value)
            # A sum is finite unless an element is not, or it overflows: the slow check decides.
            if (
                value.dtype.kind == "f"
                and not math.isfinite(np.add.reduce(value, None))
                and (error := returned_values.find_not_finite(value, _named(key)))
            ):
                raise error
            limits = self.categories[key]
            if limits is not None and not ((limits[0] <= value) & (value <= limits[1])).all():
                raise InvalidReturn(f"{_named(key)} is {value}, the space has {limits[0]} to {limits[1]}")
            row[episode.index] = value

    def note_cast(self, episode: _Episode, key: str, value: Any) -> None:
        returned_values.check_numeric(value, _named(key))
        if not np.can_cast(value.dtype, self.fields[key][1]):
            count = self.arrays.cast[episode.index, 0] + 1
            self.arrays.cast[episode.index] = count, ord(value.dtype.char), list(self.fields).index(key)

    def reset(self, pairs: list[tuple[int, int]]) -> list[dict[str, Any]]:
        for index, seed in pairs:
            episode = self.episodes[index - self.first]
            if seed < 0:
                episode.active = False
            else:
                self.call_in_episode(episode, self.begin, seed)
        return []

    def replay_actions(self, episodes: list[tuple[int, int, int]], data: bytes) -> list[dict[str, Any]]:
        """Begin episodes, (environment, seed, steps) each, and take the steps that led to where they were."""
        row = self.arrays.action[0]
        actions = iter(np.frombuffer(data, row.dtype).reshape(-1, *row.shape))
        ended: list[dict[str, Any]] = []
        for index, seed, steps in episodes:
            self.arrays.next_seed[index] = -1
            try:
                self.replay_episode(index, seed, list(itertools.islice(actions, steps)), ended)
            except FailedInEpisode as failure:
                # It did not fail the first time, so its state differs now: it may begin its next episode.
                self.episodes[index - self.first].active = False
                ended.append({"env": index})
                write_stderr(f"{failure} when it was replayed")
        return ended

    def replay_episode(self, index: int, seed: int, actions: list[Any], ended: list[dict[str, Any]]) -> None:
        episode = self.episodes[index - self.first]
        self.call_in_episode(episode, self.begin, seed)
        for action in actions:
            self.arrays.action[index] = action
            if episode.active:
                self.call_in_episode(episode, self.step_one, ended)

    def begin(self, episode: _Episode, seed: int) -> None:
        self.arrays.inside[episode.index] = seed, 0
        self.store(self.arrays.observation, episode, episode.start(seed))

    def close(self) -> None:
        for episode in self.episodes:
            try:
                episode.env.close()
            except BaseException as error:  # its episodes are over
                write_stderr(f"warning: closing environment {episode.index}: {describe_exception(error)}")
        self.episodes = []

    def step(self) -> list[dict[str, Any]]:
        ended: list[dict[str, Any]] = []
        for episode in self.episodes:
            if episode.active:
                self.call_in_episode(episode, self.step_one, ended)
        return ended

    def step_one(self, episode: _Episode, ended: list[dict[str, Any]]) -> None:
        arrays, index = self.arrays, episode.index
        action = arrays.action[index]
        episode.step += 1
        arrays.inside[index, 1] = episode.step
        given = episode.env.step(int(action) if self.discrete else action.copy())
        if given.__class__ is not tuple or len(given) != 5:
            given = returned_values.check_tuple(given, returned_values.STEP, "step")
        observation, reward, terminated, truncated, info = given
        if reward.__class__ is not float:
            reward = returned_values.to_float(reward, "reward")
        if not math.isfinite(reward):
            raise InvalidReturn(f"reward is {reward}")
        if info.__class__ is not dict:
            returned_values.check_info(info)
        if terminated.__class__ is not bool or truncated.__class__ is not bool:
            terminated, truncated = (
                returned_values.to_bool(terminated, "terminated"),
                returned_values.to_bool(truncated, "truncated"),
            )
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

    def call_in_episode(self, episode: _Episode, call: Callable[[_Episode, Any], None], argument: Any) -> None:
        try:
            call(episode, argument)
        except BaseException as error:  # a plugin may raise anything, SystemExit too
            raise FailedInEpisode(episode.index, episode.seed, episode.step) from error
        self.arrays.inside[episode.index, 1] = -1


def main() -> None:
    """Serve commands until the connection closes. Arguments: connection, descriptor, and the job as JSON."""
    sys.stdout.reconfigure(line_buffering=True)  # type: ignore[union-attr]  # lines are forwarded at once
    job = json.loads(sys.argv[3])
    end_with_parent(job["parent"], int(sys.argv[4]))
    try:
        _serve(job)
    except (BrokenPipeError, ConnectionResetError):  # the main process has heard enough
        return
    except OSError as error:
        reason = error.strerror
        write_stderr(
            f"no connection to rlctl any more ({reason}): did an environment close a file descriptor of rlctl?"
        )
        sys.exit(1)


def _named(key: str) -> str:
    return f"observation {key!r}" if key else "observation"


def _serve(job: dict[str, Any]) -> None:
    connection = Connection(int(sys.argv[1]))

    def answer(**content: Any) -> None:
        connection.send_bytes(json.dumps(content).encode())

    try:
        worker = _built(job, job["spec"])
    except BaseException as error:
        answer(error=encode_error(error))
        return
    answer(info=worker.info.model_dump())
    while True:
        try:
            message = connection.recv_bytes()
        except (EOFError, ConnectionResetError):
            break
        try:
            if message == b"step":
                ended = worker.step()
            elif message == b"attach":
                worker.attach()
                ended = []
            elif message.startswith(goal_rewards.PREFIX):
                answer(rewards=goal_rewards.compute_answer(worker.episodes[0].env, message))
                continue
            elif message.startswith(b"{"):
                worker.close()
                gc.unfreeze()
                gc.collect()  # environments may hold themselves in cycles
                worker = _built(job, json.loads(message))
                answer(info=worker.info.model_dump())
                continue
            elif message.startswith(b"replay_actions "):
                ended = worker.replay_actions(
                    json.loads(message.removeprefix(b"replay_actions ")), connection.recv_bytes()
                )
            else:
                ended = worker.reset(json.loads(message))
        except BaseException as error:
            answer(error=encode_error(error))
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
