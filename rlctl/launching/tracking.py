"""Sends a run to an experiment tracker, from a process of its own that reads the run's folder.

The training only starts and ends this process, so a tracker that is slow or down neither stops nor delays it. What was
sent is stored in the run folder: what is missing is sent later, also after a resume, and nothing twice.
The trackers' own environment variables name the address and the key: rlctl neither asks for a key nor stores one.
"""

import contextlib
import dataclasses
import importlib
import importlib.util
import os
import re
import signal
import subprocess
import tempfile
import warnings
from collections.abc import Callable, Iterator, Mapping
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from rlctl.environments import registry
from rlctl.errors import RlctlError
from rlctl.printed_lines import LineReader
from rlctl.processes.child_process import ChildEndedError, ChildProcess
from rlctl.recipe.recipe import Recipe, flatten
from rlctl.runs.directory import TUNE_FILE, RunDirectory, is_group
from rlctl.storage import files, yaml_text
from rlctl.training.callbacks import Observer
from rlctl.training.display import Display

_EVERY_S = 3.0
_FILM_S = 30  # time limit of the film; PyBullet draws 5 to 15 pictures per second
_END_S = 60.0  # how long a training that has ended waits


class SendToTracker(Observer):
    """Sends the run to the recipe's tracker while the training lasts."""

    @contextlib.contextmanager
    def follow(self, run: RunDirectory, recipe: Recipe, display: Display) -> Iterator[None]:
        """Send while entered, and a while longer."""
        if recipe.track is None:
            yield
            return
        with track(run, recipe.track, display.message):
            try:
                yield
            finally:
                display.phase(f"sending to {recipe.track}")


@contextlib.contextmanager
def track(run: RunDirectory, tracker: str, show: Callable[[str], None]) -> Iterator[None]:
    """Send the run to a tracker while entered, and up to `_END_S` longer; `show` gets at most one warning."""
    problems: list[str] = []

    def warn(problem: str) -> None:
        if not problems:
            show(
                f"warning: not everything is sent to {tracker}: {problem}\n"
                f"the training is not affected; the rest is sent later, or by: rlctl train --resume {run.path}"
            )
        problems.append(problem)

    reader = LineReader(warn)
    arguments, output = {"folder": str(run.path), "tracker": tracker}, reader.descriptor
    child = ChildProcess("rlctl.launching.tracking:main", arguments, stdout=subprocess.DEVNULL, stderr=output)
    reader.close_descriptor()
    try:
        yield
    finally:
        with contextlib.suppress(ChildEndedError):
            child.send("end")
        child.close(_END_S)
        reader.wait()
        if child.process.returncode != 0:
            warn(f"its process ended too early, or had not finished {_END_S:g} s after the training")


def main(connection: Connection, folder: str, tracker: str) -> None:
    """In the child: send what is new every few seconds, until the parent sends a message; print problems to stderr."""
    stderr = os.fdopen(os.dup(2), "w", buffering=1, errors="replace")
    os.dup2(os.open(os.devnull, os.O_WRONLY), 2)  # the libraries print much
    sender = _Sender(RunDirectory(Path(folder).resolve()), tracker, lambda text: print(_shorten(text), file=stderr))
    while not connection.poll(_EVERY_S):
        sender.attempt(sender.send)
    sender.attempt(sender.finish)
    os._exit(0)  # exit handlers of the libraries may wait for a server


def _shorten(text: str) -> str:
    """Return the first line, without the password of an address."""
    return re.sub(r"//[^/@\s]+@", "//", text.strip().partition("\n")[0])[:200]


