"""The connection to Ray, and trainings as its tasks.

`ray` starts Ray on this machine, `ray:auto` and `ray:HOST:PORT` use a running cluster. Ray retries a task whose machine
is lost; the new attempt resumes the run. Each attempt calls an actor on the driver's node regularly: it sends lines,
and the answer is a signal. An attempt that gets no answer for `lease_s` ends itself.
"""

import atexit
import contextlib
import dataclasses
import os
import platform
import secrets
import shutil
import socket
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from rlctl.cluster.work import PREEMPTED, TAKEN, ClusterSettings, Work, execute, make_work, mark_shared_folder
from rlctl.environments import registry
from rlctl.errors import TaskError, UsageError, explain_missing_package
from rlctl.launching.trainings import NextSignal, Trainings
from rlctl.play.workers import available_cores
from rlctl.runs.group import Job, read_job, write_job
from rlctl.runs.train_request import TrainRequest

_BEAT_S = 0.5
_POLL_S = 0.3
_RETRY_S = 2.0
_MOST_AT_ONCE = 256  # trainings that the driver follows at the same time
_ASK_S, _GONE_S = 5.0, 30.0


def connect(address: str, task: str, cpus: int) -> Any:
    """Connect to Ray at an address, or start it on this machine if the address is empty; return the module `ray`.

    Nodes get a copy of the current folder if `is_copied(task)`. A Ray on this machine has at least `cpus` cores.
    Raises `UsageError` if Ray is not installed, and `TaskError` if it cannot be reached.
    """
    if (started := sys.modules.get("ray")) is not None and started.is_initialized():
        return started
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    os.environ.setdefault("RAY_DEDUP_LOGS", "0")
    if not address:
        # Without this Ray listens on all addresses of the machine, and writes a token into the home folder.
        folder = tempfile.mkdtemp(prefix="rlctl-ray-")
        atexit.register(shutil.rmtree, folder, ignore_errors=True)  # after Ray's own handler, which is registered later
        token = Path(folder) / "token"
        token.write_text(secrets.token_hex(32))  # only this user can read its folder
        os.environ |= {"RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER": "0", "RAY_TMPDIR": folder}
        os.environ |= {"RAY_AUTH_MODE": "token", "RAY_AUTH_TOKEN_PATH": str(token)}
    try:
        import ray
    except ModuleNotFoundError as error:
        raise UsageError(explain_missing_package("--on ray", error.name, "cluster")) from None
    options: dict[str, Any] = {"log_to_driver": False, "logging_level": "ERROR"}
    if address:
        options["address"] = address
    else:
        options |= {"include_dashboard": False, "_node_ip_address": "127.0.0.1"}
        options["num_cpus"] = max(cpus, available_cores())
    if is_copied(task):
        options["runtime_env"] = {"working_dir": os.getcwd(), "excludes": ["/runs"]}
    try:
        if address not in ("", "auto"):
            host, _, port = address.rpartition(":")
            socket.create_connection((host, int(port)), timeout=10).close()  # Ray itself tries for ten minutes
        ray.init(**options)
    except Exception as error:  # ConnectionError, ValueError or RuntimeError
        reason = str(error).partition("\n")[0]
        raise TaskError(f"--on ray:{address or 'local'}: cannot be reached: {reason}") from None
    return ray


class Pulse:
    """Raises an error if the cluster is lost; Ray itself would end this process after 60 s, without rlctl's message."""

    def __init__(self, ray: Any, hint: str = "") -> None:
        host, _, port = ray.get_runtime_context().gcs_address.rpartition(":")
        self._address, self._hint = (host, int(port)), hint
        self._asked_s = self._answered_s = time.monotonic()

    def check(self) -> None:
        """Connect to the cluster every few seconds; raise `TaskError` after `_GONE_S` without an answer."""
        if time.monotonic() - self._asked_s < _ASK_S:
            return
        self._asked_s = time.monotonic()
        try:
            socket.create_connection(self._address, _ASK_S).close()
            self._answered_s = time.monotonic()
        except OSError:
            if time.monotonic() - self._answered_s > _GONE_S:
                raise TaskError(f"--on ray: the cluster has not answered for {_GONE_S:g} s{self._hint}") from None


def is_copied(task: str) -> bool:
    """Return whether nodes get a copy of the current folder: the task is a file or module in it."""
    place = task.rpartition(":")[0]
    source = registry.find_source_file(task) if place and not Path(place).is_absolute() else None
    return source is not None and source.resolve().is_relative_to(Path.cwd())


