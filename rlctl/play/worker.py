"""A worker: a process with a few environments and a policy; imports no torch.

The worker answers each message (`messages.py`) of the main process once. Observations, actions, rewards, flags and the
policy's parameters are in shared memory.
"""

import gc
from collections.abc import Mapping
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from rlctl.environments.gym_worlds import GymWorlds
from rlctl.environments.info import EnvInfo, describe_worlds
from rlctl.environments.spec import EnvSpec
from rlctl.errors import RecipeError, describe_exception
from rlctl.library_output import print_whole_lines
from rlctl.play import messages
from rlctl.play.episodes import Episodes, compute_rewards
from rlctl.play.messages import Answer, EpisodeResult, Message, describe_failure
from rlctl.play.playing import Worlds
from rlctl.play.shared_arrays import SharedArrays, map_arrays
from rlctl.play.shared_world import make_watched
from rlctl.play.teaching import check_teacher
from rlctl.policy.actor import Actor
from rlctl.policy.file import PolicyFile
from rlctl.policy.load import load_actor
from rlctl.policy.named_actors import SERVER, make_actor
from rlctl.policy.numpy_actor import NumpyActor
from rlctl.printed_lines import print_line
from rlctl.processes.pool import answer_messages
from rlctl.task.events import Event, EventSettings, push
from rlctl.task.worlds import TaskWorlds


class Worker:
    """A few environments and the policy that plays them; the first message must be `Build`.

    The worlds of a `BatchTask` play together; other environments, of one world each, play one after the other: a world
    takes about 28 MB, so that changing it at every step would empty the processor's caches.
    """

    def __init__(self, job: messages.WorkerJob) -> None:
        self._job = job
        self._groups: list[Episodes] = []
        self._actor: Actor | None = None  # its rows are the environments of the worker
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
                return Answer(left=[env for group in self._groups for env in group.repeat(self._arrays, message)])
            case messages.ComputeRewards():
                return Answer(rewards=compute_rewards(self._groups[0].worlds, message.achieved, message.desired))
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
        if self._groups:
            self.close()
            gc.unfreeze()
            gc.collect()  # environments may hold themselves in cycles
        worlds, shared_world = self._make_worlds(message)
        teacher = message.teacher
        taught_by: Actor | None = None
        if teacher is not None:
            check_teacher(teacher, worlds[0])
            taught_by = load_actor(Path(teacher.policy), self._job.count)
        if message.privileged is not None:
            for some in worlds:
                self._privileged = show_critic(message.spec, some, message.privileged)
        first = self._job.first
        self._groups = []
        for some in worlds:
            has_critic = message.privileged is not None
            row = first - self._job.first
            self._groups.append(Episodes(some, first, row, has_critic=has_critic, teacher=taught_by))
            first += some.count
        self._info = describe_worlds(worlds[0])
        gc.freeze()  # present objects live long: later collections skip them
        mirror: Mapping[str, Any] = {}
        if isinstance(worlds[0], TaskWorlds) and isinstance(worlds[0].observation_space, spaces.Box):
            mirror = worlds[0].task.mirror
        return Answer(
            info=self._info,
            lockstep=message.spec.is_batch,
            shared_world=shared_world,
            privileged=self._privileged,
            mirror=mirror,
        )

    def _make_worlds(self, message: messages.Build) -> tuple[list[Worlds], messages.SharedWorld | None]:
        """Build the worlds; only the first ones if environments in one process would share a PyBullet world."""
        spec, count = message.spec, self._job.count
        teacher = None if message.teacher is None else message.teacher.spec
        if spec.is_batch:
            return [spec.make_worlds(count, teacher=teacher)], None
        if count == 1:
            return [spec.make_worlds(1, teacher=teacher)], None
        first, shared_world = make_watched(spec, teacher)
        if shared_world is not None:
            return [first], shared_world
        return [first, *(spec.make_worlds(1, teacher=teacher) for _ in range(count - 1))], None

    def _set_events(self, message: messages.SetEvents) -> EnvInfo:
        spec, added = message.spec, {}
        if message.push is not None:
            added["push at mid-episode"] = Event("interval", push, enabled=True, **message.push)
        for group in self._groups:
            worlds = find_task_worlds(group.worlds)
            if worlds is None:
                raise TypeError(f"{spec.task}: a plain Gymnasium environment has no events")
            worlds.set_events(EventSettings(spec.randomize, spec.events), added)
            group.worlds.level = worlds.level = spec.level
        self._info = describe_worlds(self._groups[0].worlds)
        return self._info

    def _load_policy(self, message: messages.LoadPolicy) -> None:
        self._states = None
        policy: PolicyFile | None = None
        if message.info is not None:
            layout = {name: (shape, np.dtype(dtype)) for name, shape, dtype in message.layout}
            tensors = map_arrays(self._job.numbers, layout)
            states = tensors.pop("state", None)
            self._states = None if states is None else states[self._job.first :]
            policy = PolicyFile(message.info, tensors)
        self._close_actor()
        if policy is None:
            self._actor = make_actor_of(message.other, self._groups[0].worlds, self._job.count)
        else:
            self._actor = NumpyActor(policy, self._job.count)

    def _limit_actions(self, message: messages.LimitActions) -> None:
        from rlctl.limits.limited import Limited  # few evaluations need it
        from rlctl.limits.limits import Limits

        limits = Limits.model_validate(message.limits)
        self._actor = Limited(self._loaded_actor, self._info, limits, self._job.count)

    @property
    def _loaded_actor(self) -> Actor:
        assert self._actor is not None  # a policy is loaded before anything is played
        return self._actor

    def _play(self, message: messages.Play) -> list[EpisodeResult]:
        """Play a segment; return the episodes that ended."""
        ended: list[EpisodeResult] = []
        actor = self._loaded_actor
        actor.explore(message.exploration)
        if self._states is not None and actor.state is not None:
            actor.state[:] = self._states[: self._job.count]
        actor.prepare()
        for group in self._groups:
            begin = {env: message.begin[env] for env in group.envs if env in message.begin}
            if begin:
                ended += group.play(self._arrays, message, begin, actor)
        if self._states is not None and actor.state is not None:
            self._states[: self._job.count] = actor.state
        return ended

    def _close_actor(self) -> None:
        if self._actor is not None:
            self._actor.close()
        self._actor = None

    def close(self) -> None:
        """Close the environments and the policy."""
        self._close_actor()
        for group in self._groups:
            try:
                group.worlds.close()
            except BaseException as error:  # its episodes are over
                print_line(f"warning: closing environment {group.first}: {describe_exception(error)}")
        self._groups = []


