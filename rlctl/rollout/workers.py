"""Many environments on few processes: W workers, each stepping K environments in turn.

Observations, actions, rewards and flags are in shared memory; pipes only say "go", "done", and which episodes
ended. Workers are fresh interpreters, never forks, with one thread each.
"""

from __future__ import annotations

import dataclasses
import itertools
import json
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Mapping
from multiprocessing.connection import Connection, wait
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlctl import errors
from rlctl.dict_spaces import Observations, join
from rlctl.env_spec import EnvSpec
from rlctl.errors import EpisodeFailed, RlctlError, TaskError
from rlctl.rollout import goal_rewards
from rlctl.rollout.process_group import block_signals, end
from rlctl.rollout.process_start import Process, StartProcess, default_start
from rlctl.rollout.shared_arrays import SharedArrays, anonymous_file
from rlctl.rollout.worker_output import forward
from rlctl.run.env_info import EnvInfo

# Started this way a worker finds what its parent finds, and the caller's script is not run again.
# Who stops a service signals all of its processes, and the main process decides: ignored before anything slow is
# imported, and held back until then. Processes that environments start decide for themselves.
_BOOTSTRAP = (
    "import signal; numbers = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP); "
    "[signal.signal(number, lambda *_: None) for number in numbers]; "
    "signal.pthread_sigmask(signal.SIG_UNBLOCK, numbers); "
    "import json, sys; "
    "sys.path[:] = json.loads(sys.argv[3])['sys_path']; "
    "from rlctl.rollout.worker_process import main; main()"
)

# A PyBullet world is one block of 28 MB, which huge pages fill in half the time. Other C libraries ignore this.
_TUNED = {"GLIBC_TUNABLES": "glibc.malloc.hugetlb=1"}