def describe_slots(ray: Any, cpus: int, most: int) -> tuple[str, int]:
    """Return how many of `most` run at a time with `cpus` cores each: as text, and as a number."""
    cores = [node["Resources"].get("CPU", 0) for node in ray.nodes() if node["Alive"]]
    slots = min(most, sum(int(count // cpus) for count in cores))
    if not slots:
        return f"on Ray: waiting, because no machine has {cpus} cores (cpus in cluster.yaml)", 0
    return f"on Ray, {slots} at a time: {cpus} of its {sum(cores):g} cores each", slots


class Mailbox:
    """An actor on the driver's node that passes messages between the driver and the attempts."""

    def __init__(self) -> None:
        self._attempts: dict[int, int] = defaultdict(int)
        self._hosts: dict[int, str] = {}
        self._lines: dict[int, list[str]] = defaultdict(list)
        self._signals: dict[int, list[int]] = defaultdict(list)

    def begin(self, seed: int, host: str) -> int:
        """Register a new attempt, which supersedes all earlier ones; return its number."""
        self._attempts[seed] += 1
        self._hosts[seed] = host
        return self._attempts[seed]

    def beat(self, seed: int, attempt: int, lines: list[str]) -> int:
        """Store an attempt's lines; return a signal for it, 0 for none, -1 if the attempt is superseded."""
        if attempt != self._attempts[seed]:
            return -1
        self._lines[seed] += lines
        return self._signals[seed].pop(0) if self._signals[seed] else 0

    def stop(self, seed: int, number: int) -> None:
        """Store a signal until the next beat."""
        self._signals[seed].append(number)

    def take(self, seed: int) -> tuple[list[str], str, int]:
        """Return the lines since the last call, the host and the number of the attempt."""
        return self._lines.pop(seed, []), self._hosts.get(seed, ""), self._attempts[seed]


class _Superseded(Exception):
    """A newer attempt writes the run, or the driver has ended."""


def train_on_node(mailbox: Any, content: dict[str, Any]) -> int:
    """On a node: train, and retry if preempted or if another process still writes the run; return the exit code."""
    import ray

    work = Work(**content)
    thread = ThreadPoolExecutor(1)

    def ask(call: Any, timeout_s: float | None = None) -> int:
        # If the main thread of a task waited in `ray.get`, Ray would give its cores to another task.
        get: Callable[..., Any] = ray.get
        return int(thread.submit(get, call, timeout=timeout_s).result())

    attempt = ask(mailbox.begin.remote(work.seed, platform.node()))
    lines: list[str] = []
    heard_s = beat_s = time.monotonic()
    stopped = False

    def beat() -> int:
        nonlocal heard_s, beat_s, stopped
        batch, lines[:] = lines[:], []
        lease_s = work.settings["lease_s"]
        try:
            answer = ask(mailbox.beat.remote(work.seed, attempt, batch), lease_s)
            heard_s = time.monotonic()
        except ray.exceptions.RayError:
            answer, lines[:0] = 0, batch
        if answer < 0 or time.monotonic() - heard_s > lease_s:
            raise _Superseded
        beat_s = time.monotonic()
        stopped = stopped or answer > 0
        return answer

    def next_signal() -> int:
        return beat() if time.monotonic() - beat_s > _BEAT_S else 0

    code = TAKEN
    with contextlib.suppress(_Superseded):
        for retry in range(work.settings["retries"] + 1):
            code = execute(work, lines.append, next_signal)
            beat()
            if code not in (PREEMPTED, TAKEN) or stopped:
                break
            time.sleep(_RETRY_S * (retry + 1))
    return code


class RayTrainings(Trainings):
    """Trains on Ray; as many at a time as its cores allow."""

    is_local = False

    def __init__(
        self, address: str, folder: Path, task: str, waiting: int, jobs: int | None, settings: ClusterSettings
    ) -> None:
        super().__init__(min(jobs or _MOST_AT_ONCE, max(waiting, 1), _MOST_AT_ONCE))
        self.resume_options = f" --on ray{f':{address}' if address else ''}"
        self._ray, self._settings, self._folder = connect(address, task, settings.cpus), settings, folder
        self._pulse = Pulse(self._ray, f"; resume with --resume {folder}")
        self._token = mark_shared_folder(folder)
        self._mailbox = _make_mailbox(self._ray)
        self._task = self._ray.remote(num_cpus=settings.cpus, max_retries=settings.retries)(train_on_node)

    def describe(self) -> str:
        """Describe where the runs train, and how many at a time."""
        return describe_slots(self._ray, self._settings.cpus, self._jobs)[0]

    def _execute(self, request: TrainRequest, receive: Callable[[str], None], next_signal: NextSignal) -> int:
        work = make_work(request, self._token, self._settings)
        work = dataclasses.replace(work, has_copy=is_copied(work.task))
        job = Job(work.seed, work.task, "queued", "ray")
        write_job(self._folder, job)
        reference = self._task.remote(self._mailbox, dataclasses.asdict(work))
        code = TAKEN
        try:
            code = self._follow(reference, work, job, receive, next_signal)
        except self._ray.exceptions.TaskCancelledError:
            code = 128 + (self.stopped_by or 0)
        except self._ray.exceptions.RayError as error:
            reason = str(error).partition("\n")[0]
            receive(f"error: lost on Ray after {self._settings.retries} retries: {type(error).__name__}: {reason}")
        job = read_job(self._folder, work.seed) or job
        write_job(self._folder, dataclasses.replace(job, state="ended", code=code))
        return code

    def _follow(
        self, reference: Any, work: Work, job: Job, receive: Callable[[str], None], next_signal: NextSignal
    ) -> int:
        ray = self._ray
        while True:
            done, _ = ray.wait([reference], timeout=_POLL_S)
            self._pulse.check()
            lines, host, attempts = ray.get(self._mailbox.take.remote(work.seed))
            for line in lines:
                receive(line)
            if attempts != job.attempts:
                if job.attempts:
                    receive(f"attempt {attempts} on {host}: the previous attempt was lost")
                job = dataclasses.replace(job, state="running", host=host, attempts=attempts)
                write_job(self._folder, job)
            if done:
                return int(ray.get(reference))
            if number := next_signal():
                ray.get(self._mailbox.stop.remote(work.seed, number))
                if not attempts:
                    ray.cancel(reference)


def _make_mailbox(ray: Any) -> Any:
    from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

    # Ray may place actors without cores on any node; on this one the mailbox survives the loss of other nodes.
    here = NodeAffinitySchedulingStrategy(ray.get_runtime_context().get_node_id(), soft=False)
    return ray.remote(num_cpus=0)(Mailbox).options(scheduling_strategy=here).remote()
