"""Many environments on few processes: W workers, each with K environments that it plays one after the other.

Observations, actions, rewards, flags and a policy's numbers are in shared memory; messages say what to do, and answers
which episodes ended. Workers are fresh interpreters, never forks, with one thread each.
"""

from __future__ import annotations

import dataclasses
import itertools
import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from multiprocessing.connection import wait
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlctl import errors
from rlctl.dict_spaces import Observations, join
from rlctl.env_spec import EnvSpec
from rlctl.errors import DivergedError, EpisodeFailed, PolicyError, RlctlError, TaskError
from rlctl.rollout import goal_rewards, messages
from rlctl.rollout.child_process import ChildProcess
from rlctl.rollout.process_start import StartProcess
from rlctl.rollout.shared_arrays import SharedArrays, anonymous_file, map_arrays
from rlctl.rollout.worker_output import forward
from rlctl.run.acting import Exploration
from rlctl.run.env_info import EnvInfo
from rlctl.run.network import select_actor_tensors
from rlctl.run.policy import PolicyInfo

# A PyBullet world is one block of 28 MB, which huge pages fill in half the time. Other C libraries ignore this.
_TUNED = {"GLIBC_TUNABLES": "glibc.malloc.hugetlb=1"}

BUILD_TIMEOUT_S = 300.0
DEFAULT_TIMEOUT_S = 60.0
_CHECK_EVERY_S = 0.2


@dataclasses.dataclass(frozen=True)
class EpisodeResult:
    """How an episode ended. `terms` are sums over the episode, weighted: they add up to the return."""

    env: int
    seed: int
    total_reward: float
    length: int
    success: bool | None
    terms: dict[str, float]
    final_distance: float | None
    row: int = dataclasses.field(default=-1, compare=False)
    """The row of the segment in which it ended."""
    report: dict[str, Any] = dataclasses.field(default_factory=dict, compare=False)
    """What the player has to say of it; see `acting.Player.report`."""
    deepest_contact: float | None = None
    """How far two bodies overlapped at most [m]; None where it was not measured."""


