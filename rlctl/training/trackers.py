"""Experiment trackers: Weights & Biases, MLflow and Trackio. Each class has one run in a tracker.

The packages' own environment variables say where they send it, and with which key: rlctl neither asks for a key nor
stores one. Their calls may raise any exception, and may take minutes.
"""

import dataclasses
import importlib
import os
import re
import warnings
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from rlctl.recipe.recipe import flatten


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
        show = {".html": self._library.Html, ".mp4": self._library.Video}.get(file.suffix)
        if show is not None:
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
        self._run = trackio.init(
            **run.arguments | {"name": self.id}, embed=False, auto_log_cpu=False, auto_log_gpu=False
        )

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
