"""What a training's own records show while it goes on: a line when a warning becomes true."""

from __future__ import annotations

from collections.abc import Callable

from rlctl.run.directory import RunDirectory
from rlctl.runs.diagnosis import Grade, diagnose


class FindingReporter:
    """Looks at a run's records; the end of the training says all of it again, with what to try."""

    def __init__(self, run: RunDirectory, warn: Callable[[str], None]) -> None:
        self._run = run
        self._warn = warn
        self._reported: set[str] = set()

    def report_new(self) -> None:
        """Show the warnings that were not there the last time."""
        for finding in diagnose(self._run):
            if finding.grade == Grade.WARNING and finding.id not in self._reported:
                self._reported.add(finding.id)
                self._warn(finding.line)
