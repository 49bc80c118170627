"""Trainings in child processes, several at a time, each with its share of this machine's cores.

`rlctl.cluster` has subclasses of `Trainings` that train on other machines.
"""

import contextlib
import itertools
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import FrameType
from typing import TypeVar

from rlctl.errors import Interrupted
from rlctl.play.workers import available_cores
from rlctl.printed_lines import LineReader
from rlctl.processes.child_process import ChildEndedError, ChildProcess
from rlctl.runs.train_request import TrainRequest
from rlctl.training.signals import HandledSignals

_CORES_PER_TRAINING = 2  # one for the workers, one for the updates
_WATCH_S = 0.25
_ASK_S = 0.5
Result = TypeVar("Result")


class Detached(Exception):
    """The trainings were submitted; rlctl does not wait for them."""


NextSignal = Callable[[], int]
"""Returns the number of a signal to pass on to a training, 0 for none; asked several times a second."""


class Trainings:
    """Runs calls of `train`, several at a time, on this machine; a signal stops all."""

    is_local = True  # whether the trainings share the cores of this machine
    resume_options = ""  # options that the resume command needs: ` --on slurm`

    def __init__(self, jobs: int) -> None:
        self._jobs = jobs
        self._thread_numbers = itertools.count()
        self._signals: list[int] = []
        self.stopped_by: int | None = None  # the signal that stopped all; later trainings do not start

    def describe(self) -> str:
        """Return as text where trainings run, and how many at a time."""
        cores = f"{_CORES_PER_TRAINING} cores of {available_cores()}"
        return f"{self._jobs} at a time: a training uses {cores}; change with --jobs"

    def run(self, calls: Sequence[Callable[[], Result]], resume_command: str) -> list[Result]:
        """Return the results of the calls. Raises `Interrupted` after a signal, with the command to resume."""
        with HandledSignals(self._pass_on), ThreadPoolExecutor(self._jobs, initializer=self._prepare_thread) as pool:
            results = [future.result() for future in [pool.submit(call) for call in calls]]
        if self.stopped_by is not None:
            raise Interrupted(f"interrupted; resume with: {resume_command}{self.resume_options}", self.stopped_by)
        return results

    def _prepare_thread(self) -> None:
        """Give this thread's trainings their share of the cores, which also sets their number of workers."""
        if self.is_local and self._jobs > 1 and hasattr(os, "sched_setaffinity"):
            cores = sorted(os.sched_getaffinity(0))
            share = max(1, len(cores) // self._jobs)
            first = next(self._thread_numbers) * share % len(cores)
            os.sched_setaffinity(0, cores[first : first + share])

    def train(
        self,
        request: TrainRequest,
        receive: Callable[[str], None],
        is_hopeless: Callable[[], bool] | None = None,
    ) -> int:
        """Train in a child process; return its exit code. `is_hopeless` is called twice a second; True stops it."""
        if self.stopped_by is not None:
            return 0
        return self._execute(request, receive, self._make_next_signal(is_hopeless))

    def _execute(self, request: TrainRequest, receive: Callable[[str], None], next_signal: NextSignal) -> int:
        return train_in_child(request, receive, next_signal)

    def _make_next_signal(self, is_hopeless: Callable[[], bool] | None) -> NextSignal:
        passed_on, asked_s, hopeless = 0, 0.0, False

        def next_signal() -> int:
            nonlocal passed_on, asked_s, hopeless
            if passed_on < len(self._signals):
                passed_on += 1
                return self._signals[passed_on - 1]
            if is_hopeless is not None and not hopeless and time.monotonic() - asked_s > _ASK_S:
                asked_s, hopeless = time.monotonic(), is_hopeless()
                return signal.SIGINT if hopeless else 0
            return 0

        return next_signal

    def _pass_on(self, number: int, frame: FrameType | None) -> None:
        self.stopped_by = self.stopped_by or number
        self._signals.append(number)


MakeTrainings = Callable[[Path, str, int, int | None], Trainings]
"""Takes the folder of the runs, their task, the number of trainings, and `--jobs`."""


def make_local_trainings(folder: Path, task: str, waiting: int, jobs: int | None) -> Trainings:
    """Return trainings on this machine: `jobs` at a time, else as many as the cores allow."""
    return Trainings(min(jobs or max(1, available_cores() // _CORES_PER_TRAINING), max(waiting, 1)))


def train_in_child(
    request: TrainRequest,
    receive: Callable[[str], None],
    next_signal: NextSignal,
    *,
    command: Sequence[str] | None = None,
    env: Mapping[str, str] | None = None,
) -> int:
    """Train in a child process that ends with this one; return its exit code, 128 + N after signal N."""
    reader = LineReader(receive)
    child = ChildProcess(
        "rlctl.launching.child:main",
        {"request": request.to_json(), "command": list(sys.argv if command is None else command)},
        one_thread=False,
        stdout=reader.descriptor,
        stderr=reader.descriptor,
        env=env or {},
    )
    reader.close_descriptor()
    try:
        with contextlib.suppress(ChildEndedError):
            child.receive()  # it ignores signals until it is ready
        while True:
            if number := next_signal():
                with contextlib.suppress(ProcessLookupError):
                    os.kill(child.process.pid, number)
            with contextlib.suppress(subprocess.TimeoutExpired):
                code = child.process.wait(_WATCH_S)
                break
    finally:
        child.close()
    reader.wait()
    return code if code >= 0 else 128 - code
