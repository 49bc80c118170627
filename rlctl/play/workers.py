"""Many environments on few processes: each worker plays several environments.

Observations, actions, rewards, flags and a policy's parameters are in shared memory; messages tell workers what to do,
and answers list the episodes that ended. Workers are new interpreters, never forks, with one thread each.
"""

import contextlib
import dataclasses
import itertools
import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, NoReturn

import numpy as np
from numpy.typing import NDArray

from rlctl.environments.dict_spaces import Observations, join
from rlctl.environments.info import EnvInfo
from rlctl.environments.spec import EnvSpec
from rlctl.errors import EpisodeFailed, RlctlError, TaskError
from rlctl.play import messages
from rlctl.play.messages import Answer, EpisodeResult, Message, format_hint, make_error
from rlctl.play.shared_arrays import PolicyNumbers, SharedArrays
from rlctl.play.shared_world import check_memory
from rlctl.policy.file import PolicyFile
from rlctl.printed_lines import PrintedLines
from rlctl.processes.child_process import anonymous_file
from rlctl.processes.pool import ProcessPool, WorkerException, WorkerFault

BUILD_TIMEOUT_S = 300.0
DEFAULT_TIMEOUT_S = 60.0
_WORLDS = 64  # worlds of a `BatchTask` per core, that play whole episodes

EpisodeSoFar = tuple[int, NDArray[Any]]  # seed and actions so far of an episode


