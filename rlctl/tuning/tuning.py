"""The folder of a tuning: its search, trials and results; trials are ordinary runs in it."""

import dataclasses
import glob
import json
import math
import shlex
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

import pydantic
from annotated_types import Ge, Le

from rlctl import output
from rlctl.environments import registry
from rlctl.environments.spec import merge
from rlctl.errors import ArtifactError
from rlctl.recipe.recipe import Recipe
from rlctl.recipe.recipe_files import read
from rlctl.recipe.sources import resolve_with_stages
from rlctl.runs.directory import TUNE_FILE, RunDirectory
from rlctl.runs.group import find_run_of_seed
from rlctl.runs.summary import RunSummary, summarize
from rlctl.runs.tables import list_points, read_table
from rlctl.storage import files, yaml_text
from rlctl.tuning.space import Dimension, get_value, list_values, nest
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
    def unchanged_file(self) -> Path:
        """Where the recipe of trial 0 is, to compare the best one with."""
        return self.path / "unchanged.yaml"

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
            files.write_text(self.unchanged_file, yaml_text.dump(self._make_recipe({})))

    def _make_recipe(self, values: Mapping[str, Any]) -> dict[str, Any]:
        """Return the changes to the task's recipe, without seed, length and evaluations."""
        left_out = ("seed", "total_timesteps", "eval")
        settings = {key: value for key, value in self.settings.items() if key not in left_out}
        config = read(self.config) if self.config is not None else {}
        return merge(merge(config, settings), nest(values))


def find_best(trials: list[Trial]) -> Trial | None:
    """Return the trial with the highest score among those that were trained to the end."""
    done = [trial for trial in trials if trial.state == "done" and trial.score is not None]
    return max(done, key=lambda trial: (trial.score, -trial.number), default=None)


def find(text: str, root: Path) -> Tuning:
    """Read a tuning: its folder, the newest one of a task, or `latest`. Raises `ArtifactError` as `load` does."""
    task = "*" if text == "latest" else glob.escape(registry.make_slug(text))
    tunings = sorted(root.glob(f"{task}/*/{TUNE_FILE}"), key=lambda file: file.parent.name)
    return load(Path(text) if Path(text).is_dir() or not tunings else tunings[-1].parent)


def load(folder: Path) -> Tuning:
    """Read the folder of a tuning; raises `ArtifactError` if it is not one or damaged."""
    if not (file := folder / TUNE_FILE).is_file():
        raise ArtifactError(f"{folder}: not the folder of a tuning: it has no {TUNE_FILE}")
    content = files.read_json(file)
    try:
        json.dumps(content, allow_nan=False)  # raises for NaN, also within the values of trials
        tuning = pydantic.TypeAdapter(Tuning).validate_python({**content, "path": folder})
        if len({trial.number for trial in tuning.trials}) != len(tuning.trials):
            raise ValueError
        return tuning
    except (ValueError, TypeError):  # pydantic's is a ValueError
        raise ArtifactError(f"{file}: damaged: it does not describe a tuning") from None


def show(tuning: Tuning, json: str | None) -> None:
    """Print the trials, best first, and the next commands; or only JSON for `-`."""
    runs = {trial.number: summarize(run.path) for trial in tuning.trials if (run := tuning.find_run(trial)) is not None}
    if output.present(as_json(tuning, runs), json):
        return
    out = output.out()
    keys = list(dict.fromkeys(dimension.key for step in tuning.steps for dimension in step))
    columns = ("trial", *(key.rpartition(".")[2] for key in keys), "return", "success", "min", "")
    ranked = sorted(tuning.trials, key=_rank, reverse=True)
    own = list_values(tuning.resolve_recipe())
    out.print(f"{tuning.task}: {tuning.path}, by {tuning.metric}; means over the last third of the evaluations")
    rows = [_list_cells(tuning, trial, keys, own, runs.get(trial.number)) for trial in ranked]
    output.print_table(columns, rows, left=("",))
    best = tuning.best
    assert best is not None
    task, file, unchanged = map(shlex.quote, (tuning.task, str(tuning.best_file), str(tuning.unchanged_file)))
    if best.number == 0:
        out.print("no trial was better than the unchanged recipe")
        return
    seeds = f"{tuning.seed + 100}-{tuning.seed + 104}"
    out.print(
        f"best: trial {best.number}, in {tuning.best_file}\n"
        f"Each trial had one seed, so the best of {len(tuning.trials)} looks better than it is. Compare on new seeds:\n"
        f"  rlctl train {task} --config {file} --seeds {seeds}\n"
        f"  rlctl train {task} --config {unchanged} --seeds {seeds}\n"
        "then give both groups to rlctl runs compare"
    )


def _rank(trial: Trial) -> tuple[bool, float]:
    return trial.state == "done", -math.inf if trial.score is None else trial.score


def _list_cells(
    tuning: Tuning, trial: Trial, keys: list[str], own: Mapping[str, Any], run: RunSummary | None
) -> tuple[str, ...]:
    unfinished = f"not finished: {trial.problem or 'interrupted'}"
    notes = {"done": "", "failed": f"failed: {trial.problem}", "begun": unfinished}
    total, success = tuning.measure(trial, "return"), tuning.measure(trial, "success")
    seconds = None if run is None else run.seconds
    return (
        str(trial.number),
        *(str(trial.values.get(key, get_value(own, key))) for key in keys),
        "-" if total is None else f"{total:.4g}",
        "-" if success is None else f"{success:.1%}",
        "-" if seconds is None else f"{seconds / 60:.1f}",
        "recipe" if trial.number == 0 and trial.state == "done" else notes.get(trial.state, trial.state),
    )


def as_json(tuning: Tuning, runs: dict[int, RunSummary]) -> dict[str, Any]:
    """Return every trial, with its run, as plain data."""
    paths = {number: run.path for number, run in runs.items()}
    trials = [{**dataclasses.asdict(trial), "run": paths.get(trial.number)} for trial in tuning.trials]
    best = tuning.best
    return {
        "task": tuning.task,
        "folder": tuning.path,
        "metric": tuning.metric,
        "best": None if best is None else best.number,
        "best_recipe": tuning.best_file,
        "trials": trials,
    }
