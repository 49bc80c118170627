"""`check`: from a task's name to a report. The environment lives in child processes, never in this one."""

from __future__ import annotations

import contextlib
import dataclasses
import time
from collections.abc import Callable, Iterator, Mapping
from typing import Any

from rlctl.check_env.children import Child, watch
from rlctl.check_env.evidence import Evidence
from rlctl.check_env.finding import Severity
from rlctl.check_env.judge import Verdict, judge
from rlctl.check_env.progress import Where
from rlctl.check_env.wire import Message
from rlctl.errors import RecipeError, UsageError

PARTS = {"probe": 0, "instances": 1, "checkers": 0}
"""The child processes and their hash seeds: that of `instances` is another, so that hash order shows."""


@dataclasses.dataclass(frozen=True)
class Report:
    """What was found, and what it was found by."""

    task: str
    verdict: Verdict
    evidence: Evidence
    seconds: float
    """How long the check took."""

    @property
    def exit_code(self) -> int:
        """70 if a rule crashed, 3 if no instance could be built, 1 for errors, 0 otherwise."""
        if self.verdict.crashed:
            return 70
        if self.evidence.built is None:
            return 3
        return int(any(finding.severity is Severity.ERROR for finding in self.verdict.findings))

    @property
    def steps_per_second(self) -> float | None:
        """Speed of `step` in the probe; None where none was taken."""
        episodes = self.evidence.episodes
        seconds = sum(each.step_s for each in episodes)
        return sum(each.steps for each in episodes) / seconds if seconds > 0 else None

    @property
    def reset_ms(self) -> float | None:
        """Mean time of a reset in the probe [ms]."""
        episodes = self.evidence.episodes
        return 1e3 * sum(each.reset_s for each in episodes) / len(episodes) if episodes else None


def check(task: str, parameters: Mapping[str, Any], *, env_timeout_s: float) -> Report:
    """Check an environment with every rule.

    Raises `UsageError` for a task or a parameter that does not exist. Whatever the environment itself does, a crash
    or a hang of more than `env_timeout_s` seconds in a call included, is in the report.
    """
    started = time.monotonic()
    evidence = Evidence(task)
    mistakes: list[UsageError] = []

    def receive(message: Message) -> None:
        header, arrays = message
        if header["type"] == "usage_error":
            kind = RecipeError if header["kind"] == "RecipeError" else UsageError
            mistakes.append(kind(header["message"]))
        else:
            evidence.add(header, arrays)

    children: list[Child] = []
    try:
        with _status(task) as say:
            for part, hash_seed in PARTS.items():
                children.append(Child(part, task, parameters, hash_seed=hash_seed))
            watch(children, receive, env_timeout_s, say)
    finally:
        for child in children:
            child.close()
    if mistakes:
        raise mistakes[0]
    evidence.printed_lines, evidence.printed_first = children[0].printed, children[0].first_line
    return Report(task, judge(evidence), evidence, time.monotonic() - started)


@contextlib.contextmanager
def _status(task: str) -> Iterator[Callable[[Where], None]]:
    """Show a line about what is going on, on a terminal only."""
    from rlctl import output

    console = output.err()
    if not console.is_terminal:
        yield lambda where: None
        return
    with console.status(f"checking {task}") as status:

        def say(where: Where) -> None:
            number = f" {where.episode + 1}" if where.phase == "episodes" else ""
            status.update(f"checking {task}: {where.phase}{number}")

        yield say
