"""What runs in a worker: a few environments, and a policy that plays them. Started by `workers.py`; imports no torch.

The main process sends a message (`messages.py`); the worker answers once, as JSON, with `error` if one was raised, and
with the episodes that ended. Observations, actions, rewards, flags and a policy's numbers are in shared memory.
"""

from __future__ import annotations

import dataclasses
import functools
import gc
import itertools
import json
import math
import sys
from collections.abc import Callable, Iterator
from multiprocessing.connection import Connection
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from rlctl.dict_spaces import SINGLE, split, split_space
from rlctl.env_spec import EnvSpec, make_several
from rlctl.errors import describe_exception
from rlctl.rollout import goal_rewards, messages, returned_values
from rlctl.rollout.baselines import make_player
from rlctl.rollout.failures import FailedInEpisode, encode_error
from rlctl.rollout.returned_values import InvalidReturn
from rlctl.rollout.seeds import EpisodeAddress, Stream
from rlctl.rollout.shared_arrays import SharedArrays, map_arrays, observation_fields
from rlctl.rollout.worker_output import write_stderr
from rlctl.run.acting import Exploration, Player, PolicyPlayer
from rlctl.run.env_info import describe
from rlctl.run.policy import PolicyInfo
from rlctl.task.env import TaskEnv
from rlctl.task.events import Event, EventSettings, push


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
        self._deepest_contact: float | None = None

    def start(self, seed: int) -> Any:
        self.seed, self.step, self.active = seed, 0, True
        self._return, self._sums, self._deepest_contact = 0.0, {}, None
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

    def measure_contact(self) -> None:
        """Remember how far bodies overlap now, if it is the most so far."""
        self._deepest_contact = max(self._deepest_contact or 0.0, self.env.unwrapped.sim.deepest_contact)

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
            "deepest_contact": self._deepest_contact,
        }


@dataclasses.dataclass(frozen=True)
class Job:
    """What a worker is for: `count` of `total` environments, from number `first` on."""

    memory: int
    """Descriptor of the file of the shared arrays."""
    numbers: int
    """Descriptor of the file of a policy's numbers."""
    first: int
    count: int
    total: int


