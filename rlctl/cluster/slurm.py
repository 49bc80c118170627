"""Trainings as an array of SLURM jobs: a script for `sbatch`, and a small file per seed that shows the job's state.

On a node `python -m rlctl.cluster.slurm WORKS INDEX` executes one training. A run that is preempted, out of time or
warned saves a checkpoint and ends with 143; the script then requeues the job. The driver regularly writes a file;
without it, runs save a checkpoint and end after `lease_s`. With `--detach` there is no such file: the array needs no
driver, and a new one can follow it.
"""

import dataclasses
import os
import platform
import shlex
import subprocess
import sys
import threading
import time
import uuid
from collections.abc import Callable, Sequence
from pathlib import Path
from types import FrameType

from rlctl import output
from rlctl.cluster.work import PREEMPTED, TAKEN, ClusterSettings, Work, execute, make_work, mark_shared_folder
from rlctl.errors import TaskError, UsageError
from rlctl.launching.trainings import Detached, NextSignal, Result, Trainings
from rlctl.processes.child_process import Standstill
from rlctl.runs.group import JOBS, Job, job_file, list_jobs, read_job, write_job
from rlctl.runs.train_request import TrainRequest
from rlctl.storage import files
from rlctl.training.signals import HandledSignals

STOP_FILE = f"{JOBS}/stop"  # when this file exists, nodes save a checkpoint and stop their training
BEAT_FILE = f"{JOBS}/beat"  # if it exists and does not change for `lease_s`, nodes do the same: the driver was killed
_POLL_S = 0.5
_BEATS_PER_LEASE = 6
_ASK_QUEUE_S = 15.0
_ASK_AT_THE_END_S = 2.0
_GONE_S = 120.0  # `squeue` may fail for this time, for example while the controller restarts
_SCRIPT = """\
#!/bin/bash
#SBATCH --job-name={name} --array={array} --requeue --open-mode=append
#SBATCH --ntasks=1 --cpus-per-task={cpus} --output={output}
#SBATCH --signal=USR1@60
trap : TERM USR1 USR2  # the step gets them too, saves a checkpoint and ends with 143
cd {cwd} || exit 5
{setup}
srun --ntasks=1 {python} -m rlctl.cluster.slurm {works} "$SLURM_ARRAY_TASK_ID"
code=$?
case $code in  # saved, or ended by a signal before it began
  138|140|143) scontrol requeue "${{SLURM_ARRAY_JOB_ID}}_$SLURM_ARRAY_TASK_ID" && sleep 60 ;;
esac
exit $code
"""


class SlurmTrainings(Trainings):
    """Trains all runs in one array of jobs; with `detach`, `run` raises `Detached` after submitting them."""

    is_local = False
    resume_options = " --on slurm"

    def __init__(
        self,
        folder: Path,
        task: str,
        waiting: int,
        jobs: int | None,
        settings: ClusterSettings,
        *,
        detach: bool = False,
    ) -> None:
        """`waiting` runs in the folder of a group; `jobs` is ignored: SLURM decides how many run."""
        super().__init__(max(waiting, 1))
        self._folder, self._settings, self._detach = folder, settings, detach
        self._token = mark_shared_folder(folder)
        files.remove(folder / STOP_FILE)
        self._works: list[Work] = []
        self._ready = threading.Barrier(self._jobs, action=self._submit)
        self._queue_lock = threading.Lock()
        self._queue_s, self._queue, self._beat_s = 0.0, "", 0.0
        self._queue, self._answered_s = self._ask_queue(), time.monotonic()

    def describe(self) -> str:
        """Describe where the runs train."""
        return f"on SLURM, {output.format_count(self._settings.cpus, 'core')} each"

    def _execute(self, request: TrainRequest, receive: Callable[[str], None], next_signal: NextSignal) -> int:
        try:
            work = make_work(request, self._token, self._settings)
            log = job_file(self._folder, work.seed, "log")
            known = read_job(self._folder, work.seed)
            if known is None or known.state == "ended" or not self._is_queued(known):
                self._works.append(work)
                files.remove(log)
            self._ready.wait()
        except threading.BrokenBarrierError:  # another run could not be submitted, or a signal stops all of them
            return TAKEN if self.stopped_by is None else 128 + self.stopped_by
        except BaseException:
            self._ready.abort()
            raise
        if self._detach:
            files.remove(self._folder / BEAT_FILE)
            return 0
        return self._follow(work.seed, log, receive, next_signal)

    def run(self, calls: Sequence[Callable[[], Result]], resume_command: str) -> list[Result]:
        """Return the result of each call; with `detach`, raise `Detached` once all runs are submitted."""
        results = super().run(calls, resume_command)
        if self._detach and calls:
            raise Detached(f"submitted to SLURM; to follow the runs: {resume_command}{self.resume_options}")
        return results

    def _pass_on(self, number: int, frame: FrameType | None) -> None:
        super()._pass_on(number, frame)
        self._ready.abort()

    def _submit(self) -> None:
        if not self._works:
            return
        self._works.sort(key=lambda work: work.seed)
        folder = self._folder
        works = folder / JOBS / f"array-{uuid.uuid4().hex[:8]}.json"
        files.write_json(works, [dataclasses.asdict(work) for work in self._works])
        script = works.with_suffix(".sbatch")
        content = _SCRIPT.format(
            name=f"rlctl-{folder.name}",
            array=f"0-{len(self._works) - 1}",
            cpus=self._settings.cpus,
            output=shlex.quote(f"{os.path.abspath(folder / JOBS)}/slurm-%a.out"),
            cwd=shlex.quote(os.getcwd()),
            setup="\n".join(self._settings.setup),
            python=shlex.quote(sys.executable),
            works=shlex.quote(os.path.abspath(works)),
        )
        files.write_text(script, content)
        number = _call(["sbatch", "--parsable", *self._settings.sbatch, str(script)]).strip().partition(";")[0]
        for index, work in enumerate(self._works):
            write_job(folder, Job(work.seed, work.task, "queued", f"slurm {number}_{index}"))
        with self._queue_lock:
            self._queue_s, self._queue = time.monotonic(), ""  # the old answer does not list the new jobs

    def _follow(self, seed: int, log: Path, receive: Callable[[str], None], next_signal: NextSignal) -> int:
        position = 0
        while True:
            self._beat()
            time.sleep(_POLL_S)
            job = read_job(self._folder, seed)
            position = _forward_lines(log, position, receive)
            if job is not None and job.state == "ended" and job.code is not None:
                return job.code
            if next_signal():
                files.write_text(self._folder / STOP_FILE, "")
                self._cancel_waiting()
            if job is None or not self._is_queued(job):
                job = read_job(self._folder, seed)  # it may have ended meanwhile
                if job is not None and job.code is not None:
                    continue
                if self.stopped_by is None:
                    place = job.place if job else "its job"
                    receive(f"error: {place} left SLURM's queue without a result; see {self._folder / JOBS}")
                return TAKEN if self.stopped_by is None else 128 + self.stopped_by

    def _beat(self) -> None:
        with self._queue_lock:
            if time.monotonic() - self._beat_s > self._settings.lease_s / _BEATS_PER_LEASE:
                self._beat_s = time.monotonic()
                files.write_text(self._folder / BEAT_FILE, uuid.uuid4().hex)

    def _cancel_waiting(self) -> None:
        for job in list_jobs(self._folder):
            if job.state == "queued":
                subprocess.run(["scancel", "--state=PENDING", job.place.partition(" ")[2]], check=False)

    def _is_queued(self, job: Job) -> bool:
        """Return whether SLURM still has a job; SLURM is asked four times a minute."""
        with self._queue_lock:
            if time.monotonic() - self._queue_s > (_ASK_QUEUE_S if self.stopped_by is None else _ASK_AT_THE_END_S):
                try:
                    self._queue, self._answered_s = self._ask_queue(), time.monotonic()
                except TaskError:
                    if time.monotonic() - self._answered_s > _GONE_S:
                        raise
                self._queue_s = time.monotonic()
            elif not self._queue:
                return True
            return job.place.partition(" ")[2] in self._queue.split()

    def _ask_queue(self) -> str:
        return _call(["squeue", "--noheader", "--array", "--format=%i", "--user", str(os.getuid())]) or "-"


