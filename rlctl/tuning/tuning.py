"""The folder of a tuning: its search, trials and results; trials are ordinary runs in it."""

import dataclasses
import glob
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

import pydantic
from annotated_types import Ge, Le

from rlctl.environments import registry
from rlctl.environments.spec import merge
from rlctl.errors import ArtifactError
from rlctl.recipe.recipe import Recipe
from rlctl.recipe.sources import read, resolve_with_stages
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

    number: int  # from 0; trial 0 has the unchanged recipe
    step: int  # step of the search, from 1; 0 for the unchanged recipe
    values: dict[str, Any]  # values by dotted key, without those equal to the recipe's own
    state: Literal["begun", "done", "pruned", "failed"] = "begun"
    score: float | None = None  # mean of the metric over the last third of the evaluations
    problem: str = ""  # why it failed


@dataclasses.dataclass
class Tuning:
    """What `tune.json` holds."""

    path: Path
    task: str
    config: Path | None
    settings: dict[str, Any]  # recipe keys from the command line, for every trial
    metric: Metric
    trials_per_step: Annotated[int, Ge(1), Le(100_000)]
    seed: int  # seed of the first trial and of Optuna; trial n has `seed` + n
    steps: list[list[Dimension]]
    storage: str | None = None  # URL of Optuna's storage, for its dashboard and for other tuners with an equal search
    trials: list[Trial] = dataclasses.field(default_factory=list)

    def resolve_recipe(self) -> Recipe:
        """Return the unchanged recipe; its task is imported."""
        return resolve_with_stages(self.task, self.config, self.settings)

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
        """Return the changes to the task's recipe, without seed, length and evaluations."""
        settings = {
            key: value for key, value in self.settings.items() if key not in ("seed", "total_timesteps", "eval")
        }
        config = read(self.config) if self.config is not None else {}
        return merge(merge(config, settings), nest(values))


def find_best(trials: list[Trial]) -> Trial | None:
    """Return the trial with the highest score among those that were trained to the end."""
    done = [
        (trial.score, -trial.number, trial) for trial in trials if trial.state == "done" and trial.score is not None
    ]
    return max(done)[2] if done else None


def find(text: str, root: Path) -> Tuning:
    """Read a tuning: its folder, the newest one of a task, or `latest`. Raises `ArtifactError` as `load` does."""
    task = "*" if text == "latest" else glob.escape(registry.make_slug(text))
    tunings = sorted(root.glob(f"{task}/*/{TUNE_FILE}"), key=lambda file: file.parent.name)
    return load(Path(text) if Path(text).is_dir() or not tunings else tunings[-1].parent)


def load(folder: Path) -> Tuning:
    """Read the folder of a tuning; raises `ArtifactError` if it is not one or damaged."""
    file = folder / TUNE_FILE
    if not file.is_file():
        raise ArtifactError(f"{folder}: not the folder of a tuning: it has no {TUNE_FILE}")
    content = files.read_json(file)
    try:
        json.dumps(content, allow_nan=False)  # raises for NaN, also within the values of trials
        return pydantic.TypeAdapter(Tuning).validate_python({**content, "path": folder})
    except (ValueError, TypeError):  # pydantic's is a ValueError
        raise ArtifactError(f"{file}: damaged: it does not describe a tuning") from None
