"""The folder of a tuning: what is searched, every trial and what came of it; trials are ordinary runs in it."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

import pydantic

from rlctl.environments.spec import merge
from rlctl.errors import ArtifactError, UsageError
from rlctl.recipe.sources import read
from rlctl.run.directory import TUNE_FILE, RunDirectory
from rlctl.run.group import find_run_of_seed
from rlctl.runs.summary import list_points, read_table
from rlctl.storage import files, yaml_text
from rlctl.tuning.space import Dimension, nest
from rlctl.tuning.tune_request import Metric

_PART_JUDGED = 3  # the last third of the evaluations


@dataclasses.dataclass
class Trial:
    """A training with some values of the hyperparameters."""

    number: int
    """From 0, which is the recipe as it is."""
    step: int
    """Of the search, from 1; 0 for the recipe as it is."""
    values: dict[str, Any]
    """Per recipe key, dotted, where it is not the recipe's own."""
    state: Literal["begun", "done", "pruned", "failed"] = "begun"
    score: float | None = None
    """Mean of the metric over the last third of the evaluations."""
    problem: str = ""
    """Why it failed."""


@dataclasses.dataclass
class Tuning:
    """What `tune.json` holds."""

    path: Path
    task: str
    config: Path | None
    settings: dict[str, Any]
    """Of `--set` and the other flags, for every trial."""
    metric: Metric
    trials_per_step: int
    seed: int
    """Of the first trial; every other one has the next, and Optuna's draws follow from it."""
    steps: list[list[Dimension]]
    storage: str | None = None
    """The URL of Optuna's storage, which its dashboard reads and equal searches share; None: no other process does."""
    trials: list[Trial] = dataclasses.field(default_factory=list)

    @property
    def best_file(self) -> Path:
        """Where the best recipe is, for `rlctl train TASK --config`."""
        return self.path / "best.yaml"

    @property
    def best(self) -> Trial | None:
        """Return the trial with the highest score among those that were trained to the end."""
        return find_best(self.trials)

    def find_run(self, trial: Trial) -> RunDirectory | None:
        """Return the run of a trial; None before it began."""
        return find_run_of_seed(self.path, self.seed + trial.number)

    def list_scores(self, trial: Trial, metric: Metric | None = None) -> list[float]:
        """Return the metric of every evaluation of a trial so far."""
        run = self.find_run(trial)
        rows = [] if run is None else read_table(run.evals_file)
        return [value for _, value in list_points(rows, metric or self.metric)]

    def measure(self, trial: Trial, metric: Metric | None = None) -> float | None:
        """Return the mean of the last third of a trial's evaluations; None without any."""
        scores = self.list_scores(trial, metric)
        last = scores[-max(1, len(scores) // _PART_JUDGED) :]
        return sum(last) / len(last) if last else None

    def save(self) -> None:
        """Write `tune.json`, and the best recipe so far."""
        content = dataclasses.asdict(self) | {"config": None if self.config is None else str(self.config)}
        del content["path"]
        files.write_json(self.path / TUNE_FILE, content)
        if (best := self.best) is not None:
            files.write_text(self.best_file, yaml_text.dump(self._make_recipe(best.values)))

    def _make_recipe(self, values: Mapping[str, Any]) -> dict[str, Any]:
        """Return what goes over the task's recipe; how long and with which seed is left to the training."""
        kept = {key: value for key, value in self.settings.items() if key not in ("seed", "total_timesteps", "eval")}
        config = read(self.config) if self.config is not None else {}
        return merge(merge(config, kept), nest(values))


def find_best(trials: list[Trial]) -> Trial | None:
    """Return the trial with the highest score among those that were trained to the end."""
    done = [
        (trial.score, -trial.number, trial) for trial in trials if trial.state == "done" and trial.score is not None
    ]
    return max(done)[2] if done else None


def load(folder: Path) -> Tuning:
    """Read the folder of a tuning; raises `UsageError` for one that is not, `ArtifactError` for a damaged one."""
    file = folder / TUNE_FILE
    if not file.is_file():
        raise UsageError(f"{folder}: not the folder of a tuning: it has no {TUNE_FILE}")
    content = files.read_json(file)
    try:
        return pydantic.TypeAdapter(Tuning).validate_python({**content, "path": folder})
    except (pydantic.ValidationError, TypeError):
        raise ArtifactError(f"{file}: damaged: it does not describe a tuning") from None
