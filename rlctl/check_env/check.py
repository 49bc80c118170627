"""`check`: from a description of an environment to a report. The environment runs in child processes only."""

from __future__ import annotations

import contextlib
import dataclasses
import time
from collections.abc import Callable, Collection, Iterator, Sequence
from pathlib import Path

from rlctl import registry
from rlctl.check_env import families
from rlctl.check_env.finding import RULES, Severity
from rlctl.check_env.judge import Verdict, judge
from rlctl.check_env.messages import Message, Mistake
from rlctl.check_env.progress import Position
from rlctl.check_env.records import Records
from rlctl.check_env.supervisor import Supervisor
from rlctl.env_spec import EnvSpec
from rlctl.errors import RecipeError, UsageError


@dataclasses.dataclass(frozen=True)
class Report:
    """What was found, and what it was found by."""

    task: str
    verdict: Verdict
    records: Records
    seconds: float
    """How long the check took."""
    budget_s: float
    """How long the experiments of one process might take."""
    strict: bool = False
    """Whether warnings count as errors."""

    @property
    def exit_code(self) -> int:
        """70 if a rule crashed, 3 if no instance could be built, 1 for errors, 0 otherwise."""
        if self.verdict.crashed:
            return 70
        if self.records.built is None:
            return 3
        bad = (Severity.ERROR, Severity.WARNING) if self.strict else (Severity.ERROR,)
        return int(any(finding.severity in bad for finding in self.verdict.findings))

    @property
    def place(self) -> tuple[Path, int] | None:
        """File and line of the environment's class; line 1 where only the file is known."""
        built = self.records.built
        if built is not None and built.file is not None:
            return Path(built.file), built.line or 1
        file = registry.find_source_file(self.task)
        return (file, 1) if file else None


def check(
    spec: EnvSpec,
    *,
    env_timeout_s: float,
    rules: Sequence[str] = tuple(RULES),
    strict: bool = False,
    only: Collection[str] | None = None,
    budget_s: float = families.PROCESS_S,
    show_progress: bool = True,
) -> Report:
    """Check an environment with some rules, given by id, or with what these can say from some experiments `only`.

    Raises `UsageError` for a task or a parameter that does not exist. Whatever the environment itself does, a crash
    or a hang of more than `env_timeout_s` seconds in a call included, is in the report.
    """
    started = time.monotonic()
    records = Records(spec.task, normalizes=lambda: _normalizes(spec.task))
    mistakes: list[UsageError] = []

    def receive(message: Message) -> None:
        if isinstance(message, Mistake):
            mistakes.append((RecipeError if message.is_recipe else UsageError)(message.message))
        else:
            records.add(message)

    needed = {"build"} | {name for name in families.find_needs(rules) if only is None or name in only}
    experiments = {
        name: [each.name for each in process.experiments if each.name in needed]
        for name, process in families.PROCESSES.items()
    }
    supervisor = Supervisor(spec, budget_s, env_timeout_s, receive)
    try:
        with _status(spec.task, show_progress) as say:
            supervisor.run({name: names for name, names in experiments.items() if names}, say)
    finally:
        supervisor.close()
    if mistakes:
        raise mistakes[0]
    records.printed_lines, records.printed_first = supervisor.children[0].printed, supervisor.children[0].first_line
    return Report(spec.task, judge(records, rules), records, time.monotonic() - started, budget_s, strict)


def _normalizes(task: str) -> bool | None:
    """Say whether the recipe that comes with a task normalises observations."""
    if registry.find_recipe_file(task) is None:
        return None
    from rlctl.run import recipe_sources  # takes a quarter of a second

    normalize = recipe_sources.resolve(task, None, {}).normalize
    return normalize is not None and normalize.observation


@contextlib.contextmanager
def _status(task: str, wanted: bool) -> Iterator[Callable[[Position], None]]:
    """Show a line about what is going on, on a terminal only."""
    from rlctl import output

    console = output.err()
    if not wanted or not console.is_terminal:
        yield lambda position: None
        return
    with console.status(f"checking {task}") as status:

        def say(position: Position) -> None:
            number = f" {position.episode + 1}" if position.phase == "episodes" else ""
            status.update(f"checking {task}: {position.phase}{number}")

        yield say
