"""`cluster.yaml`; `Work`, the description of one training as JSON; and how a node executes it.

The node decides whether to begin or resume the run: a retry resumes it.
"""

import dataclasses
import os
import platform
import sys
import uuid
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import pydantic
from pydantic import Field

from rlctl.environments.registry import identify_task
from rlctl.errors import ArtifactError, RlctlError
from rlctl.launching.trainings import NextSignal, train_in_child
from rlctl.runs.directory import RunDirectory
from rlctl.runs.group import JOBS, find_run_of_seed, list_jobs
from rlctl.runs.lookup import locate_task
from rlctl.runs.train_request import TrainRequest
from rlctl.storage import files, yaml_text
from rlctl.version import collect_versions

FILE = Path("cluster.yaml")  # read if it exists and no other file is given
PREEMPTED, TAKEN = 143, 75
"""Exit codes after which a training is retried: the cluster ended it; another process writes the run."""
_TOKEN_FILE = f"{JOBS}/driver"
"""The driver writes a token into it; a node that reads a different token has a different folder mounted."""


class ClusterSettings(pydantic.BaseModel, extra="forbid"):
    """The content of `cluster.yaml`."""

    cpus: int = Field(2, ge=1)  # cores of each run
    retries: int = Field(3, ge=0, le=1000)  # how often a run is retried after its machine was lost or it was preempted
    lease_s: float = Field(60.0, gt=0)
    """A run ends itself if the driver has not answered for this time [s]; not with `--detach`."""
    sbatch: list[str] = []  # options for `sbatch`, such as `--time=04:00:00`
    setup: list[str] = []  # shell commands that a SLURM node runs first, such as `source .venv/bin/activate`

    @pydantic.model_validator(mode="before")
    @classmethod
    def _accept_comments_alone(cls, content: Any) -> Any:
        return {} if content is None else content


def read_settings(path: Path | None) -> ClusterSettings:
    """Read a file, by default `cluster.yaml` if it exists; raises `RecipeError` if it is invalid."""
    if path is None and not FILE.is_file():
        return ClusterSettings()
    return yaml_text.read_model(path or FILE, ClusterSettings)


@dataclasses.dataclass(frozen=True)
class Work:
    """What a node needs to know to execute a training."""

    seed: int
    task: str
    request: dict[str, Any]  # a `TrainRequest` as JSON
    root: str  # the folder of the group or tuning, absolute
    cwd: str  # the driver's current folder; the paths of the task and the run are relative to it
    command: list[str]  # the driver's command, for the run's record
    token: str  # the content of the driver's file in the shared folder
    versions: dict[str, str]
    source_sha256: str | None  # hash of the task's file on the driver
    settings: dict[str, Any]  # `ClusterSettings`
    has_copy: bool = False  # whether nodes work in a copy of the driver's current folder

    @property
    def folder(self) -> Path:
        """The folder of the group or tuning."""
        return Path(self.root)


def make_work(request: TrainRequest, token: str, settings: ClusterSettings) -> Work:
    """Return the work of a request for a run in a group."""
    run = RunDirectory(Path(request.resume)) if request.resume is not None else None
    seed = int(run.recipe().seed if run is not None else request.settings["seed"])
    task = locate_task(run.status()["task"], run) if run is not None else str(request.task)
    root = request.root.absolute()
    # A node may be in a copy of the current folder, which has no runs and nothing from outside.
    resume, policy = _make_absolute(request.resume), _make_absolute(request.initial_policy)
    demos = request.demos
    if demos is not None and os.path.exists(demos):  # else the name of a dataset
        demos = os.path.abspath(demos)
    on_node = dataclasses.replace(request, root=root, resume=resume, initial_policy=policy, demos=demos)
    return Work(
        seed=seed,
        task=task,
        request=on_node.to_json(),
        root=str(root),
        cwd=os.getcwd(),
        command=sys.argv,
        token=token,
        **describe_driver(task),
        settings=settings.model_dump(),
    )


def _make_absolute(path: str | None) -> str | None:
    return os.path.abspath(path) if path and os.sep in path and os.path.exists(path) else path


def mark_shared_folder(folder: Path) -> str:
    """Write a token into the folder of a group, so that nodes recognise the folder; return the token."""
    file = folder / _TOKEN_FILE
    (folder / JOBS).mkdir(exist_ok=True)
    if file.is_file() and any(list_jobs(folder)):  # these jobs have the earlier token
        return file.read_text(encoding="utf-8")
    files.write_text(file, token := uuid.uuid4().hex)
    return token


def execute(work: Work, receive: Callable[[str], None], next_signal: NextSignal) -> int:
    """Check this machine's folder and versions, then train; return the exit code.

    `receive` gets the lines that the training prints, and error messages. Any exception from `next_signal` kills the
    training and is raised.
    """
    try:
        _enter_folder(work)
        for warning in compare_versions(work.task, work.versions, work.source_sha256):
            receive(warning)
        request = TrainRequest.from_json(work.request)
        if request.resume is None and (run := find_run_of_seed(work.folder, work.seed)) is not None:
            request = request.to_resume(run.path, {})  # of an earlier attempt
    except RlctlError as error:
        receive(f"error: {error}")
        return error.exit_code
    env = {"RLCTL_CORES": str(work.settings["cpus"])} | ({"RLCTL_FOLDER": work.cwd} if work.has_copy else {})
    return train_in_child(request, receive, next_signal, command=work.command, env=env)


def _enter_folder(work: Work) -> None:
    """Change to the driver's folder; raise `ArtifactError` if the group's folder is not the driver's here."""
    try:
        if not work.has_copy:
            os.chdir(work.cwd)
        is_same = (work.folder / _TOKEN_FILE).read_text() == work.token
    except OSError:
        is_same = False
    if not is_same:
        hint = "share the runs folder and the current folder at the same paths"
        raise ArtifactError(f"{platform.node()}: {work.root}: this node has a different folder there, or none; {hint}")


def describe_driver(task: str) -> dict[str, Any]:
    """Return what `compare_versions` on a node needs to know of this machine."""
    return {"versions": collect_versions(), "source_sha256": identify_task(task)["source_sha256"]}


def compare_versions(task: str, versions: Mapping[str, str], source_sha256: str | None) -> list[str]:
    """Return warnings for different libraries; raises `ArtifactError` for a different rlctl or task file."""
    here, node = collect_versions(), platform.node()
    if here["rlctl"] != versions["rlctl"]:
        both = here["rlctl"], versions["rlctl"]
        raise ArtifactError("{}: rlctl {}, but {} on the driver: install the same version".format(node, *both))
    if identify_task(task)["source_sha256"] != source_sha256:
        raise ArtifactError(f"{node}: the file of task {task!r} differs from the driver's: install the same version")
    others = {name: version for name, version in versions.items() if here.get(name) != version}
    pairs = (f"{name} {version} on the driver, {here.get(name, 'none')} on {node}" for name, version in others.items())
    return [f"warning: not bit-equal: {pair}" for pair in pairs]
