"""The state of a training that a cluster executes: a small file per seed in the folder of the group."""

import dataclasses
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from rlctl.errors import ArtifactError
from rlctl.storage import files

JOBS = ".jobs"  # the folder of these files, in the folder of a group or a tuning


@dataclasses.dataclass(frozen=True)
class Job:
    """Where the training of a seed is, and how often it was tried."""

    seed: int
    task: str
    state: str  # `queued`, `running` or `ended`
    place: str = ""  # its name in the cluster, such as `slurm 123_4`
    host: str = ""  # the machine of the last attempt
    attempts: int = 0
    code: int | None = None  # the exit code, once it has ended

    def describe(self) -> str:
        """Return where it is, in words: `on node7 as slurm 123_4, attempt 2`."""
        where = f"on {self.host} as {self.place}" if self.state == "running" else f"as {self.place}"
        return f"{where}, attempt {self.attempts}" if self.attempts > 1 else where


def job_file(folder: Path, seed: int, kind: str = "json") -> Path:
    """Return a file of a seed's job: `json`, or what the training prints, `log`."""
    return folder / JOBS / f"{seed}.{kind}"


def write_job(folder: Path, job: Job) -> None:
    """Write a job's state, atomically."""
    files.write_json(job_file(folder, job.seed), dataclasses.asdict(job))


def read_job(folder: Path, seed: int) -> Job | None:
    """Read the job of a seed; None if there is none, or its file cannot be read."""
    try:
        content: Any = files.read_json(job_file(folder, seed))
        return Job(**content)
    except (ArtifactError, OSError, TypeError):
        return None


def list_jobs(folder: Path) -> Iterator[Job]:
    """Yield the jobs in the folder of a group that have not ended."""
    for file in sorted((folder / JOBS).glob("*.json")):
        if file.stem.isdecimal() and (job := read_job(folder, int(file.stem))) is not None and job.state != "ended":
            yield job