def _forward_lines(log: Path, position: int, receive: Callable[[str], None]) -> int:
    """Call `receive` with each complete line of a file after a position; return the next position."""
    try:
        with log.open("rb") as file:
            file.seek(position)
            content = file.read()
    except OSError:
        return position
    whole = content[: content.rfind(b"\n") + 1]
    for line in whole.decode(errors="replace").splitlines():
        receive(line)
    return position + len(whole)


def _call(command: list[str]) -> str:
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    except FileNotFoundError:
        hint = "is not installed on this machine; use a login node of the cluster"
        raise UsageError(f"--on slurm: {command[0]} {hint}") from None
    except subprocess.TimeoutExpired:
        raise TaskError(f"--on slurm: {command[0]} did not answer within 60 s") from None
    if done.returncode:
        reason = (done.stderr or done.stdout).strip().partition("\n")[0]
        raise TaskError(f"--on slurm: {command[0]} failed: {reason}")
    return done.stdout


class _NodeTrainings(Trainings):
    """The only training of this node; it receives SLURM's signals."""

    def __init__(self, work: Work) -> None:
        super().__init__(1)
        self._work = work

    def train_work(self, receive: Callable[[str], None]) -> int:
        """Execute the work; return its exit code."""
        folder, lease_s = self._work.folder, self._work.settings["lease_s"]
        beat = Standstill(lambda: _read_beat(folder))

        def must_stop() -> bool:
            if beat.seconds() > lease_s and _read_beat(folder):
                receive(f"error: the driver has not answered for {lease_s:g} s; --detach submits runs that need none")
                return True
            return (folder / STOP_FILE).exists()

        with HandledSignals(self._pass_on):
            code = self.train(TrainRequest.from_json(self._work.request), receive, must_stop)
        return code if self.stopped_by is None or code else PREEMPTED  # a signal came before the training began

    def _execute(self, request: TrainRequest, receive: Callable[[str], None], next_signal: NextSignal) -> int:
        return execute(self._work, receive, next_signal)


def _read_beat(folder: Path) -> str:
    try:
        return (folder / BEAT_FILE).read_text(encoding="utf-8")
    except OSError:
        return ""


def run_on_node(works: Path, index: int) -> int:
    """Execute a work, record it in its job file; return its exit code, or 143 if SLURM must requeue the job."""
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
    state, result = ("queued", None) if is_retried else ("ended", code)
    write_job(folder, dataclasses.replace(job, state=state, code=result))
    return PREEMPTED if is_retried else code


if __name__ == "__main__":
    sys.exit(run_on_node(Path(sys.argv[1]), int(sys.argv[2])))
