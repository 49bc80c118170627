"""The records of a training, read from its run folder, as curves."""

import dataclasses
import functools
import itertools
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from rlctl.environments.info import EnvInfo
from rlctl.errors import RlctlError
from rlctl.play.episode import RecordedEpisode, load_episode
from rlctl.policy.file import PolicyFile
from rlctl.recipe import recipe, recipe_files
from rlctl.recipe.hyperparameters import ALGORITHM_PARAMETERS
from rlctl.runs.diagnosis import usual_ranges
from rlctl.runs.diagnosis.usual_ranges import Setting
from rlctl.runs.directory import RunDirectory
from rlctl.runs.tables import TableRows, list_points, read_table

Array = NDArray[np.float64]
_Record = TypeVar("_Record")

LEAST_ROWS = 10  # rows of `metrics.csv`; with fewer rows signs in the course of a curve are not checked
FEW_ROWS = 3  # rows for a sign that one value shows; one row alone may be chance
_GOOD = 0.8  # a training with this success rate has succeeded, whatever its other records are
EPISODES = 4  # recorded episodes that are checked: the first and the worst of the last two evaluations


@dataclasses.dataclass(frozen=True)
class Curve:
    """A quantity over training steps; both of shape (points,), without gaps."""

    steps: Array
    values: Array

    def __len__(self) -> int:
        return len(self.values)

    def thirds(self) -> tuple[float, float]:
        """Return the means of the first and of the last third of the points."""
        size = max(1, len(self) // 3)
        return float(self.values[:size].mean()), float(self.values[-size:].mean())

    def noise(self) -> float:
        """Return the standard deviation of normal noise from point to point, without slow changes."""
        if len(self) < 3:
            return 0.0
        return float(np.median(np.abs(np.diff(self.values))) / 0.954)

    def rise(self) -> float:
        """Return by how many standard errors the last third is above the first."""
        first, last = self.thirds()
        error = self.noise() * float(np.sqrt(2 / max(1, len(self) // 3)))
        if error == 0.0:
            return 0.0 if first == last else float(np.copysign(np.inf, last - first))
        return float((last - first) / error)


class RunHistory:
    """Reads the records of a run; a missing record is empty, a table that is not CSV is an `ArtifactError`."""

    def __init__(self, run: RunDirectory) -> None:
        self.run = run
        self.status: Mapping[str, Any] = _read(run.status) or {}
        self.recipe: Mapping[str, Any] = _read(_read_recipe, run.recipe_file) or {}
        self.metrics, self.evaluations = read_table(run.metrics_file), read_table(run.evals_file)

    def curve(self, name: str) -> Curve:
        """Return a column of `metrics.csv`."""
        return _curve(self.metrics, name)

    def evaluation_curve(self, name: str) -> Curve:
        """Return a column of `evals.csv`."""
        return _curve(self.evaluations, name)

    @property
    def stage_count(self) -> int:
        """The stages of the curriculum, 0 without one."""
        stages = self.recipe.get("stages")
        return len(stages) if isinstance(stages, list) else 0

    @property
    def successes(self) -> tuple[Curve, Curve]:
        """The success rates of evaluations, and of training."""
        return self.evaluation_curve("success"), self.curve("success")

    @property
    def is_good(self) -> bool:
        """Whether the success rate reached `_GOOD` at least once."""
        return any(len(curve) and curve.values.max() >= _GOOD for curve in self.successes)

    @functools.cached_property
    def progress(self) -> float:
        """The finished fraction of the planned training, in [0, 1]; 1 if it ended as planned."""
        if self.status.get("status") == "finished":
            return 1.0
        total, steps = self.recipe.get("total_timesteps"), self.curve("steps").values
        return min(1.0, float(steps[-1]) / total) if isinstance(total, int | float) and total and len(steps) else 0.0

    def terms(self) -> dict[str, Curve]:
        """Return the weighted reward terms, mean sums per episode."""
        names = [name for name in (self.metrics[0] if self.metrics else {}) if name.startswith("term/")]
        return {name.removeprefix("term/"): self.curve(name) for name in names}

    @functools.cached_property
    def parameters(self) -> dict[str, Any]:
        """The parameters of the algorithm as the recipe has them, or SB3's defaults."""
        fields = getattr(ALGORITHM_PARAMETERS.get(self.recipe.get("algo", "")), "model_fields", {})
        return {name: field.default for name, field in fields.items()} | (self.recipe.get("algo_kwargs") or {})

    @property
    def n_envs(self) -> int:
        """The number of environments that are stepped in parallel."""
        n_envs = self.recipe.get("n_envs")
        return n_envs if isinstance(n_envs, int) else int(recipe.Recipe.model_fields["n_envs"].default)

    def list_settings(self, names: Iterable[str]) -> list[Setting]:
        """Return hyperparameters with what is usual, see `usual_ranges.list_settings`."""
        return usual_ranges.list_settings(names, self.parameters, self.recipe.get("algo"), self.n_envs)

    def find_far_out(self) -> list[Setting]:
        """Return the hyperparameters that are far out of their usual range."""
        return usual_ranges.find_far_out(self.parameters, self.recipe.get("algo"), self.n_envs)

    @functools.cached_property
    def env(self) -> EnvInfo | None:
        """The environment that the policy was trained in."""
        info = _read(PolicyFile.read_info, self.run.last_policy) or _read(PolicyFile.read_info, self.run.best_policy)
        return None if info is None else info.env

    @functools.cached_property
    def episodes(self) -> list[RecordedEpisode]:
        """The newest recorded episodes of evaluations, at most `EPISODES`."""
        files = sorted((file for file in self.run.episodes.glob("*.npz") if file.stem.isdecimal()), reverse=True)
        read = (_read(load_episode, file) for file in files)
        evaluated = (episode for episode in read if episode is not None and episode.info.evaluated_at is not None)
        return list(itertools.islice((episode for episode in evaluated if len(episode.rewards)), EPISODES))


def _read_recipe(path: Path) -> dict[str, Any]:
    content = recipe_files.read(path)
    recipe.validate(content, str(path))
    return content


def _read(function: Callable[..., _Record], *arguments: Path) -> _Record | None:
    try:
        return function(*arguments)
    except (RlctlError, OSError):
        return None


def _curve(rows: TableRows, name: str) -> Curve:
    return Curve(*np.array(list_points(rows, name), np.float64).reshape(-1, 2).T)