class Worker:
    """A few environments and what plays them."""

    def __init__(self, job: Job, spec: EnvSpec) -> None:
        envs = make_several(spec, job.count)
        self.job = job
        self.info = describe(envs[0])
        self.episodes = [_Episode(env, job.first + i) for i, env in enumerate(envs)]
        space = envs[0].observation_space
        self.space, self.action_space = space, envs[0].action_space
        self.fields = observation_fields(space)
        self.categories = {key: returned_values.category_bounds(part) for key, part in split_space(space).items()}
        # A task's environment has checked its observation itself.
        self.checked = isinstance(envs[0], TaskEnv) and not isinstance(space, spaces.Dict)
        self.discrete = isinstance(self.action_space, spaces.Discrete)
        self.arrays: SharedArrays
        self.player: Player
        self._states: NDArray[Any] | None = None

    def set_events(self, message: messages.SetEvents) -> None:
        """Let other events act in all environments; none of them is in an episode then."""
        spec = EnvSpec(**message.spec)
        added = (
            {}
            if message.push is None
            else {"push at mid-episode": Event("interval", push, enabled=True, **message.push)}
        )
        for episode in self.episodes:
            env = episode.env.unwrapped
            if not isinstance(env, TaskEnv):
                raise TypeError(f"{spec.task}: a plain Gymnasium environment has no events")
            env.set_events(EventSettings(spec.randomize, spec.events), added)
            env.set_level(spec.level)
            episode.active = False
        self.info = describe(self.episodes[0].env)

    def attach(self, message: messages.Attach) -> None:
        """Map the shared arrays."""
        terms = len(self.info.reward_weights)
        self.arrays = SharedArrays(
            self.job.memory, self.job.total, (self.space, self.action_space), terms, message.steps
        )

    def load_policy(self, message: messages.LoadPolicy) -> None:
        """Act with another policy from now on."""
        self._states = None
        self._close_player()
        if message.info is None:
            self.player = make_player(message.other, self.action_space, self.space)
        else:
            layout = {name: (tuple(shape), np.dtype(dtype)) for name, shape, dtype in message.layout}
            tensors = map_arrays(self.job.numbers, layout)
            self._states = tensors.pop("state", None)
            self.player = PolicyPlayer(PolicyInfo.model_validate(message.info), tensors)

    def limit_actions(self, message: messages.LimitActions) -> None:
        """Let the policy act within limits from now on."""
        from rlctl.deploy.limited_player import LimitedPlayer  # few evaluations need it
        from rlctl.deploy.limits import Limits

        self.player = LimitedPlayer(self.player, self.info, Limits.model_validate(message.limits))

    def store(self, target: dict[str, Any], index: int, episode: _Episode, observation: Any) -> None:
        """Write an observation into row `index` of the arrays of `target`, and check it."""
        if self.checked:
            target[SINGLE][index] = observation
            return
        parts = split(observation)
        if parts.keys() != target.keys():
            raise InvalidReturn(f"observation has the keys {sorted(parts)}, the space has {sorted(target)}")
        for key, value in parts.items():
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
            target[key][index] = value

    def note_cast(self, episode: _Episode, key: str, value: Any) -> None:
        """Count an observation that comes with a dtype that its space's cannot hold."""
        returned_values.check_numeric(value, _named(key))
        if not np.can_cast(value.dtype, self.fields[key][1]):
            count = self.arrays.cast[episode.index, 0] + 1
            self.arrays.cast[episode.index] = count, ord(value.dtype.char), list(self.fields).index(key)

    def reset(self, message: messages.Reset) -> None:
        """Begin episodes, or let environments rest."""
        for index, seed in message.seeds:
            episode = self.episodes[index - self.job.first]
            if seed < 0:
                episode.active = False
            else:
                self.call_in_episode(episode, self.begin, seed)

    def begin(self, episode: _Episode, seed: int) -> None:
        """Begin an episode; its first observation is the present one."""
        self.arrays.inside[episode.index] = seed, 0, -1
        self.store(self.arrays.observation, episode.index, episode, episode.start(seed))

    def replay_actions(self, message: messages.ReplayActions, data: bytes) -> list[dict[str, Any]]:
        """Begin episodes, (environment, seed, steps) each, and take the steps that led to where they were."""
        row = self.arrays.action[0]
        actions = iter(np.frombuffer(data, row.dtype).reshape(-1, *row.shape))
        ended: list[dict[str, Any]] = []
        for index, seed, steps in message.episodes:
            self.arrays.next_seed[index] = -1
            episode, taken = self.episodes[index - self.job.first], list(itertools.islice(actions, steps))
            try:
                self.call_in_episode(episode, self.begin, seed)
                for action in taken:
                    self.arrays.action[index] = action
                    if episode.active:
                        self.call_in_episode(episode, self.step_one, ended)
            except FailedInEpisode as failure:
                # It did not fail the first time, so its state differs now: it may begin its next episode.
                episode.active = False
                ended.append({"env": index})
                write_stderr(f"{failure} when it was replayed")
        return ended

    def play(self, message: messages.Play) -> list[dict[str, Any]]:
        """Play a segment in some environments, one after the other; return the episodes that ended."""
        ended: list[dict[str, Any]] = []
        self.player.explore(Exploration(**message.exploration))
        started = message.episodes_started or [0] * len(message.envs)
        for index, seed, number in zip(message.envs, message.begin, started, strict=True):
            next_seeds = _training_seeds(message.run_seed, index, number)
            self.call_in_episode(self.episodes[index - self.job.first], self.play_one, message, ended, seed, next_seeds)
        return ended

    def play_one(
        self,
        episode: _Episode,
        message: messages.Play,
        ended: list[dict[str, Any]],
        seed: int,
        next_seeds: Iterator[int],
    ) -> None:
        """Play up to `message.steps` steps of one environment into its rows of the segment."""
        arrays, index, player = self.arrays, episode.index, self.player
        segment = arrays.segment
        inside = arrays.inside
        now = {key: rows[index] for key, rows in segment.observation.items()}
        single = now.get(SINGLE)
        stored, taken, rewards = segment.stored[index], segment.action[index], segment.reward[index]
        state = None if self._states is None else self._states[index]
        if seed >= 0:
            self.begin(episode, seed)
            if state is not None:
                state[:] = 0.0
        if player.state is not None and state is not None:
            player.state[:] = state
        for key, rows in now.items():
            rows[0] = arrays.observation[key][index]
        player.begin_segment(episode.seed, episode.step)
        row = 0
        while row < message.steps:
            observation = single[row] if single is not None else {key: rows[row] for key, rows in now.items()}
            chosen, action = player.act(observation, episode.seed, episode.step)
            stored[row] = np.ravel(chosen)
            taken[row] = action
            episode.step += 1
            inside[index] = episode.seed, episode.step, row
            observation, reward, terminated, truncated, info = self.take_step(episode, taken[row])
            rewards[row] = reward
            segment.terminated[index, row], segment.truncated[index, row] = terminated, truncated
            if message.record:
                segment.terms[index, row] = list(info["metrics"].values())
            if message.contacts:
                episode.measure_contact()
            row += 1
            if not (terminated or truncated):
                self.store(now, row, episode, observation)
                continue
            ended.append({**episode.summary(info), "row": row - 1, "report": player.report()})
            if message.until_end and not message.episodes_started:
                self.store(now, row, episode, observation)
                episode.active = False
                break
            self.store({key: rows[index] for key, rows in segment.final.items()}, row - 1, episode, observation)
            inside[index] = (seed := next(next_seeds)), 0, row
            self.store(now, row, episode, episode.start(seed))
            if player.state is not None:
                player.state[:] = 0.0
            if message.until_end:
                break
        for key, rows in now.items():
            arrays.observation[key][index] = rows[row]
        if player.state is not None and state is not None:
            state[:] = player.state

    def step(self) -> list[dict[str, Any]]:
        """Step all active environments once, with the actions of `arrays.action`."""
        ended: list[dict[str, Any]] = []
        for episode in self.episodes:
            if episode.active:
                self.call_in_episode(episode, self.step_one, ended)
        return ended

    def step_one(self, episode: _Episode, ended: list[dict[str, Any]]) -> None:
        """Step an environment with its row of `arrays.action`; begin the next episode where one ends."""
        arrays, index = self.arrays, episode.index
        episode.step += 1
        arrays.inside[index, 1] = episode.step
        observation, reward, terminated, truncated, info = self.take_step(episode, arrays.action[index])
        arrays.reward[index] = reward
        arrays.terminated[index] = terminated
        arrays.truncated[index] = truncated
        if arrays.record[index]:
            arrays.terms[index] = list(info["metrics"].values())
        if not (terminated or truncated):
            self.store(arrays.observation, index, episode, observation)
            return
        self.store(arrays.final, index, episode, observation)
        ended.append(episode.summary(info))
        seed = int(arrays.next_seed[index])
        if seed >= 0:
            self.begin(episode, seed)
        else:
            episode.active = False

    def take_step(self, episode: _Episode, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Step an environment, and return what it returned, checked; the observation is checked where it is stored."""
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
            terminated = returned_values.to_bool(terminated, "terminated")
            truncated = returned_values.to_bool(truncated, "truncated")
        episode.count(reward, info)
        return observation, reward, terminated, truncated, info

    def call_in_episode(self, episode: _Episode, call: Callable[..., None], *arguments: Any) -> None:
        """Call what may run the code of an environment; raises `FailedInEpisode` for anything it raises."""
        try:
            call(episode, *arguments)
        except BaseException as error:  # a plugin may raise anything, SystemExit too
            raise FailedInEpisode(episode.index, episode.seed, episode.step) from error
        self.arrays.inside[episode.index, 1] = -1

    def _close_player(self) -> None:
        if (player := getattr(self, "player", None)) is not None:  # there is none before the first policy
            player.close()

    def close(self) -> None:
        """Close the environments, and what plays them."""
        self._close_player()
        for episode in self.episodes:
            try:
                episode.env.close()
            except BaseException as error:  # its episodes are over
                write_stderr(f"warning: closing environment {episode.index}: {describe_exception(error)}")
        self.episodes = []


def main(connection: Connection, spec: dict[str, Any], job: dict[str, Any]) -> None:
    """Serve messages until the connection closes."""
    sys.stdout.reconfigure(line_buffering=True)  # type: ignore[union-attr]  # lines are forwarded at once
    try:
        _serve(connection, Job(**job), spec)
    except (BrokenPipeError, ConnectionResetError):  # the main process needs no more answers
        return
    except OSError as error:
        reason = error.strerror
        write_stderr(
            f"no connection to rlctl any more ({reason}): did an environment close a file descriptor of rlctl?"
        )
        sys.exit(1)


def _serve(connection: Connection, job: Job, spec: dict[str, Any]) -> None:
    worker: Worker | None = None

    def build(spec: dict[str, Any]) -> dict[str, Any]:
        nonlocal worker
        if worker is not None:
            worker.close()
            worker = None
            gc.unfreeze()
            gc.collect()  # environments may hold themselves in cycles
        worker = Worker(job, EnvSpec(**spec))
        gc.freeze()  # what is there now stays; collections need not look at it again
        return {"info": worker.info.model_dump()}

    def answer(message: messages.Message) -> dict[str, Any]:
        if isinstance(message, messages.Build):
            return build(message.spec)
        assert worker is not None  # it was built before anything else is asked
        match message:
            case messages.Play():
                return {"ended": worker.play(message)}
            case messages.Step():
                return {"ended": worker.step()}
            case messages.ReplayActions():
                return {"ended": worker.replay_actions(message, connection.recv_bytes())}
            case messages.ComputeRewards():
                return {"rewards": goal_rewards.compute_answer(worker.episodes[0].env, connection.recv_bytes())}
            case messages.SetEvents():
                worker.set_events(message)
                return {"info": worker.info.model_dump()}
            case messages.Attach():
                worker.attach(message)
            case messages.LoadPolicy():
                worker.load_policy(message)
            case messages.LimitActions():
                worker.limit_actions(message)
            case messages.Reset():
                worker.reset(message)
        return {}

    def send(call: Callable[[], dict[str, Any]]) -> bool:
        try:
            content = call()
        except BaseException as error:
            content = {"error": encode_error(error)}
        connection.send_bytes(json.dumps(content).encode())
        return "error" not in content

    if not send(lambda: build(spec)):
        return
    while True:
        try:
            content = connection.recv_bytes()
        except (EOFError, ConnectionResetError):
            break
        send(functools.partial(answer, messages.decode(content)))
    if worker is not None:
        worker.close()


def _training_seeds(run_seed: int, env: int, episode: int) -> Iterator[int]:
    """Yield the seeds of an environment's training episodes, from a number on."""
    for number in itertools.count(episode):
        yield EpisodeAddress(run_seed, Stream.TRAIN, env, number).seed


def _named(key: str) -> str:
    return f"observation {key!r}" if key else "observation"
