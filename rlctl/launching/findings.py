"""Warnings of the diagnosis, as soon as the records of a training show them."""

import contextlib
from collections.abc import Iterator

from rlctl.recipe.recipe import Recipe
from rlctl.recipe.sources import find_given_parameters
from rlctl.runs.diagnosis import usual_ranges
from rlctl.runs.diagnosis.findings import Grade, diagnose
from rlctl.runs.directory import RunDirectory
from rlctl.runs.train_request import TrainRequest
from rlctl.training.callbacks import Observer, Training
from rlctl.training.display import Display


class WarnOfFindings(Observer):
    """Shows each warning once, after the first evaluation that it is found after. At the end all findings are shown.

    Before the training it warns of hyperparameters that the user gave and that are far out of their usual range.
    """

    def __init__(self, request: TrainRequest) -> None:
        self._request = request
        self._reported: set[str] = set()
        self._run: RunDirectory
        self._display: Display

    @contextlib.contextmanager
    def follow(self, run: RunDirectory, recipe: Recipe, display: Display) -> Iterator[None]:
        """Read the records of `run` and show on `display` while entered."""
        self._run, self._display = run, display
        for line in warn_of_unusual_values(self._request, recipe):
            display.message(line)
        yield

    def on_evaluation(self, training: Training) -> None:
        """Show the warnings that are new."""
        if training.is_at_end:
            return
        for finding in diagnose(self._run):
            if finding.grade != Grade.WARNING or finding.follows:
                continue
            if finding.id not in self._reported:
                self._reported.add(finding.id)
                self._display.message(finding.line)


def warn_of_unusual_values(request: TrainRequest, recipe: Recipe) -> list[str]:
    """Return a warning for each hyperparameter that the user gave and that is far out of its usual range."""
    if request.task is None:  # a resumed run has its own recipe
        return []
    given = find_given_parameters(request.task, request.config, request.settings)
    return [
        f"warning: {usual_ranges.describe(setting, recipe.algo)}"
        for setting in usual_ranges.find_far_out(given, recipe.algo, recipe.n_envs)
    ]
