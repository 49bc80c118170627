"""The check before training: two seconds of check-env, beside the import of torch."""

from __future__ import annotations

import threading

from rlctl.check_env.check import Report, check
from rlctl.check_env.families import find_rules
from rlctl.check_env.finding import Severity
from rlctl.env_spec import EnvSpec
from rlctl.errors import AnswerIsNo
from rlctl.train.display import Display

BUDGET_S = 2.0
"""Time for playing episodes [s]; importing and building the environment come on top."""
EXPERIMENTS = ("build", "comparisons", "episodes")
"""What one child process can do in that time."""


class Precheck:
    """Checks an environment in a child process, watched by a thread of this one."""

    def __init__(self, spec: EnvSpec, env_timeout_s: float) -> None:
        self._spec = spec
        self._env_timeout_s = env_timeout_s
        self._report: Report | None = None
        self._error: BaseException | None = None
        self._thread = threading.Thread(target=self._check, daemon=True)  # the child ends with this process
        self._thread.start()

    def _check(self) -> None:
        try:
            self._report = check(
                self._spec,
                rules=find_rules(EXPERIMENTS),
                only=EXPERIMENTS,
                budget_s=BUDGET_S,
                env_timeout_s=self._env_timeout_s,
                show_progress=False,
            )
        except BaseException as error:  # raised again where somebody waits for it
            self._error = error

    def refuse_errors(self, display: Display) -> None:
        """Wait for the end of the check; raises `AnswerIsNo` if it found an error."""
        self._thread.join()
        if self._error is not None:
            raise self._error
        report = self._report
        if report is None or report.records.built is None:
            return  # the workers build it too, and report what is wrong
        task, found = self._spec.task, report.verdict.findings
        for name in report.verdict.crashed:
            display.message(f"check before training: {name} crashed, a bug in rlctl; what it would find is not known")
        errors = [finding for finding in found if finding.severity is Severity.ERROR]
        if errors:
            text = "; ".join(f"{each.rule} {each.name} ({each.message})" for each in errors)
            count = f"{len(errors)} error{'s' if len(errors) > 1 else ''}"
            raise AnswerIsNo(
                f"the check before training found {count}: {text}\n"
                f"rlctl check-env {task} shows details; --no-check trains anyway."
            )
        warnings = [finding.rule for finding in found if finding.severity is Severity.WARNING]
        if warnings:
            display.message(
                f"check before training: warnings {', '.join(warnings)}; rlctl check-env {task} shows details"
            )
