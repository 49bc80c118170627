"""SLURM starts `python -m rlctl.cluster.node WORKS INDEX` on a node: it executes one training of an array.

The exit code is 143 if SLURM must requeue the job, otherwise that of the training.
"""

import dataclasses
import os
import platform
import sys
from collections.abc import Callable
from pathlib import Path

from rlctl.cluster.slurm import BEAT_FILE, STOP_FILE
from rlctl.cluster.work import PREEMPTED, TAKEN, Work, execute
from rlctl.processes.child_process import Standstill
from rlctl.run.job import Job, job_file, read_job, write_job
from rlctl.run.train_request import TrainRequest
from rlctl.storage import files
from rlctl.training.signals import HandledSignals
from rlctl.training.trainings import NextSignal, Trainings


class _NodeTrainings(Trainings):
    """The only training of this node; it receives SLURM's signals."""

    def __init__(self, work: Work) -> None:
        super().__init__(1)
        self._work = work

    def train_work(self, receive: Callable[[str], None]) -> int:
        """Execute the work; return its exit code."""
        folder, lease_s = self._work.folder, self._work.settings["lease_s"]
        beat = Standstill(lambda: _read(folder / BEAT_FILE))

        def must_stop() -> bool:
            if beat.seconds() > lease_s and _read(folder / BEAT_FILE):
                receive(f"error: the driver has not answered for {lease_s:g} s; --detach submits runs that need none")
                return True
            return (folder / STOP_FILE).exists()

        with HandledSignals(self._pass_on):
            code = self.train(TrainRequest.from_json(self._work.request), receive, must_stop)
        return code if self.stopped_by is None or code else PREEMPTED  # a signal came before the training began

    def _execute(self, request: TrainRequest, receive: Callable[[str], None], next_signal: NextSignal) -> int:
        return execute(self._work, receive, next_signal)


def _read(file: Path) -> str:
    try:
        return file.read_text(encoding="utf-8")
    except OSError:
        return ""


def run(works: Path, index: int) -> int:
    """Execute the work at an index and record its state in the job file; return the exit code for SLURM."""
    work = Work(**files.read_json(works)[index])
    folder = work.folder
    before = read_job(folder, work.seed)
    place = f"slurm {os.environ.get('SLURM_ARRAY_JOB_ID', '?')}_{index}"
    attempts = before.attempts + 1 if before is not None and before.place == place else 1
    job = Job(work.seed, work.task, "running", place, platform.node(), attempts)
    write_job(folder, job)
    with job_file(folder, work.seed, "log").open("a", buffering=1, encoding="utf-8") as log:
        code = _NodeTrainings(work).train_work(lambda line: print(line, file=log))
        is_retried = code in (PREEMPTED, TAKEN) and not (folder / STOP_FILE).exists()
        if is_retried and attempts > work.settings["retries"]:
            print(f"error: gave up after {attempts} attempts; raise retries in cluster.yaml for more", file=log)
            is_retried = False
    write_job(
        folder, dataclasses.replace(job, state="queued" if is_retried else "ended", code=None if is_retried else code)
    )
    return PREEMPTED if is_retried else code


if __name__ == "__main__":
    sys.exit(run(Path(sys.argv[1]), int(sys.argv[2])))
