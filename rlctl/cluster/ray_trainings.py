"""Trainings as tasks of Ray: `ray` starts one on this machine, `ray:auto` and `ray:HOST:PORT` use one that runs.

Ray tries a task again whose machine is lost; the attempt resumes the run. Lines and signals go through an actor on the
driver's node: each beat of an attempt brings lines and takes a signal back. An attempt that gets no answer for
`lease_s` ends itself.
"""

from __future__ import annotations

import contextlib
import dataclasses
import os
import platform
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from typing import Any

from rlctl.cluster import work as cluster_work
from rlctl.cluster.settings import ClusterSettings
from rlctl.cluster.work import PREEMPTED, TAKEN, Work, make_work, mark_shared_folder
from rlctl.errors import TaskError, UsageError, explain_missing_package
from rlctl.run.job import Job, read_job, write_job
from rlctl.run.train_request import TrainRequest
from rlctl.training.trainings import NextSignal, Trainings

_BEAT_S = 0.5
_POLL_S = 0.3
_RETRY_S = 2.0
_MOST_AT_ONCE = 256
"""Trainings that the driver follows at the same time."""


def connect(address: str) -> Any:
    """Return the module `ray`, connected: to a Ray of its own on this machine for ``, else to that at an address.

    Raises `UsageError` without Ray, and `TaskError` if it cannot be reached.
    """
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    os.environ.setdefault("RAY_DEDUP_LOGS", "0")
    if not address:
        # Without this Ray listens on all addresses of the machine, and writes a token into the home folder.
        folder = tempfile.mkdtemp(prefix="rlctl-ray-")
        os.environ.update(
            {"RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER": "0", "RAY_TMPDIR": folder, "RAY_AUTH_TOKEN_PATH": f"{folder}/token"}
        )
    try:
        import ray
    except ModuleNotFoundError as error:
        raise UsageError(explain_missing_package("--on ray", error.name, "cluster")) from None
    if ray.is_initialized():
        return ray
    options: dict[str, Any] = {"log_to_driver": False, "logging_level": "ERROR"}
    options |= {"address": address} if address else {"include_dashboard": False, "_node_ip_address": "127.0.0.1"}
    try:
        ray.init(**options)
    except Exception as error:  # ConnectionError, ValueError, RuntimeError: whatever Ray has for it
        raise TaskError(
            f"--on ray:{address or 'local'}: cannot be reached: {str(error).partition(chr(10))[0]}"
        ) from None
    return ray


class Mailbox:
    """An actor on the driver's node, which stands between the driver and the attempts."""

    def __init__(self) -> None:
        self._attempts: dict[int, int] = defaultdict(int)
        self._hosts: dict[int, str] = {}
        self._lines: dict[int, list[str]] = defaultdict(list)
        self._signals: dict[int, list[int]] = defaultdict(list)

    def begin(self, seed: int, host: str) -> int:
        """Note a new attempt; return its number. All attempts before it are superseded."""
        self._attempts[seed] += 1
        self._hosts[seed] = host
        return self._attempts[seed]

    def beat(self, seed: int, attempt: int, lines: list[str]) -> int:
        """Take lines; return a signal for the training, 0 for none, -1 for an attempt that is superseded."""
        if attempt != self._attempts[seed]:
            return -1
        self._lines[seed] += lines
        return self._signals[seed].pop(0) if self._signals[seed] else 0

    def stop(self, seed: int, number: int) -> None:
        """Keep a signal for the next beat."""
        self._signals[seed].append(number)

    def take(self, seed: int) -> tuple[list[str], str, int]:
        """Return the lines since the last call, the host and the number of the attempt."""
        return self._lines.pop(seed, []), self._hosts.get(seed, ""), self._attempts[seed]


class _Superseded(Exception):
    """A newer attempt has the run, or the driver is gone."""


def train_on_node(mailbox: Any, content: dict[str, Any]) -> int:
    """On a node: execute a work, again if it was preempted or the run is still being written; return the exit code."""
    import ray

    work = cluster_work.from_json(content)
    attempt = ray.get(mailbox.begin.remote(work.seed, platform.node()))
    lines: list[str] = []
    heard_s = beat_s = time.monotonic()
    stopped = False

    def beat() -> int:
        nonlocal heard_s, beat_s, stopped
        batch, lines[:] = lines[:], []
        lease_s = work.settings["lease_s"]
        try:
            answer = int(ray.get(mailbox.beat.remote(work.seed, attempt, batch), timeout=lease_s))
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
            code = cluster_work.execute(work, lines.append, next_signal)
            beat()
            if code not in (PREEMPTED, TAKEN) or stopped:
                break
            time.sleep(_RETRY_S * (retry + 1))
    return code


class RayTrainings(Trainings):
    """Trains on Ray; as many at a time as its cores allow."""

    def __init__(self, address: str, folder: Path, waiting: int, jobs: int | None, settings: ClusterSettings) -> None:
        super().__init__(min(jobs or _MOST_AT_ONCE, max(waiting, 1), _MOST_AT_ONCE))
        self.resume_options = f" --on ray{f':{address}' if address else ''}"
        self._ray, self._settings, self._folder = connect(address), settings, folder
        self._token = mark_shared_folder(folder)
        self._mailbox = _make_mailbox(self._ray)
        self._task = self._ray.remote(num_cpus=settings.cpus, max_retries=settings.retries)(train_on_node)

    def describe(self) -> str:
        """Say where, and how many at a time, they train."""
        cores = self._ray.cluster_resources().get("CPU", 0)
        at_once = int(cores // self._settings.cpus)
        if not at_once:
            return f"on Ray, which has {cores:g} cores: no free slot for {self._settings.cpus} (cpus in cluster.yaml)"
        return f"on Ray, {min(at_once, self._jobs)} at a time: {self._settings.cpus} of its {cores:g} cores each"

    def _prepare_thread(self) -> None:
        """The driver only waits."""

    def _execute(self, request: TrainRequest, receive: Callable[[str], None], next_signal: NextSignal) -> int:
        work = make_work(request, self._token, self._settings)
        job = Job(work.seed, work.task, "queued", "ray")
        write_job(self._folder, job)
        reference = self._task.remote(self._mailbox, cluster_work.to_json(work))
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
        """Pass on lines and signals until the task has ended; return its exit code."""
        ray = self._ray
        while True:
            done, _ = ray.wait([reference], timeout=_POLL_S)
            lines, host, attempts = ray.get(self._mailbox.take.remote(work.seed))
            for line in lines:
                receive(line)
            if attempts != job.attempts:
                if job.attempts:
                    receive(f"attempt {attempts} on {host}: the one before was lost")
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

    # Ray places actors without cores anywhere: on this node it is not lost with another.
    here = NodeAffinitySchedulingStrategy(ray.get_runtime_context().get_node_id(), soft=False)
    return ray.remote(num_cpus=0)(Mailbox).options(scheduling_strategy=here).remote()
