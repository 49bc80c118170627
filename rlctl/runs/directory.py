"""The run folder. Only this module spells the names of its files."""

from __future__ import annotations

import contextlib
import datetime
import errno
import fcntl
import os
import uuid
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rlctl.environments import registry
from rlctl.errors import ArtifactError, RunTaken, UsageError, short_repr
from rlctl.storage import files

if TYPE_CHECKING:
    from rlctl.recipe.recipe import Recipe

ROOT = Path("runs")
GROUP_FILE = "group.json"  # in the folder of a group, which holds runs of several seeds
TUNE_FILE = "tune.json"  # in the folder of a tuning, which holds the runs of its trials
_DIGITS = 18  # of a training step
_NO_LOCKS = (errno.ENOSYS, errno.ENOTSUP, errno.ENOLCK)


class _RunPath:
    def __init__(self, name: str) -> None:
        self._name = name

    def __get__(self, run: RunDirectory, owner: type[RunDirectory]) -> Path:
        return run.path / self._name


class RunDirectory:
    """The folder of a training, with the paths of its files."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._claim = ""

    def __fspath__(self) -> str:
        return str(self.path)

    def __repr__(self) -> str:
        return f"RunDirectory({str(self.path)!r})"

    recipe_file = _RunPath("recipe.yaml")  # the resolved recipe
    status_file = _RunPath("run.json")  # status, versions, command line, times
    metrics_file = _RunPath("metrics.csv")  # a row per update
    evals_file = _RunPath("evals.csv")  # a row per evaluation
    printed_file = _RunPath("printed.log")  # what the environments have printed
    robustness_file = _RunPath("robustness.json")  # what `rlctl eval --vary` or `--push` measured last
    audit_file = _RunPath("audit.json")  # what `rlctl runs show --audit` found last
    best_policy = _RunPath("policies/best.safetensors")  # the policy of the best evaluation
    last_policy = _RunPath("policies/last.safetensors")  # the policy at the end, or at the last checkpoint
    claim_file = _RunPath(".claim")  # the token of the process that may write the run
    episodes = _RunPath("episodes")  # the folder of recorded episodes and recordings
    tensorboard = _RunPath("tensorboard")  # the folder of TensorBoard files
    tracking_file = _RunPath("tracking.json")  # the id in the experiment tracker, and what was sent to it
    onnx_file = _RunPath("exports/policy.onnx")  # the default file of an export
    replay_parts = _RunPath("checkpoints/replay")  # the folder of the replay buffer that checkpoints share

    def teacher_file(self, suffix: str) -> Path:
        """Return the file of the policy that a student was distilled from, `.safetensors` or `.onnx`."""
        return self.path / "policies" / f"teacher{suffix}"

    def checkpoint(self, steps: int) -> Path:
        """Return the folder of the checkpoint at a training step."""
        return self.path / "checkpoints" / f"{steps:09d}"

    def checkpoints(self) -> list[Path]:
        """Return the folders of the complete checkpoints, oldest first."""
        return sorted(folder for folder in self.path.glob("checkpoints/*") if folder.name.isdecimal())

    def episode_file(self, number: int) -> Path:
        """Return the file of a recorded episode."""
        return self.episodes / f"{number:06d}.npz"

    def recipe(self) -> Recipe:
        """Read the resolved recipe; raises `ArtifactError` if it is missing or was changed later."""
        from rlctl.recipe.recipe import validate
        from rlctl.recipe.recipe_files import read

        if not self.recipe_file.exists():
            raise ArtifactError(
                f"{self.recipe_file}: no such file; a run needs the recipe that it was trained with\n"
                f"its policy can still be used: rlctl eval {self.best_policy}"
            )
        content = read(self.recipe_file)
        if not files.is_as_sealed(self.recipe_file):
            raise ArtifactError(
                f"{self.recipe_file}: changed since the training wrote it. "
                f"To train with the changed recipe: rlctl train TASK --config {self.recipe_file}"
            )
        return validate(content, str(self.recipe_file))

    def write_recipe(self, recipe: Recipe) -> None:
        """Write the resolved recipe with its SHA-256, which reveals later changes."""
        from rlctl.recipe.recipe import SCHEMA_FILE

        # Next to the recipe, so that editors find it on any machine.
        files.write_bytes(self.path / SCHEMA_FILE.name, SCHEMA_FILE.read_bytes())
        files.write_sealed(self.recipe_file, f"# yaml-language-server: $schema={SCHEMA_FILE.name}\n{recipe.to_yaml()}")

    def status(self) -> dict[str, Any]:
        """Read `run.json`."""
        status = files.read_json(self.status_file)
        if not isinstance(status, dict) or not isinstance(status.get("task"), str):
            raise ArtifactError(f"{self.status_file}: not a run of rlctl: it has no task")
        return status

    def id(self) -> str:
        """Return the unique id of the run, which stays the same if the folder is moved or copied."""
        return str(self.status().get("id", ""))

    def write_status(self, changes: Mapping[str, Any]) -> None:
        """Update values of `run.json`; raises `RunTaken` if another process has claimed the run."""
        self.check_claim()
        known = files.read_json(self.status_file) if self.status_file.exists() else {}
        files.write_json(self.status_file, {**known, **changes})

    def policy_file(self, which: str = "best") -> Path:
        """Return the policy `best`, `last`, or of a checkpoint's step; raises `ArtifactError` if there is none."""
        if which in ("best", "last"):
            file = self.best_policy if which == "best" else self.last_policy
            if not file.is_file():
                if which == "best" and self.evals_file.is_file() and self.checkpoints():
                    raise ArtifactError(f"{file}: missing, although the run was evaluated; use --checkpoint last")
                hint = "train longer, or use --checkpoint last" if which == "best" else "the run saved none"
                raise ArtifactError(f"{self.path}: no {which} policy yet; {hint}")
            return file
        if not which.isdecimal() or len(which) > _DIGITS:
            raise UsageError(f"--checkpoint {short_repr(which)!r}: give best, last, or the step of a checkpoint")
        file = self.checkpoint(int(which)) / "policy.safetensors"
        if not file.is_file():
            steps = ", ".join(str(int(checkpoint.name)) for checkpoint in self.checkpoints())
            raise ArtifactError(f"{self.path}: no checkpoint at step {which}; there are: {steps or 'none'}")
        return file

    def recover(self) -> None:
        """Repair files that a killed process left incomplete; call it only while holding the lock."""
        for folder in [self.path, *(path for path in self.path.glob("*") if path.is_dir()), self.replay_parts]:
            files.recover(folder)

    def lock(self) -> RunLock:
        """Claim the folder for writing until the lock is released or the process ends.

        Raises `RunTaken` if another process holds it, and `ArtifactError` for a symbolic link that leads out of the
        folder. On a file system without locks, the last process to claim the run owns it.
        """
        lock = RunLock(self.path)
        with contextlib.suppress(OSError):  # the disk may be full
            claim = uuid.uuid4().hex
            files.write_text(self.claim_file, claim)
            self._claim = claim
        return lock

    def check_claim(self) -> None:
        """Raise `RunTaken` if another process has claimed the run since this object did.

        Called before each write: locks of network file systems may work on one machine only, or not at all.
        """
        if not self._claim:
            return
        try:
            owner = self.claim_file.read_text(encoding="utf-8")
        except OSError:
            return
        if owner != self._claim:
            raise RunTaken(f"{self.path}: another process has taken over this run; this process no longer writes to it")