class _Sender:
    def __init__(self, run: RunDirectory, name: str, warn: Callable[[str], None]) -> None:
        self._run, self._name, self._warn = run, name, warn
        self._tracker: Tracker | None = None
        self._loaders: dict[Path, Any] = {}  # of TensorBoard files; each yields an event once
        self._sent: dict[str, Any] = {"id": "", "steps": {}, "files": {}}  # last step per metric, version per file

    def attempt(self, send: Callable[[], object]) -> None:
        """Call `send`; warn if it raises."""
        try:
            try:
                send()
            finally:
                files.write_json(self._run.tracking_file, self._sent)
        except Exception as error:  # any of the libraries'
            self._loaders.clear()  # what could not be sent is read again
            self._warn(str(error) or repr(error))

    def send(self) -> "Tracker":
        """Send new metrics, and files that have changed."""
        tracker = self._tracker = self._tracker or self._connect()
        sent = self._sent["steps"]
        for step, seconds, values in self._read_metrics():
            if new := {name: value for name, value in values.items() if step > sent.get(name, -1)}:
                tracker.log(step, seconds, new)
                sent |= dict.fromkeys(new, step)
        for file in (self._run.recipe_file, self._run.best_policy):
            if file.exists():
                self._send_file(tracker, file, file.stat().st_mtime_ns)
        return tracker

    def finish(self) -> None:
        """Send the rest, and after a training that is not a trial its report and film."""
        tracker, status = self.send(), self._run.status()
        is_new = self._sent["files"].get("report.html") != status.get("steps")
        if status["status"] == "finished" and is_new and not (self._run.path.parent / TUNE_FILE).is_file():
            with tempfile.TemporaryDirectory() as folder:
                for file in _present(self._run, Path(folder)):
                    self._send_file(tracker, file, status["steps"])
        tracker.finish(status["status"])

    def _connect(self) -> "Tracker":
        run, group = self._run, self._run.path.parent
        if run.tracking_file.exists():
            self._sent = files.read_json(run.tracking_file)
        status = run.status()
        names = ("id", "task", "versions", "git_commit", "command", "host", "device")
        recipe = yaml_text.load(yaml_text.read_text(run.recipe_file), "recipe")
        tracked = TrackedRun(
            id=self._sent["id"],
            project=registry.make_slug(status["task"]),
            name=run.path.name,
            group=group.name if is_group(group) else None,
            config={**recipe, "run": {name: status.get(name) for name in names}},
            warn=self._warn,
        )
        tracker = TRACKERS[self._name](tracked)
        self._sent["id"] = tracker.id
        return tracker

    def _read_metrics(self) -> Iterator[tuple[int, float, dict[str, float]]]:
        """Yield step, time and values of each new TensorBoard event."""
        from tensorboard.backend.event_processing.event_file_loader import RawEventFileLoader
        from tensorboard.compat.proto.event_pb2 import Event

        for file in sorted(self._run.tensorboard.glob("events.*")):
            if file not in self._loaders:
                self._loaders[file] = RawEventFileLoader(str(file))
            for content in self._loaders[file].Load():
                event = Event.FromString(content)
                values = [value for value in event.summary.value if value.HasField("simple_value")]
                yield event.step, event.wall_time, {value.tag: value.simple_value for value in values}

    def _send_file(self, tracker: "Tracker", file: Path, version: int) -> None:
        if self._sent["files"].get(file.name) != version:
            tracker.save(file)
            self._sent["files"][file.name] = version


def _present(run: RunDirectory, folder: Path) -> Iterator[Path]:
    """Write the report, and a film of the best policy unless that takes too long or cannot be done."""
    from rlctl.replaying.replay import run_replay
    from rlctl.replaying.replay_request import ReplayRequest
    from rlctl.runs.report.write import write_report

    yield write_report([str(run.path)], target=(report := folder / "report.html"), pictures=False) or report
    signal.signal(signal.SIGALRM, signal.default_int_handler)  # raises KeyboardInterrupt
    signal.alarm(_FILM_S)
    try:
        run_replay(ReplayRequest(str(run.path), video=(film := folder / "film.mp4")))
    except (RlctlError, KeyboardInterrupt):
        return
    finally:
        signal.alarm(0)
    yield film


@dataclasses.dataclass(frozen=True)
class TrackedRun:
    """What a tracker gets at the start."""

    id: str  # in the tracker; empty for a run that it does not have yet
    project: str
    name: str
    group: str | None  # folder of the seeds, or of the tuning
    config: Mapping[str, Any]  # the recipe; `run` holds task, versions, id, ...
    warn: Callable[[str], None]

    @property
    def arguments(self) -> dict[str, Any]:
        """Arguments of `wandb.init` and `trackio.init`."""
        return {name: getattr(self, name) for name in ("project", "name", "group", "config")} | {"resume": "allow"}


