"""A worker: a process with a few environments and a policy; imports no torch.

The worker answers each message (`messages.py`) of the main process once. Observations, actions, rewards, flags and the
policy's parameters are in shared memory.
"""

import contextlib
import dataclasses
import gc
from collections.abc import Iterator
from multiprocessing.connection import Connection
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from rlctl.environments.dict_spaces import SINGLE
from rlctl.environments.info import EnvInfo, describe
from rlctl.environments.teacher_view import find_teacher_view, strip_teacher_view
from rlctl.errors import describe_exception
from rlctl.library_output import print_whole_lines
from rlctl.play import messages
from rlctl.play.batch_episodes import BatchEpisodes
from rlctl.play.messages import Answer, EpisodeResult, FailedInEpisode, Message, describe_failure
from rlctl.play.running_episode import (
    CriticWriter,
    ObservationWriter,
    RunningEpisode,
    compute_rewards,
    show_critic,
)
from rlctl.play.seeds import list_training_seeds
from rlctl.play.shared_arrays import SharedArrays, map_arrays
from rlctl.play.shared_world import make_watched
from rlctl.play.teaching import check_teacher
from rlctl.policy.actor import Actor, Rows, as_rows
from rlctl.policy.file import PolicyFile
from rlctl.policy.load import load_actor
from rlctl.policy.named_actors import SERVER, make_actor
from rlctl.policy.numpy_actor import NumpyActor
from rlctl.printed_lines import print_line
from rlctl.processes.pool import answer_messages
from rlctl.task.env import TaskEnv
from rlctl.task.events import Event, EventSettings, push


