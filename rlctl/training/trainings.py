"""Trainings in processes of their own, some of them at a time, each with its share of the cores."""

from __future__ import annotations

import contextlib
import itertools
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from types import FrameType
from typing import TypeVar

from rlctl.errors import Interrupted
from rlctl.processes.child_process import ChildProcess
from rlctl.processes.printed_lines import LineReader
from rlctl.rollout.workers import available_cores
from rlctl.run.train_request import TrainRequest
from rlctl.training.signals import HandledSignals

CORES_PER_TRAINING = 2
"""One plays while the other learns, in turn or side by side."""
_WATCH_S = 0.5
Result = TypeVar("Result")


def choose_jobs(jobs: int | None, waiting: int) -> int:
    """Return how many of `waiting` trainings run at a time: as many as the cores allow, if `jobs` does not say it."""
    return min(jobs or max(1, available_cores() // CORES_PER_TRAINING), max(waiting, 1))


class Trainings:
    """Runs calls that each `train`, some of them at a time; a signal stops them all."""

    def __init__(self, jobs: int) -> None:
        self._jobs = jobs
        self._places = itertools.count()
        self._running: set[int] = set()  # by process id
        self.stopped_by: int | None = None
        """The signal that stops all; what has not begun then does not begin."""

    def run(self, calls: Sequence[Callable[[], Result]], to_go_on: str) -> list[Result]:
        """Return what each call returns. Raises `Interrupted` after a signal, with the command to go on with."""
        with HandledSignals(self._pass_on), ThreadPoolExecutor(self._jobs, initializer=self._take_cores) as pool:
            results = [future.result() for future in [pool.submit(call) for call in calls]]
        if self.stopped_by is not None:
            raise Interrupted(f"interrupted; resume with: {to_go_on}", self.stopped_by)
        return results

    def _take_cores(self) -> None:
        """Let what this thread starts use its share of the cores, from which it also takes its number of workers."""
        place = next(self._places)
        if self._jobs > 1 and hasattr(os, "sched_setaffinity"):
            cores = sorted(os.sched_getaffinity(0))
            share = max(1, len(cores) // self._jobs)
            first = place * share % len(cores)
            os.sched_setaffinity(0, cores[first : first + share])

    def train(
        self,
        request: TrainRequest,
        receive: Callable[[str], None],
        is_hopeless: Callable[[], bool] | None = None,
    ) -> int:
        """Train in a process that ends with this one; return the exit code. `receive` gets the lines that it prints.

        `is_hopeless` is asked twice a second, and ends the training with a checkpoint.
        """
        if self.stopped_by is not None:
            return 0
        reader = LineReader(receive)
        child = ChildProcess(
            "rlctl.training.child:main",
            {"request": request.to_json(), "command": sys.argv},
            one_thread=False,
            stdout=reader.descriptor,
            stderr=reader.descriptor,
        )
        reader.close_descriptor()
        process = child.process
        try:
            with contextlib.suppress(EOFError, OSError):
                child.connection.recv_bytes()  # until then it ignores signals
            self._running.add(process.pid)
            if self.stopped_by is not None:  # meanwhile
                os.kill(process.pid, self.stopped_by)
            while is_hopeless is not None:
                with contextlib.suppress(subprocess.TimeoutExpired):
                    process.wait(_WATCH_S)
                    break
                if is_hopeless():
                    os.kill(process.pid, signal.SIGINT)
                    break
            code = process.wait()
        finally:
            self._running.discard(process.pid)
            child.close()
        reader.wait()
        return code if code >= 0 else 128 - code

    def _pass_on(self, number: int, frame: FrameType | None) -> None:
        self.stopped_by = self.stopped_by or number
        for process in list(self._running):
            with contextlib.suppress(ProcessLookupError):
                os.kill(process, number)