def refuse_links_out(folder: Path, kind: str = "run") -> None:
    """Raise `ArtifactError` for a folder with a link out of it: what is written or uploaded must be in the folder."""
    own = folder.resolve()
    for path in folder.rglob("*"):
        # Unlike `resolve`, `realpath` accepts a link to itself.
        if path.is_symlink() and not Path(os.path.realpath(path)).is_relative_to(own):
            raise ArtifactError(f"{path}: a symbolic link out of the {kind}'s folder; remove it")


class RunLock(contextlib.AbstractContextManager["RunLock"]):
    """Prevents two processes from writing the same run, or another `kind` of folder with runs.

    The operating system releases it when the process ends, even after a crash.
    """

    def __init__(self, folder: Path, kind: str = "run") -> None:
        refuse_links_out(folder, kind)
        self._kind = kind
        self.keeps_out = True  # false on a file system without locks, where other processes can write too
        self._file = folder / ".lock"
        self._descriptor = self._claim()

    def _claim(self) -> int:
        descriptor = os.open(self._file, os.O_RDWR | os.O_CREAT, 0o644)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            owner = os.read(descriptor, 100).decode(errors="replace").strip()
            os.close(descriptor)
            raise RunTaken(
                f"{self._file.parent}: another process is writing this {self._kind} ({owner or 'unknown'})"
            ) from None
        except OSError as error:
            if error.errno not in _NO_LOCKS:
                os.close(descriptor)
                raise
            self.keeps_out = False
        with contextlib.suppress(OSError):  # the disk may be full: then only the owner's name is missing
            os.ftruncate(descriptor, 0)
            os.pwrite(descriptor, f"pid {os.getpid()} on {os.uname().nodename}".encode(), 0)
        return descriptor

    def release(self) -> None:
        """Release the folder; a second call does nothing."""
        if self._descriptor >= 0:
            os.close(self._descriptor)
        self._descriptor = -1

    def __exit__(self, *_: object) -> None:
        self.release()