class _Wandb:
    def __init__(self, run: TrackedRun) -> None:
        wandb = self._library = importlib.import_module("wandb")
        self.id = run.id or run.config["run"]["id"]
        quiet = {"silent": True, "console": "off", "disable_code": True, "disable_git": True, "x_disable_stats": True}
        arguments = run.arguments | {"project": os.environ.get("WANDB_PROJECT") or run.project}
        self._run = wandb.init(**arguments, id=self.id, settings=wandb.Settings(**quiet, init_timeout=30))
        self._run.config.update(run.config, allow_val_change=True)  # `--resume RUN -n STEPS` changes the recipe
        self._run.define_metric("*", step_metric="steps")  # its own steps must increase; evaluations repeat them

    def log(self, step: int, seconds: float, values: Mapping[str, float]) -> None:
        self._run.log({**values, "steps": step})

    def save(self, file: Path) -> None:
        if show := {".html": self._library.Html, ".mp4": self._library.Video}.get(file.suffix):
            self._run.log({file.stem: show(str(file))})
        else:
            kind = "model" if file.suffix == ".safetensors" else "recipe"
            self._run.log_artifact(str(file), name=f"{self._run.name}-{file.stem}", type=kind)

    def finish(self, status: str) -> None:
        self._run.finish(exit_code=int(status != "finished"))


class _Trackio(_Wandb):
    """Resumes by the run's name. When a server is down it only warns, and stores the values until later."""

    def __init__(self, run: TrackedRun) -> None:
        trackio = self._library = importlib.import_module("trackio")
        warnings.showwarning = lambda message, *_: run.warn(str(message))
        self.id = run.id or run.name
        quiet = dict.fromkeys(("embed", "auto_log_cpu", "auto_log_gpu"), False)
        self._run = trackio.init(**run.arguments | quiet | {"name": self.id})

    def log(self, step: int, seconds: float, values: Mapping[str, float]) -> None:
        self._run.log(dict(values), step=step)

    def finish(self, status: str) -> None:
        self._run.finish()


class _Mlflow:
    """Chooses the id itself; the configuration becomes parameters, the group a tag."""

    def __init__(self, run: TrackedRun) -> None:
        for name, value in (("MAX_RETRIES", "1"), ("TIMEOUT", "20")):  # rlctl tries again itself
            os.environ.setdefault(f"MLFLOW_HTTP_REQUEST_{name}", value)
        self._library = importlib.import_module("mlflow")
        self._client = self._library.MlflowClient()
        self.id = run.id or self._create(run)
        self._client.update_run(self.id, "RUNNING")

    def _create(self, run: TrackedRun) -> str:
        experiment = os.environ.get("MLFLOW_EXPERIMENT_ID") or (
            self._library.set_experiment(os.environ.get("MLFLOW_EXPERIMENT_NAME") or run.project).experiment_id
        )
        tags = {"group": run.group} if run.group else {}
        created = str(self._client.create_run(experiment, run_name=run.name, tags=tags).info.run_id)
        parameters = [self._library.entities.Param(name, str(value)[:500]) for name, value in flatten(run.config)]
        for first in range(0, len(parameters), 100):  # the most that a request may have
            self._client.log_batch(created, params=parameters[first : first + 100])
        return created

    def log(self, step: int, seconds: float, values: Mapping[str, float]) -> None:
        names = {name: re.sub(r"[^\w./: -]", "_", name) for name in values}  # it refuses other characters
        entity, milliseconds = self._library.entities.Metric, round(seconds * 1000)
        metrics = [entity(names[name], value, milliseconds, step) for name, value in values.items()]
        self._client.log_batch(self.id, metrics=metrics)

    def save(self, file: Path) -> None:
        self._client.log_artifact(self.id, str(file))

    def finish(self, status: str) -> None:
        self._client.set_terminated(self.id, {"finished": "FINISHED", "interrupted": "KILLED"}.get(status, "FAILED"))


Tracker = _Wandb | _Mlflow
TRACKERS: dict[str, Callable[[TrackedRun], Tracker]] = {"wandb": _Wandb, "mlflow": _Mlflow, "trackio": _Trackio}
"""By the name of the package."""