class Workers:
    """`n_envs` environments of one kind on `n_workers` processes (default: the cores).

    Building starts at once and is waited for by the first use, so that a caller can do its own slow imports
    meanwhile. Errors in an environment raise `TaskError` with the episode's seed and step; a worker that dies or
    does not answer within `timeout_s` does too. After an error the workers are gone. What environments print goes to
    `on_output`, line by line, from a thread; without it to stderr. `start` starts a process as `subprocess.Popen`
    does; without it `process_start.default_start()` does.
    """

    def __init__(
        self,
        spec: EnvSpec,
        n_envs: int,
        *,
        n_workers: int | None = None,
        timeout_s: float = DEFAULT_TIMEOUT_S,
        on_output: Callable[[str], None] | None = None,
        start: StartProcess | None = None,
    ) -> None:
        self.n_envs = n_envs
        self.timeout_s = timeout_s
        self._spec = spec
        self._start_process = start
        n_workers = min(n_envs, n_workers or available_cores())
        bounds = np.linspace(0, n_envs, n_workers + 1).round().astype(int).tolist()
        self._ranges = list(itertools.pairwise(bounds))
        self._owner = [worker for worker, (low, high) in enumerate(self._ranges) for _ in range(low, high)]
        self._memory, self._numbers_memory = anonymous_file(), anonymous_file()
        self._numbers: dict[str, NDArray[Any]] = {}
        self._policy_layout: tuple[Any, ...] = ()
        self._processes: list[ChildProcess] = []
        self._pending: set[int] = set()
        self._steps = 0
        self._ready = False
        read_end, printing = os.pipe()
        self._output = threading.Thread(target=forward, args=(read_end, on_output or _to_stderr), daemon=True)
        self._output.start()
        try:
            for first, last in self._ranges:
                self._start(first, last - first, printing)
        except OSError as error:
            self.close()
            raise TaskError(f"task {spec.task!r}: no worker can be started: {error.strerror or error}") from None
        except BaseException:
            self.close()
            raise
        finally:
            os.close(printing)

    def _start(self, first: int, count: int, printing: int) -> None:
        descriptors = (self._memory, self._numbers_memory)
        job = dict(zip(("memory", "numbers"), descriptors, strict=True))
        self._processes.append(
            ChildProcess(
                "rlctl.rollout.worker_process:main",
                {
                    "spec": dataclasses.asdict(self._spec),
                    "job": {**job, "first": first, "count": count, "total": self.n_envs},
                },
                stdout=printing,
                stderr=printing,
                descriptors=descriptors,
                environment={name: value for name, value in _TUNED.items() if name not in os.environ},
                start=self._start_process,
            )
        )
        self._pending.add(len(self._processes) - 1)

    @property
    def spec(self) -> EnvSpec:
        """What the environments are made from."""
        return self._spec

    @property
    def info(self) -> EnvInfo:
        """What the environments are; waits until they are built."""
        self._wait_until_built()
        return self._info

    @property
    def arrays(self) -> SharedArrays:
        """The shared arrays, a row per environment; waits until the environments are built."""
        self._wait_until_built()
        return self._arrays

    @property
    def first_envs(self) -> list[int]:
        """The first environment of each worker."""
        return [low for low, _ in self._ranges]

    def _wait_until_built(self) -> None:
        if self._ready:
            return
        answers = self._wait_for_all(max(BUILD_TIMEOUT_S, self.timeout_s), "being built")
        self._info = EnvInfo.model_validate(answers[0]["info"])
        self._policy_layout = ()
        self._ready = True
        self._attach(max(self._steps, 1))

    def _attach(self, steps: int) -> None:
        self._steps = steps
        self._arrays = SharedArrays(
            self._memory, self.n_envs, self._info.spaces(), len(self._info.reward_weights), steps
        )
        self._arrays.inside[:] = -1
        self._ask_all(messages.Attach(steps), "attaching")

    def make_room(self, steps: int) -> None:
        """Let segments have up to `steps` steps. `arrays` are other ones then."""
        self._wait_until_built()
        if self._steps < steps:
            kept = {key: values.copy() for key, values in self._arrays.observation.items()}
            self._attach(steps)
            for key, values in kept.items():
                self._arrays.observation[key][:] = values

    def rebuild(self, spec: EnvSpec) -> EnvInfo:
        """Close the environments and build those of another spec in their place; return what they are.

        None of them is in an episode then: call `reset`. `arrays` are new ones.
        """
        self._wait_until_built()
        self._spec = spec
        self._ready = False
        for worker in range(len(self._processes)):
            self._send(worker, messages.Build(dataclasses.asdict(spec)))
        return self.info

    def set_events(self, spec: EnvSpec, push: Mapping[str, Any] | None = None) -> EnvInfo:
        """Let the events of `spec` act, which differs from the present one in nothing else; return what they are now.

        Worlds, policy and arrays stay. `push` are the parameters, and `every_s`, of a push that the task does not have.
        None of the environments is in an episode then.
        """
        self._wait_until_built()
        self._spec = spec
        answers = self._ask_all(
            messages.SetEvents(dataclasses.asdict(spec), dict(push) if push else None), "changing events"
        )
        self._info = EnvInfo.model_validate(answers[0]["info"])
        return self._info

    def reset(self, seeds: dict[int, int]) -> None:
        """Start an episode in some environments: environment index -> seed; a negative one lets it rest."""
        self._wait_until_built()
        for worker, envs in self._by_worker(seeds).items():
            self._send(worker, messages.Reset([[env, seeds[env]] for env in envs]))
        self._wait_for_all(self.timeout_s, "resetting")

    def replay_actions(self, episodes: Mapping[int, tuple[int, NDArray[Any]]]) -> set[int]:
        """Begin episodes, environment index -> (seed, actions so far), and take those steps.

        Return the environments whose episode ended on the way: they are not where they were.
        """
        self._wait_until_built()
        dtype = self._arrays.action.dtype
        for worker, envs in self._by_worker(episodes).items():
            heads = [[env, episodes[env][0], len(episodes[env][1])] for env in envs]
            content = b"".join(episodes[env][1].astype(dtype).tobytes() for env in envs)
            self._send(worker, messages.ReplayActions(heads), content)
        answers = self._wait_for_all(self.timeout_s, "replaying episodes")
        return {each["env"] for answer in answers.values() for each in answer["ended"]}

    def set_policy(self, info: PolicyInfo, tensors: Mapping[str, NDArray[Any]]) -> None:
        """Act with the present numbers of a policy, of a policy file's names, from the next segment on."""
        self._wait_until_built()
        numbers = select_actor_tensors(info, tensors)
        if (hidden := numbers.get("policy/lstm_actor.weight_hh_l0")) is not None:
            layers = sum("weight_hh" in name for name in numbers)
            numbers["state"] = np.zeros((self.n_envs, 2, layers, hidden.shape[1]), np.float32)
        layout = [(name, list(values.shape), str(values.dtype)) for name, values in numbers.items()]
        structure = (info.algo, info.policy_kwargs, info.clip_observation, layout)
        if structure != self._policy_layout:
            self._policy_layout = structure
            self._numbers = map_arrays(
                self._numbers_memory, {name: (tuple(shape), np.dtype(dtype)) for name, shape, dtype in layout}
            )
        else:
            numbers.pop("state", None)
            layout = []
        for name, values in numbers.items():
            self._numbers[name][...] = values
        if layout:
            self._ask_all(messages.LoadPolicy(info.model_dump(mode="json"), layout), "loading the policy")

    def set_other_policy(self, name: str) -> None:
        """Act with an exported file, by its whole path, or a baseline: `zero`, `random`, `file.py:function`."""
        self._wait_until_built()
        self._policy_layout = ()
        self._ask_all(messages.LoadPolicy(other=name), "loading the policy")

    def limit_actions(self, limits: Mapping[str, Any]) -> None:
        """Send the policy's actions through a safety filter, until another policy is set; `limits` are a `Limits`."""
        self._ask_all(messages.LimitActions(dict(limits)), "applying limits")

    @property
    def recurrent_state(self) -> NDArray[np.float32] | None:
        """Hidden and cell state of each environment's episode, shape (n_envs, 2, layers, hidden); None without."""
        return self._numbers.get("state") if self._policy_layout else None

    def start_playing(
        self,
        begin: Mapping[int, int],
        steps: int,
        exploration: Exploration,
        *,
        until_end: bool = False,
        record: bool = False,
        contacts: bool = False,
        run_seed: int = 0,
        episodes_started: Sequence[int] = (),
    ) -> None:
        """Begin to play up to `steps` steps in each of some environments, into their rows of `arrays.segment`.

        `begin` has the seed of the episode to begin with, negative to go on with the running one. Where an episode ends
        the next one begins, by its address in the training of `run_seed`, with the number that `episodes_started` has
        for the environment; with `until_end` the environment stops there, and without numbers none begins. `contacts`:
        measure how far the bodies of a task overlap.
        """
        self.make_room(steps)
        for worker, envs in self._by_worker(begin).items():
            started = [episodes_started[env] for env in envs] if episodes_started else []
            seeds = [begin[env] for env in envs]
            self._send(
                worker,
                messages.Play(
                    envs, seeds, steps, dataclasses.asdict(exploration), until_end, record, run_seed, started, contacts
                ),
            )

    def finish_playing(self, *, first: bool = False, check: Callable[[], None] | None = None) -> list[EpisodeResult]:
        """Wait for all workers that play, or for the `first`; return the episodes that ended, by environment and row.

        `check` is called several times a second, and may raise to leave.
        """
        answers = self._wait(self.timeout_s, "stepping", first=first, check=check)
        return _results(answers)

    @property
    def playing(self) -> set[int]:
        """The workers that have not answered yet."""
        return set(self._pending)

    def step(self) -> list[EpisodeResult]:
        """Step every active environment with the row of `arrays.action`; return the episodes that ended.

        An environment whose episode ended starts the one of `arrays.next_seed`, or rests if that is negative.
        """
        return _results(self._ask_all(messages.Step(), "stepping"))

    def compute_rewards(self, achieved: NDArray[Any], desired: NDArray[Any]) -> NDArray[np.float64]:
        """Return the rewards that environment 0 computes for steps that reached one goal and were to reach another.

        Goals of shape (n, *goal), rewards (n,). Raises `TaskError`, which names compute_reward, if it raises, hangs, or
        does not return n finite numbers.
        """
        self._wait_until_built()
        self._send(0, messages.ComputeRewards(), goal_rewards.encode_request(achieved, desired))
        answers = self._wait_for_all(self.timeout_s, "in compute_reward")
        return np.array(answers[0]["rewards"], np.float64)

    def observations(self, rows: Any = slice(None)) -> Observations:
        """Return a copy of the current observations, shape (rows, ...) or a dict of such."""
        return _copy_rows(self.arrays.observation, rows)

    def final_observations(self, rows: Any) -> Observations:
        """Return a copy of the last observations of episodes that just ended."""
        return _copy_rows(self.arrays.final, rows)

    def _by_worker(self, envs: Iterable[int]) -> dict[int, list[int]]:
        groups: dict[int, list[int]] = {}
        for env in envs:
            groups.setdefault(self._owner[env], []).append(env)
        return groups

    def _ask_all(self, message: messages.Message, doing: str) -> dict[int, Any]:
        for worker in range(len(self._processes)):
            self._send(worker, message)
        return self._wait_for_all(self.timeout_s, doing)

    def _send(self, worker: int, message: messages.Message, content: bytes | None = None) -> None:
        connection = self._processes[worker].connection
        try:
            connection.send_bytes(messages.encode(message))
            if content is not None:
                connection.send_bytes(content)
        except OSError:
            self._fail(self._describe_death(worker, "idle"))
        self._pending.add(worker)

    def _wait_for_all(self, timeout_s: float, doing: str) -> dict[int, Any]:
        return self._wait(timeout_s, doing)

    def _wait(
        self, timeout_s: float, doing: str, *, first: bool = False, check: Callable[[], None] | None = None
    ) -> dict[int, Any]:
        """Wait for the answer of every worker that was asked, or of the first ones."""
        answers: dict[int, Any] = {}
        deadline = time.monotonic() + timeout_s
        progress = self._progress()
        while self._pending and not (first and answers):
            if check is not None:
                check()
            connections = {self._processes[worker].connection: worker for worker in self._pending}
            left = max(0.0, deadline - time.monotonic())
            ready = wait(list(connections), timeout=left if check is None else min(left, _CHECK_EVERY_S))
            if not ready and time.monotonic() >= deadline:
                # A worker answers once for many steps: only one that stands still for so long hangs.
                if progress == (progress := self._progress()):
                    self._fail(self._describe_hang(min(self._pending), timeout_s, doing))
                deadline = time.monotonic() + timeout_s
            for connection in ready:
                worker = connections[connection]  # type: ignore[index]
                answers[worker] = self._receive(worker, doing)
        return answers

    def _receive(self, worker: int, doing: str) -> Any:
        try:
            content = self._processes[worker].connection.recv_bytes()
        except (EOFError, OSError):
            self._fail(self._describe_death(worker, doing))
        self._pending.discard(worker)
        answer = json.loads(content)
        if "error" in answer:
            self._fail(self._make_error(answer["error"]))
        return answer

    def _progress(self) -> bytes:
        """Return what changes whenever an environment begins or ends a call."""
        return self._arrays.inside.tobytes() if self._ready else b""

    def _fail(self, error: RlctlError) -> Any:
        self.close(grace_s=0.0)
        raise error from None

    def _make_error(self, error: dict[str, Any]) -> RlctlError:
        message = error["message"]
        kind = getattr(errors, error["kind"], TaskError) if error["kind"] else TaskError
        where = (error["env"], error["seed"], error["step"]) if "env" in error else None
        details = error["traceback"]
        if kind is TaskError and self._spec.task not in message.partition("\n")[0]:
            message = f"task {self._spec.task!r}: {message}"
        if where is not None:
            failed = EpisodeFailed(message, *where, hint=self._hint, details=details)
            if kind is TaskError:
                return failed
            # What the policy has done wrong, check-env does not show.
            message = str(failed).rpartition("; ")[0] if kind in (DivergedError, PolicyError) else str(failed)
        result: RlctlError = kind(message, details=details)
        return result

    @property
    def _hint(self) -> str:
        return f"to see it alone: rlctl check-env {self._spec.task}"

    def _name_episode(self, worker: int, message: str) -> TaskError:
        """Name the episode a worker was in when it stopped answering, or the environments it ran."""
        low, high = self._ranges[worker]
        if self._ready:
            for env, (seed, step, _) in enumerate(self._arrays.inside[low:high].tolist(), start=low):
                if step >= 0:
                    return EpisodeFailed(message, env, seed, step, hint=self._hint)
        return TaskError(f"{message}\nit ran the environments {low} to {high - 1}")

    def _describe_death(self, worker: int, doing: str) -> TaskError:
        try:
            code = self._processes[worker].process.wait(timeout=5.0)
            how = signal.Signals(-code).name if code < 0 else f"exit code {code}"
        except subprocess.TimeoutExpired:
            how = "it closed its connection"
        if how == "SIGKILL":
            how += ": the system does that when memory runs out; fewer environments (--n-envs) need less"
        return self._name_episode(worker, f"task {self._spec.task!r}: worker {worker} died while {doing} ({how})")

    def _describe_hang(self, worker: int, timeout_s: float, doing: str) -> TaskError:
        return self._name_episode(
            worker,
            f"task {self._spec.task!r}: no answer for {timeout_s:g} s while {doing}; "
            "if that may take so long, raise --env-timeout",
        )

    def close(self, grace_s: float = 2.0) -> None:
        """End the workers; those that do not end within `grace_s` are killed. A second call does nothing."""
        for process in self._processes:
            process.connection.close()
        deadline = time.monotonic() + grace_s
        for process in self._processes:
            process.close(max(0.0, deadline - time.monotonic()))
        self._processes = []
        self._pending = set()
        self._output.join(timeout=1.0)
        for descriptor in (self._memory, self._numbers_memory):
            if descriptor >= 0:
                os.close(descriptor)
        self._memory = self._numbers_memory = -1

    def __enter__(self) -> Workers:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _results(answers: Mapping[int, Any]) -> list[EpisodeResult]:
    """Return the episodes of some answers, in the order of the environments: what follows from them must repeat."""
    return [
        EpisodeResult(
            each["env"],
            each["seed"],
            each["return"],
            each["length"],
            each["success"],
            each["terms"],
            each["final_distance"],
            each.get("row", -1),
            each.get("report", {}),
            each.get("deepest_contact"),
        )
        for _, answer in sorted(answers.items())
        for each in answer["ended"]
    ]


def _copy_rows(arrays: dict[str, NDArray[Any]], rows: Any) -> Observations:
    result: Observations = join({key: array[rows].copy() for key, array in arrays.items()})
    return result


def _to_stderr(line: str) -> None:
    print(line, file=sys.stderr)


def available_cores() -> int:
    """Return how many cores this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