BUILD_TIMEOUT_S = 300.0
DEFAULT_TIMEOUT_S = 60.0


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
        self._start_process = start or default_start()
        n_workers = min(n_envs, n_workers or available_cores())
        bounds = np.linspace(0, n_envs, n_workers + 1).round().astype(int).tolist()
        self._ranges = list(itertools.pairwise(bounds))
        self._memory = anonymous_file()
        self._processes: list[Process] = []
        self._connections: list[Connection] = []
        self._lifelines: list[int] = []
        self._ready = False
        self._owner = [worker for worker, (low, high) in enumerate(self._ranges) for _ in range(low, high)]
        read_end, self._printing = os.pipe()
        self._output = threading.Thread(target=forward, args=(read_end, on_output or _to_stderr), daemon=True)
        self._output.start()
        try:
            for first, last in self._ranges:
                self._start(first, last - first)
        except OSError as error:
            self.close()
            raise TaskError(f"task {spec.task!r}: no worker can be started: {error.strerror or error}") from None
        except BaseException:
            self.close()
            raise
        finally:
            os.close(self._printing)

    def _start(self, first: int, count: int) -> None:
        ours, theirs = socket.socketpair()
        # The end of a pipe that nobody writes to: its hang-up shows the worker that this process is gone.
        lifeline, our_end = os.pipe()
        self._lifelines.append(our_end)
        job = {
            "spec": dataclasses.asdict(self._spec),
            "first": first,
            "count": count,
            "total": self.n_envs,
            "sys_path": sys.path,
            "parent": os.getpid(),
        }
        environment = {
            **_TUNED,
            **os.environ,
            "OMP_NUM_THREADS": "1",
            "OPENBLAS_NUM_THREADS": "1",
            "MKL_NUM_THREADS": "1",
        }
        passed = (theirs.fileno(), self._memory, lifeline)
        with theirs, open(lifeline, "rb"), block_signals():
            process = self._start_process(
                [sys.executable, "-c", _BOOTSTRAP, *map(str, passed[:2]), json.dumps(job), str(lifeline)],
                pass_fds=passed,
                stdin=subprocess.DEVNULL,
                stdout=self._printing,
                stderr=self._printing,
                env=environment,
                process_group=0,
            )
        self._processes.append(process)
        self._connections.append(Connection(ours.detach()))

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

    def _wait_until_built(self) -> None:
        if self._ready:
            return
        answers = self._answers(range(len(self._processes)), max(BUILD_TIMEOUT_S, self.timeout_s), "being built")
        self._info = EnvInfo.model_validate(answers[0]["info"])
        observation_space, action_space = self._info.spaces()
        terms = len(self._info.reward_weights)
        self._arrays = SharedArrays(self._memory, self.n_envs, observation_space, action_space, terms)
        self._arrays.inside[:] = -1
        self._ready = True
        self._send_all(b"attach")
        self._answers(range(len(self._processes)), self.timeout_s, "attaching")

    def rebuild(self, spec: EnvSpec) -> EnvInfo:
        """Close the environments and build those of another spec in their place; return what they are.

        None of them is in an episode then: call `reset`. `arrays` are new ones.
        """
        self._wait_until_built()
        self._spec = spec
        self._ready = False
        self._send_all(json.dumps(dataclasses.asdict(spec)).encode())
        return self.info

    def reset(self, seeds: dict[int, int]) -> None:
        """Start an episode in some environments: environment index -> seed; a negative one lets it rest."""
        self._wait_until_built()
        by_worker: dict[int, list[tuple[int, int]]] = {}
        for index, seed in seeds.items():
            by_worker.setdefault(self._owner[index], []).append((index, seed))
        for worker, pairs in by_worker.items():
            self._send(worker, json.dumps(pairs).encode())
        self._answers(by_worker, self.timeout_s, "resetting")

    def replay_actions(self, episodes: Mapping[int, tuple[int, NDArray[Any]]]) -> set[int]:
        """Begin episodes, environment index -> (seed, actions so far), and take those steps.

        Return the environments whose episode ended on the way: they are not where they were.
        """
        self._wait_until_built()
        by_worker: dict[int, list[int]] = {}
        for env in episodes:
            by_worker.setdefault(self._owner[env], []).append(env)
        for worker, envs in by_worker.items():
            heads = [(env, episodes[env][0], len(episodes[env][1])) for env in envs]
            dtype = self._arrays.action.dtype
            self._send(worker, b"replay_actions " + json.dumps(heads).encode())
            self._send(worker, b"".join(episodes[env][1].astype(dtype).tobytes() for env in envs))
        answers = self._answers(by_worker, self.timeout_s, "replaying episodes")
        return {each["env"] for answer in answers.values() for each in answer.get("ended", ())}

    def step(self) -> list[EpisodeResult]:
        """Step every active environment with the row of `arrays.action`; return the episodes that ended.

        An environment whose episode ended starts the one of `arrays.next_seed`, or rests if that is negative.
        """
        self._send_all(b"step")
        answers = self._answers(range(len(self._processes)), self.timeout_s, "stepping")
        ended = []
        # In the order of the environments, not of the answers: what is decided from the last ones must repeat.
        for _, answer in sorted(answers.items()):
            for each in answer.get("ended", ()):
                ended.append(
                    EpisodeResult(
                        each["env"],
                        each["seed"],
                        each["return"],
                        each["length"],
                        each["success"],
                        each["terms"],
                        each["final_distance"],
                    )
                )
        return ended

    def compute_rewards(self, achieved: NDArray[Any], desired: NDArray[Any]) -> NDArray[np.float64]:
        """Return the rewards that environment 0 computes for steps that reached one goal and were to reach another.

        Goals of shape (n, *goal), rewards (n,). Raises `TaskError`, which names compute_reward, if it raises, hangs, or
        does not return n finite numbers.
        """
        self._wait_until_built()
        self._send(0, goal_rewards.encode_request(achieved, desired))
        answers = self._answers([0], self.timeout_s, "in compute_reward")
        return np.array(answers[0]["rewards"], np.float64)

    def observations(self, rows: Any = slice(None)) -> Observations:
        """Return a copy of the current observations, shape (rows, ...) or a dict of such."""
        return _copy_rows(self.arrays.observation, rows)

    def final_observations(self, rows: Any) -> Observations:
        """Return a copy of the last observations of episodes that just ended."""
        return _copy_rows(self.arrays.final, rows)

    def _send_all(self, message: bytes) -> None:
        for worker in range(len(self._processes)):
            self._send(worker, message)

    def _send(self, worker: int, message: bytes) -> None:
        try:
            self._connections[worker].send_bytes(message)
        except OSError:
            self._fail(self._death(worker, "idle"))

    def _answers(self, workers: Any, timeout_s: float, doing: str) -> dict[int, Any]:
        """Wait for one answer from each of some workers."""
        pending = {self._connections[worker]: worker for worker in workers}
        answers: dict[int, Any] = {}
        deadline = time.monotonic() + timeout_s
        progress = self._progress()
        while pending:
            ready = wait(list(pending), timeout=max(0.0, deadline - time.monotonic()))
            if not ready:
                # A worker answers once for all its environments: only one that stands still for so long hangs.
                if progress == (progress := self._progress()):
                    self._fail(self._hang(list(pending.values()), timeout_s, doing))
                deadline = time.monotonic() + timeout_s
            for connection in ready:
                worker = pending.pop(connection)
                try:
                    content = self._connections[worker].recv_bytes()
                except (EOFError, OSError):
                    self._fail(self._death(worker, doing))
                answer = json.loads(content) if content else {}
                if "error" in answer:
                    self._fail(self._raised(answer["error"]))
                answers[worker] = answer
        return answers

    def _progress(self) -> bytes:
        """Return what changes whenever an environment begins or ends a call."""
        return self._arrays.inside.tobytes() if self._ready else b""

    def _fail(self, error: RlctlError) -> Any:
        self.close(grace_s=0.0)
        raise error from None

    def _raised(self, error: dict[str, Any]) -> RlctlError:
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
            message = str(failed)
        result: RlctlError = kind(message, details=details)
        return result

    @property
    def _hint(self) -> str:
        return f"to see it alone: rlctl check-env {self._spec.task}"

    def _stopped(self, worker: int, message: str) -> TaskError:
        """Name the episode a worker was in when it stopped answering, or the environments it ran."""
        low, high = self._ranges[worker]
        if self._ready:
            for env, (seed, step) in enumerate(self._arrays.inside[low:high].tolist(), start=low):
                if step >= 0:
                    return EpisodeFailed(message, env, seed, step, hint=self._hint)
        return TaskError(f"{message}\nit ran the environments {low} to {high - 1}")

    def _death(self, worker: int, doing: str) -> TaskError:
        try:
            code = self._processes[worker].wait(timeout=5.0)
            how = signal.Signals(-code).name if code < 0 else f"exit code {code}"
        except subprocess.TimeoutExpired:
            how = "it closed its connection"
        if how == "SIGKILL":
            how += ": the system does that when memory runs out; fewer environments (--n-envs) need less"
        return self._stopped(worker, f"task {self._spec.task!r}: worker {worker} died while {doing} ({how})")

    def _hang(self, workers: list[int], timeout_s: float, doing: str) -> TaskError:
        return self._stopped(
            workers[0],
            f"task {self._spec.task!r}: no answer for {timeout_s:g} s while {doing}; "
            "if that may take so long, raise --env-timeout",
        )

    def close(self, grace_s: float = 2.0) -> None:
        """End the workers; those that do not end within `grace_s` are killed. A second call does nothing."""
        for connection in self._connections:
            connection.close()
        self._connections = []
        deadline = time.monotonic() + grace_s
        for process in self._processes:
            end(process, deadline)
        self._processes = []
        while self._lifelines:  # not before they have ended: it kills them
            os.close(self._lifelines.pop())
        self._output.join(timeout=1.0)
        if self._memory >= 0:
            os.close(self._memory)
            self._memory = -1

    def __enter__(self) -> Workers:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


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