class Worker:
    """A few environments and the policy that plays them; the first message must be `Build`."""

    def __init__(self, job: messages.WorkerJob) -> None:
        self._job = job
        self._episodes: list[RunningEpisode] = []
        self._actor: Actor | None = None
        """Its rows are the environments of this worker."""
        self._teacher: Actor | None = None
        self._batch: BatchEpisodes | None = None
        """The worlds of a `BatchTask`; then `_episodes` has one environment that only describes them."""
        self._states: NDArray[np.float32] | None = None
        """Recurrent states of the rows, which the main process sees too, shape (n, 2, layers, hidden)."""
        self._info: EnvInfo
        self._privileged: dict[str, int] = {}  # sizes of what only the critic sees
        self._arrays: SharedArrays

    def answer(self, message: Message) -> Answer:
        """Execute a message and return the answer."""
        match message:
            case messages.Play():
                return Answer(ended=self._play(message))
            case messages.BeginEpisodes():
                return Answer(left=self._begin_episodes(message))
            case messages.ComputeRewards():
                return Answer(rewards=compute_rewards(self._episodes[0].env, message.achieved, message.desired))
            case messages.Build():
                return self._build(message)
            case messages.SetEvents():
                return Answer(info=self._set_events(message))
            case messages.Attach():
                size = sum(self._privileged.values())
                self._arrays = SharedArrays(self._job.memory, self._info, self._job.total, message.steps, size)
            case messages.LoadPolicy():
                self._load_policy(message)
            case messages.LimitActions():
                self._limit_actions(message)
        return Answer()

    def _build(self, message: messages.Build) -> Answer:
        spec, privileged, teacher = message.spec, message.privileged, message.teacher
        taught_by = None if teacher is None else teacher.spec
        if self._episodes:
            self.close()
            gc.unfreeze()
            gc.collect()  # environments may hold themselves in cycles
        shared_world = None
        if self._job.count > 1 and not spec.is_batch:
            first, shared_world = make_watched(spec, taught_by)
        else:
            first = spec.make(teacher=taught_by, visuals=False)
        envs = [first]
        self._teacher = None
        if teacher is not None:
            check_teacher(teacher, first)
            self._teacher = load_actor(Path(teacher.policy), self._job.count)
        self._privileged = {} if privileged is None else show_critic(spec, first, privileged)
        if (batch := spec.make_batch(first, self._job.count)) is not None:
            self._batch = BatchEpisodes(batch, self._job.first)
            self._batch.teacher = self._teacher
        elif shared_world is None:
            envs += [spec.make(teacher=taught_by, visuals=False) for _ in range(self._job.count - 1)]
            for env in envs[1:] if privileged is not None else ():
                show_critic(spec, env, privileged or {})
        self._info = describe(envs[0])
        metrics = [name for name, weight in self._info.reward_weights.items() if weight == 0]
        self._episodes = [RunningEpisode(env, self._job.first + index, metrics) for index, env in enumerate(envs)]
        space = envs[0].observation_space
        # A task's environment checks its observations itself.
        checked = isinstance(strip_teacher_view(envs[0]), TaskEnv) and not isinstance(space, spaces.Dict)
        writer = ObservationWriter(space, checked=checked)
        for episode in self._episodes:
            episode.write = CriticWriter(writer, episode.env).write if self._privileged else writer.write
        gc.freeze()  # present objects live long: later collections skip them
        mirror = getattr(getattr(envs[0].unwrapped, "task", None), "mirror", {}) if checked else {}
        built = Answer(info=self._info, lockstep=self._batch is not None, shared_world=shared_world)
        return dataclasses.replace(built, privileged=self._privileged, mirror=mirror)

    def _set_events(self, message: messages.SetEvents) -> EnvInfo:
        spec, added = message.spec, {}
        if message.push is not None:
            added["push at mid-episode"] = Event("interval", push, enabled=True, **message.push)
        for episode in self._episodes:
            env = episode.env.unwrapped
            if not isinstance(env, TaskEnv):
                raise TypeError(f"{spec.task}: a plain Gymnasium environment has no events")
            env.set_events(EventSettings(spec.randomize, spec.events), added)
            env.set_level(spec.level)
        if self._batch is not None:
            self._batch.env.set_events(self._episodes[0].env.unwrapped)
        self._info = describe(self._episodes[0].env)
        return self._info

    def _load_policy(self, message: messages.LoadPolicy) -> None:
        self._states = None
        policy = None
        if message.info is not None:
            layout = {name: (shape, np.dtype(dtype)) for name, shape, dtype in message.layout}
            tensors = map_arrays(self._job.numbers, layout)
            states = tensors.pop("state", None)
            self._states = None if states is None else states[self._job.first :]
            policy = PolicyFile(message.info, tensors)
        self._close_actor()
        if policy is None:
            self._actor = make_actor_of(message.other, self._episodes[0].env, self._job.count)
        else:
            self._actor = NumpyActor(policy, self._job.count)

    def _limit_actions(self, message: messages.LimitActions) -> None:
        from rlctl.deploy.filter.limited import Limited  # few evaluations need it
        from rlctl.deploy.filter.limits import Limits

        limits = Limits.model_validate(message.limits)
        self._actor = Limited(self._loaded_actor, self._info, limits, self._job.count)

    @property
    def _loaded_actor(self) -> Actor:
        assert self._actor is not None  # a policy is loaded before anything is played
        return self._actor

    def _begin_episodes(self, message: messages.BeginEpisodes) -> list[int]:
        """Begin episodes and replay their actions; return the environments whose episode ended or failed."""
        left = []
        if self._batch is not None:
            return self._batch.replay(self._arrays, message)
        for env, (seed, actions) in message.episodes.items():
            episode = self._episodes[env - self._job.first]
            try:
                with self._within(episode):
                    self._begin(episode, seed)
                    if self._replay(episode, actions):
                        left.append(env)
            except FailedInEpisode as failure:
                if not message.may_fail:
                    raise
                # It did not fail the first time, so its state differs now: the environment begins its next episode.
                left.append(env)
                print_line(f"{failure} when it was replayed")
        return left

    def _begin(self, episode: RunningEpisode, seed: int) -> None:
        rows = Rows.one(seed, index=episode.index - self._job.first)
        for actor in (self._actor, self._teacher):
            if actor is not None:
                actor.begin(rows)
        self._arrays.inside[episode.index] = seed, 0, -1
        first = episode.start(seed, float(self._arrays.level[episode.index]))
        episode.write(self._arrays.observation, episode.index, first)

    def _replay(self, episode: RunningEpisode, actions: NDArray[np.generic]) -> bool:
        """Take steps with recorded actions; return whether the episode ended."""
        for action in actions:
            self._teach(episode)  # the teacher may have a recurrent state
            episode.step += 1
            self._arrays.inside[episode.index, 1] = episode.step
            observation, _, terminated, truncated, _ = episode.take_step(action)
            episode.write(self._arrays.observation, episode.index, observation)
            if terminated or truncated:
                return True
        return False

    def _teach(self, episode: RunningEpisode) -> Any:
        """Return the teacher's action in the present step; None without a teacher. Call it at every step."""
        if self._teacher is None:
            return None
        seen = as_rows(find_teacher_view(episode.env).seen)
        rows = Rows.one(episode.seed, episode.step, episode.index - self._job.first)
        return self._teacher.act(seen, rows)[1][0]

    def _play(self, message: messages.Play) -> list[EpisodeResult]:
        """Play a segment in some environments, one after the other; return the episodes that ended."""
        ended: list[EpisodeResult] = []
        self._loaded_actor.explore(message.exploration)
        if self._batch is not None:
            return self._batch.play(self._arrays, message, self._loaded_actor, self._states)
        for env, seed in message.begin.items():
            episode = self._episodes[env - self._job.first]
            number = message.next_episodes.get(env)
            next_seeds = None if number is None else list_training_seeds(message.run_seed, env, number)
            with self._within(episode):
                if seed >= 0:
                    self._begin(episode, seed)
                    if self._states is not None:
                        self._states[env - self._job.first] = 0.0
                ended += self._play_one(episode, message, next_seeds)
        return ended

    def _play_one(
        self, episode: RunningEpisode, asked: messages.Play, next_seeds: Iterator[int] | None
    ) -> list[EpisodeResult]:
        """Play a segment of one environment; without `next_seeds` it stops when an episode ends."""
        arrays, index, actor, write = self._arrays, episode.index, self._loaded_actor, episode.write
        rows = Rows.one(episode.seed, episode.step, index - self._job.first)
        segment, inside = arrays.segment.of(index), arrays.inside[index]
        now = segment.observation
        single = now.get(SINGLE)
        if self._states is not None and actor.state is not None:
            actor.state[rows.index] = self._states[rows.index]
        for key, observed in now.items():
            observed[0] = arrays.observation[key][index]
        actor.prepare()
        inside[0] = episode.seed
        ended: list[EpisodeResult] = []
        row = 0
        while row < asked.steps and not (ended and next_seeds is None):
            observation: Any
            if single is not None:
                observation = single[row : row + 1]
            else:
                observation = {key: observed[row : row + 1] for key, observed in now.items()}
            began = perf_counter()
            stored, action = actor.act(observation, rows)
            if self._teacher is not None:
                segment.label[row] = self._teach(episode)
                if index in asked.taught:
                    stored = action = segment.label[row][None]
            acted = perf_counter()
            segment.stored[row] = stored.ravel()
            segment.action[row] = action[0]
            episode.step += 1
            rows.step[0] = episode.step
            inside[1], inside[2] = episode.step, row
            observation, reward, terminated, truncated, info = episode.take_step(segment.action[row])
            episode.acting_s += acted - began
            episode.stepping_s += perf_counter() - acted
            segment.reward[row] = reward
            segment.terminated[row], segment.truncated[row] = terminated, truncated
            if asked.record:
                segment.terms[row] = list(info["metrics"].values())
            if index in asked.contacts:
                episode.measure_contact()
            row += 1
            if terminated or truncated:
                ended.append(episode.summarize(info, row - 1, actor.report(index - self._job.first)))
                if next_seeds is not None:
                    write(segment.final, row - 1, observation)
                    seed = next(next_seeds)
                    inside[:] = seed, 0, row
                    if asked.levels is not None:
                        arrays.level[index] = asked.levels.follow(float(arrays.level[index]), ended[-1].success)
                    observation = episode.start(seed, float(arrays.level[index]))
                    rows.seed[0], rows.step[0] = seed, 0
                    actor.begin(rows)
                    if self._teacher is not None:
                        self._teacher.begin(rows)
            write(now, row, observation)
        for key, observed in now.items():
            arrays.observation[key][index] = observed[row]
        if self._states is not None and actor.state is not None:
            self._states[rows.index] = actor.state[rows.index]
        return ended

    @contextlib.contextmanager
    def _within(self, episode: RunningEpisode) -> Iterator[None]:
        """Run the code of an environment in its episode; raises `FailedInEpisode` for anything it raises."""
        try:
            yield
        except BaseException as error:  # a plugin may raise anything, SystemExit too
            raise FailedInEpisode(episode.index, episode.seed, episode.step) from error
        self._arrays.inside[episode.index, 1] = -1

    def _close_actor(self) -> None:
        if self._actor is not None:
            self._actor.close()
        self._actor = None

    def close(self) -> None:
        """Close the environments and the policy."""
        self._close_actor()
        for episode in self._episodes:
            try:
                episode.env.close()
            except BaseException as error:  # its episodes are over
                print_line(f"warning: closing environment {episode.index}: {describe_exception(error)}")
        self._episodes = []
        if self._batch is not None:
            self._batch.close()
        self._batch = None


def make_actor_of(name: str, env: Any, count: int = 1) -> Actor:
    """Return the actor of a policy server (`ws://...`), or of any other name as `make_actor` does."""
    if not name.startswith(SERVER):
        return make_actor(name, env.action_space, count)
    from rlctl.deploy.server.client import RemoteActor  # only here: it imports aiohttp

    return RemoteActor(name, env.observation_space, env.action_space)


def main(connection: Connection, job: messages.WorkerJob) -> None:
    """Answer messages until the connection closes."""
    print_whole_lines()
    worker = Worker(job)
    answer_messages(connection, worker.answer, describe_failure)
    worker.close()
