"""Warnings of the diagnosis, as soon as the records of a training show them."""

import contextlib
from collections.abc import Iterator

from rlctl.recipe.recipe import Recipe
from rlctl.runs.diagnosis.findings import Grade, diagnose
from rlctl.runs.directory import RunDirectory
from rlctl.training.callbacks import Observer, Training
from rlctl.training.display import Display


class WarnOfFindings(Observer):
    """Shows each warning once, after the first evaluation that it is found after. At the end all findings are shown."""

    def __init__(self) -> None:
        self._reported: set[str] = set()
        self._run: RunDirectory
        self._display: Display

    @contextlib.contextmanager
    def follow(self, run: RunDirectory, recipe: Recipe, display: Display) -> Iterator[None]:
        """Read the records of `run` and show on `display` while entered."""
        self._run, self._display = run, display
        yield

    def on_evaluation(self, training: Training) -> None:
        """Show the warnings that are new."""
        if training.is_at_end:
            return
        for finding in diagnose(self._run):
            if finding.grade == Grade.WARNING and finding.id not in self._reported:
                self._reported.add(finding.id)
                self._display.message(finding.line)