class Workers(contextlib.AbstractContextManager["Workers"]):
    """`n_envs` environments of one kind on `n_workers` processes (default: the cores).

    Building starts at once and the first use waits for it, so that a caller can do its own slow imports in the
    meantime. An error in an environment raises `TaskError` with the episode's seed and step, and so does a worker that
    dies or does not answer within `timeout_s`. After an error the workers are closed. `printed` takes the
    lines that environments print; by default each is shown once on stderr.
    """

    def __init__(
        self,
        spec: EnvSpec,
        n_envs: int,
        *,
        n_workers: int | None = None,
        timeout_s: float = DEFAULT_TIMEOUT_S,
        printed: PrintedLines | None = None,
        privileged: Mapping[str, bool] | None = None,
        teacher: messages.LabellingPolicy | None = None,
    ) -> None:
        self.n_envs = n_envs
        self._teacher = teacher  # labels the steps of segments
        self._privileged = privileged  # what the critic of a training sees; see `TaskEnv.show_critic`
        self.timeout_s = timeout_s
        self.spec = spec  # spec of the environments
        self.shared_world: messages.SharedWorld | None = None  # why each environment has a process of its own
        self._printed = printed
        self._memories = [anonymous_file(), anonymous_file()]
        self._numbers = PolicyNumbers(self._memories[1], n_envs)
        self._steps = 1
        self._start(min(n_envs, n_workers or available_cores()))

    def _start(self, n_workers: int) -> None:
        """Start processes for the environments and let them build."""
        bounds = np.linspace(0, self.n_envs, n_workers + 1).round().astype(int).tolist()
        self._ranges = list(itertools.pairwise(bounds))
        self._owner = [worker for worker, (low, high) in enumerate(self._ranges) for _ in range(low, high)]
        self._ready = False
        arrays, numbers = self._memories
        ranges = [(low, high - low, self.n_envs) for low, high in self._ranges]
        jobs = [{"job": messages.WorkerJob(arrays, numbers, *environments)} for environments in ranges]
        main = "rlctl.play.worker:main"
        try:
            self._pool = ProcessPool(main, jobs, self._printed, self._read_progress, self._memories)
        except BaseException as error:
            self._close_memory()
            if isinstance(error, OSError):
                task = self.spec.task
                raise TaskError(f"task {task!r}: no worker can be started: {error.strerror or error}") from None
            raise
        self._begin_to_build()

    @property
    def info(self) -> EnvInfo:
        """Description of the environments; waits until they are built."""
        self._wait_until_built()
        return self._info

    @property
    def privileged_sizes(self) -> Mapping[str, int]:
        """Size of each observation that only the critic sees, by name; waits until the environments are built."""
        self._wait_until_built()
        return self._privileged_sizes

    @property
    def mirror(self) -> Mapping[str, Sequence[int]]:
        """The mirror symmetry that the task declares; empty without one. Waits until the environments are built."""
        self._wait_until_built()
        return self._mirror

    @property
    def arrays(self) -> SharedArrays:
        """The shared arrays, a row per environment; waits until the environments are built."""
        self._wait_until_built()
        return self._arrays

    @property
    def playing(self) -> set[int]:
        """The workers that have not answered yet."""
        return set(self._pool.waiting_for)

    @property
    def playable_envs(self) -> list[list[int]]:
        """The environments of each worker that play whole episodes: the first one, or all worlds of a `BatchTask`."""
        self._wait_until_built()
        return [list(range(low, high if self._lockstep else low + 1)) for low, high in self._ranges]

    def observations(self, rows: Any = slice(None)) -> Observations:
        """Return a copy of the current observations, shape (rows, ...) or a dict of such."""
        return join({key: array[rows].copy() for key, array in self.arrays.observation.items()})

    def rebuild(self, spec: EnvSpec) -> EnvInfo:
        """Replace the environments by those of another spec; return their description.

        Call `reset` afterwards. `arrays` is replaced too.
        """
        self._wait_until_built()
        self.spec = spec
        self._ready = False
        self._begin_to_build()
        return self.info

    def _begin_to_build(self) -> None:
        for worker in range(len(self._ranges)):
            self._send(worker, messages.Build(self.spec, self._privileged, self._teacher))

    def _wait_until_built(self) -> None:
        if self._ready:
            return
        answers = self._wait("being built", max(BUILD_TIMEOUT_S, self.timeout_s))
        if shared := [answer.shared_world for answer in answers.values() if answer.shared_world is not None]:
            self._give_each_a_process(shared[0])
            return
        self._info, self._lockstep = _info_of(answers), answers[0].lockstep
        self._privileged_sizes, self._mirror = answers[0].privileged, answers[0].mirror
        self._numbers.forget()
        self._ready = True
        self._attach(self._steps)
        self._arrays.level[:] = self.spec.level

    def _give_each_a_process(self, shared_world: messages.SharedWorld) -> None:
        self._pool.close(grace_s=0.0)  # their close could end the world of another environment
        try:
            check_memory(self.spec.task, shared_world, self.n_envs)
        except TaskError as error:
            self._fail(error)
        self.shared_world = shared_world
        self._start(self.n_envs)
        self._wait_until_built()

    def _attach(self, steps: int) -> None:
        self._steps = steps
        size = sum(self._privileged_sizes.values())
        self._arrays = SharedArrays(self._memories[0], self._info, self.n_envs, steps, size)
        self._arrays.inside[:] = -1
        self._ask_all(messages.Attach(steps), "attaching")

    def set_events(self, spec: EnvSpec, push: Mapping[str, Any] | None = None) -> EnvInfo:
        """Replace the events by those of `spec`, which is equal otherwise; return the new description.

        Worlds, policy and arrays do not change. `push` has the parameters, and `every_s`, of a push to add to the
        task's events. Call `reset` afterwards.
        """
        self._wait_until_built()
        self.spec = spec
        self._arrays.level[:] = spec.level
        self._info = _info_of(self._ask_all(messages.SetEvents(spec, dict(push) if push else None), "changing events"))
        return self._info

    def reset(self, seeds: Mapping[int, int]) -> None:
        """Begin an episode in some environments: environment index -> seed."""
        nothing = self.arrays.segment.action[0, :0]
        self.begin_episodes({env: (seed, nothing) for env, seed in seeds.items()}, doing="resetting")

    def begin_episodes(
        self, episodes: Mapping[int, EpisodeSoFar], *, doing: str = "stepping", may_fail: bool = False
    ) -> set[int]:
        """Begin episodes, environment index -> (seed, actions so far), and repeat their actions.

        Return the environments whose episode ended meanwhile; with `may_fail` also those whose episode failed,
        which raises otherwise. Errors mention `doing`.
        """
        dtype = self.arrays.segment.action.dtype
        for worker, envs in self._by_worker(episodes).items():
            begun = {env: (episodes[env][0], episodes[env][1].astype(dtype)) for env in envs}
            self._send(worker, messages.BeginEpisodes(begun, may_fail))
        return {env for answer in self._wait(doing).values() for env in answer.left}

    def set_policy(self, policy: PolicyFile) -> None:
        """Act with the present parameters of a policy, beginning with the next segment."""
        self._wait_until_built()
        if layout := self._numbers.write(policy):
            self._ask_all(messages.LoadPolicy(policy.info, layout), "loading the policy")

    def set_other_policy(self, name: str) -> None:
        """Act with an exported file, by its absolute path, or a baseline: `zero`, `random`, `file.py:function`."""
        self._wait_until_built()
        self._numbers.forget()
        self._ask_all(messages.LoadPolicy(other=name), "loading the policy")

    def limit_actions(self, limits: Mapping[str, Any]) -> None:
        """Pass the policy's actions through a safety filter until another policy is set; `limits` as in `Limits`."""
        self._ask_all(messages.LimitActions(dict(limits)), "applying limits")

    @property
    def recurrent_state(self) -> NDArray[np.float32] | None:
        """Hidden and cell state of each environment's episode, shape (n_envs, 2, layers, hidden); None without."""
        return self._numbers.arrays.get("state")

    def start_playing(self, play: messages.Play) -> None:
        """Begin to play a segment into `arrays.segment`; a longer segment than before replaces these arrays.

        When an episode ends, the next one of the training with `play.run_seed` begins; without `play.next_episodes` the
        environment stops.
        """
        self._wait_until_built()
        if self._steps < play.steps:
            self._attach(play.steps)
        for worker, envs in self._by_worker(play.begin).items():
            self._send(worker, dataclasses.replace(play, begin={env: play.begin[env] for env in envs}))

    def finish_playing(self, *, first: bool = False, watch: Callable[[], None] | None = None) -> list[EpisodeResult]:
        """Wait for all playing workers, or for the `first`; return the episodes that ended, by environment and row.

        `watch` is called several times a second; an exception from it ends the wait.
        """
        answers = self._wait("stepping", first=first, watch=watch)
        # In the order of the environments, so that results are reproducible.
        return [result for _, answer in sorted(answers.items()) for result in answer.ended]

    def compute_rewards(self, achieved: NDArray[Any], desired: NDArray[Any]) -> NDArray[np.float64]:
        """Return the rewards that environment 0 computes for achieved and desired goals.

        Goals of shape (n, *goal), rewards (n,). Raises `TaskError`, which names compute_reward, if that method raises,
        hangs, or does not return n finite numbers.
        """
        self._wait_until_built()
        # Contiguous rows: sums over other layouts may be rounded differently.
        self._send(0, messages.ComputeRewards(np.ascontiguousarray(achieved), np.ascontiguousarray(desired)))
        rewards = self._wait("in compute_reward")[0].rewards
        assert rewards is not None  # the answer to ComputeRewards has them
        return rewards

    def _by_worker(self, envs: Iterable[int]) -> dict[int, list[int]]:
        groups: dict[int, list[int]] = {}
        for env in envs:
            groups.setdefault(self._owner[env], []).append(env)
        return groups

    def _ask_all(self, message: Message, doing: str) -> dict[int, Answer]:
        for worker in range(len(self._ranges)):
            self._send(worker, message)
        return self._wait(doing)

    def _send(self, worker: int, message: Message) -> None:
        try:
            self._pool.send(worker, message)
        except WorkerFault as fault:
            self._fail(self._name_episode(fault))

    def _wait(self, doing: str, timeout_s: float | None = None, **options: Any) -> dict[int, Answer]:
        try:
            answers = self._pool.wait(doing, timeout_s or self.timeout_s, **options)
        except WorkerFault as fault:
            self._fail(self._name_episode(fault))
        for answer in answers.values():
            if isinstance(answer, WorkerException):
                self._fail(make_error(answer, self.spec.task))
        return answers

    def _read_progress(self) -> bytes:
        return self._arrays.inside.tobytes() if self._ready else b""

    def _fail(self, error: RlctlError) -> NoReturn:
        self.close(grace_s=0.0)
        raise error from None

    def _name_episode(self, fault: WorkerFault) -> TaskError:
        """Name the episode a worker was in when it stopped answering, or the environments it ran."""
        low, high = self._ranges[fault.worker]
        message = f"task {self.spec.task!r}: {fault}"
        if self._ready:
            for env, (seed, step, _) in enumerate(self._arrays.inside[low:high].tolist(), start=low):
                if step >= 0:
                    return EpisodeFailed(message, env, seed, step, hint=format_hint(self.spec.task))
        return TaskError(f"{message}\nit ran the environments {low} to {high - 1}")

    def close(self, grace_s: float = 2.0) -> None:
        """End the workers; those that do not end within `grace_s` are killed. A second call does nothing."""
        self._pool.close(grace_s)
        self._close_memory()

    def _close_memory(self) -> None:
        while self._memories:
            os.close(self._memories.pop())

    def __exit__(self, *_: object) -> None:
        self.close()


def _info_of(answers: Mapping[int, Answer]) -> EnvInfo:
    info = answers[0].info
    assert info is not None  # the answer to Build and SetEvents has it
    return info


def count_envs(spec: EnvSpec, episodes: int) -> int:
    """Return how many environments play a list of episodes: one per core, of a `BatchTask` many worlds per core."""
    return min(episodes, available_cores() * (_WORLDS if spec.is_batch else 1))


def available_cores() -> int:
    """Return how many cores this process may use; on a cluster the variable `RLCTL_CORES` limits them."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    share = os.environ.get("RLCTL_CORES", "")
    return min(cores, max(1, int(share))) if share.isdecimal() else cores