def is_being_written(folder: Path) -> bool:
    """Return whether a process trains in a run folder now; False where the file system has no locks."""
    try:
        descriptor = os.open(folder / ".lock", os.O_RDONLY | os.O_NONBLOCK)
    except OSError:
        return False
    try:
        fcntl.flock(descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    except OSError:
        pass
    finally:
        os.close(descriptor)
    return False


def create(task: str, seed: int, root: Path = ROOT) -> RunDirectory:
    """Make a new run folder, `<root>/<task>/<time>_s<seed>`, and point `<root>/latest` to it.

    If `root` is the folder of a group, the run is made inside it; `latest` stays in the folder of all runs.
    """
    folder = root / registry.make_slug(task)
    if is_group(root):
        folder, root = root, root.parent.parent
    path = _make_new_folder(folder, f"s{seed}")
    if not (folder / TUNE_FILE).is_file():  # `latest` never points to a trial of a tuning
        _point_latest_to(root, path)
    return RunDirectory(path)


def create_group_folder(task: str, kind: str, root: Path) -> Path:
    """Make a folder for runs that belong together, `<root>/<task>/<time>_<kind>`."""
    return _make_new_folder(root / registry.make_slug(task), kind)


def _make_new_folder(parent: Path, kind: str) -> Path:
    """Make `<time>_<kind>`, with a number appended if it exists already."""
    first = f"{datetime.datetime.now():%Y-%m-%d_%H-%M-%S}_{kind}"
    for attempt in range(1000):
        path = parent / (f"{first}_{attempt}" if attempt else first)
        try:
            path.mkdir(parents=True)
        except FileExistsError:
            continue
        except OSError as error:
            raise ArtifactError(f"{parent}: cannot make a folder for runs: {error.strerror}") from None
        return path
    raise ArtifactError(f"{parent}: cannot make a folder for runs")


def is_group(path: Path) -> bool:
    """Return whether a folder holds runs that belong together: of several seeds, or of a tuning."""
    return (path / GROUP_FILE).is_file() or (path / TUNE_FILE).is_file()


def _point_latest_to(root: Path, run: Path) -> None:
    temporary = root / f".latest.{os.getpid()}"
    try:
        temporary.unlink(missing_ok=True)
        temporary.symlink_to(run.relative_to(root))
        temporary.replace(root / "latest")
    except OSError:  # a file system without symbolic links: runs are then found by time
        temporary.unlink(missing_ok=True)
