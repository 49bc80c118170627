"""A group: the runs of one task with several seeds, in one folder, and where a cluster executes each of them."""

import dataclasses
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from rlctl.errors import ArtifactError, UsageError
from rlctl.runs.directory import GROUP_FILE, ROOT, RunDirectory, create_group_folder, is_group
from rlctl.runs.lookup import find_run, refuse_tuning
from rlctl.runs.train_request import TrainRequest
from rlctl.storage import files

VERSION = 2  # of the format of `group.json`
_NOT_STORED = {"root", "resume"}  # arguments: the runs of a group are always in its folder
_MOST_SEEDS = 1000
_RANGE = re.compile(r"(\d{1,9})(?:-(\d{1,9}))?")
JOBS = ".jobs"  # in the folder of a group or a tuning: a small file per seed that a cluster trains


@dataclasses.dataclass(frozen=True)
class Group:
    """The folder of a group and what its `group.json` says."""

    path: Path
    seeds: list[int]
    request: TrainRequest  # the request of every seed, without the seed

    @property
    def task(self) -> str:
        """The task that is trained."""
        return self.request.task or ""

    @property
    def scores_file(self) -> Path:
        """Where the scores of all seeds are written at the end."""
        return self.path / "scores.json"

    def find_run(self, seed: int) -> RunDirectory | None:
        """Return the newest run of a seed; None if it has not begun."""
        return find_run_of_seed(self.path, seed)

    def is_done(self, seed: int) -> bool:
        """Return whether a seed's training has finished; False if its run cannot be read."""
        run = self.find_run(seed)
        try:
            return run is not None and run.status().get("status") == "finished"
        except ArtifactError:
            return False


def find_run_of_seed(folder: Path, seed: int) -> RunDirectory | None:
    """Return the newest run of a seed in the folder of a group; None if it has not begun."""
    pattern = re.compile(rf"_s{seed}(_\d+)?$")
    folders = [file.parent for file in folder.glob("*/run.json") if pattern.search(file.parent.name)]
    return RunDirectory(max(folders, key=lambda folder: folder.name)) if folders else None


def parse_seeds(text: str) -> list[int]:
    """Return the seeds of `0-4` or `0,3,7-9`; raises `UsageError` for text that is not one, and for a seed twice."""
    seeds: list[int] = []
    for part in text.split(","):
        match = _RANGE.fullmatch(part.strip())
        first, last = (int(match[1]), int(match[2] or match[1])) if match else (0, -1)
        if not 0 <= last - first < _MOST_SEEDS:
            raise UsageError(f"--seeds {text}: write a range or a list, such as 0-4 or 0,3,7; at most {_MOST_SEEDS:,}")
        seeds += range(first, last + 1)
    if twice := [seed for seed in seeds if seeds.count(seed) > 1]:
        raise UsageError(f"--seeds {text}: seed {twice[0]} is given twice")
    return seeds


def create_group(request: TrainRequest, seeds: list[int]) -> Group:
    """Make a new group folder, `<root>/<task>/<time>_seeds`, for the task of a request."""
    folder = create_group_folder(request.task or "", "seeds", request.root)
    content = {key: value for key, value in request.to_json().items() if key not in _NOT_STORED}
    files.write_json(folder / GROUP_FILE, {"version": VERSION, "seeds": seeds, "request": content})
    return Group(folder, seeds, dataclasses.replace(request, root=folder))


def find_group(text: str, root: Path = ROOT) -> Path | None:
    """Return the group of a folder, a task's name or `latest`; None if the run is not in a group."""
    if is_group(Path(text)):
        return Path(text)
    folder = find_run(text, root, to_train=True).path.parent
    return folder if is_group(folder) and not (Path(text) / "run.json").is_file() else None


def read_group(path: Path) -> Group:
    """Read a group; raises `ArtifactError` for a folder that is not one, or damaged."""
    refuse_tuning(path)
    file = path / GROUP_FILE
    content: Any = files.read_json(file)
    try:
        seeds = content["seeds"]
        request = TrainRequest.from_json({**content["request"], "root": str(path), "resume": None})
        are_seeds = all(type(seed) is int and 0 <= seed < 2**32 for seed in seeds) and len(set(seeds)) == len(seeds)
        if content["version"] != VERSION or request.task is None or not are_seeds:
            raise ValueError
        return Group(path, list(seeds), request)
    except (KeyError, TypeError, ValueError):
        raise ArtifactError(
            f"{file}: damaged, or written by another version of rlctl; resume the runs of the group one by one"
        ) from None


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
        return Job(**files.read_json(job_file(folder, seed)))
    except (ArtifactError, OSError, TypeError):
        return None


def list_jobs(folder: Path) -> Iterator[Job]:
    """Yield the jobs in the folder of a group that have not ended."""
    for file in sorted((folder / JOBS).glob("*.json")):
        if file.stem.isdecimal() and (job := read_job(folder, int(file.stem))) is not None and job.state != "ended":
            yield job