def find_task_worlds(worlds: Worlds) -> TaskWorlds | None:
    """Return the worlds of a task, also of one in wrappers; None for a plain environment."""
    return worlds.task_worlds if isinstance(worlds, GymWorlds) else worlds


def show_critic(spec: EnvSpec, worlds: Worlds, privileged: Mapping[str, bool]) -> dict[str, int]:
    """Let worlds observe what only the critic sees; return its sizes by name, or raise `RecipeError`."""
    of_task, space = find_task_worlds(worlds), worlds.observation_space
    if of_task is None:
        raise RecipeError(f"privileged: {spec.task} is a plain Gymnasium environment; only tasks have it")
    if not isinstance(space, spaces.Box) or len(space.shape) != 1:
        raise RecipeError(
            f"privileged: {spec.task} observes {space}; a critic sees more only beside a flat observation"
        )
    of_task.show_critic(**privileged)
    assert of_task.critic is not None
    return of_task.critic.sizes


def make_actor_of(name: str, worlds: Any, count: int = 1) -> Actor:
    """Return the actor of a policy server (`ws://...`), or of any other name as `make_actor` does."""
    if not name.startswith(SERVER):
        return make_actor(name, worlds.action_space, count)
    from rlctl.play.remote import RemoteActor  # only here: it imports aiohttp

    return RemoteActor(name, worlds.observation_space, worlds.action_space)


def main(connection: Connection, job: messages.WorkerJob) -> None:
    """Answer messages until the connection closes."""
    print_whole_lines()
    worker = Worker(job)
    answer_messages(connection, worker.answer, describe_failure)
    worker.close()
