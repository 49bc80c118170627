"""`check`: from a description of an environment to a report. It lives in child processes, never in this one."""

from __future__ import annotations

import contextlib
import dataclasses
import time
from collections.abc import Callable, Collection, Iterator, Sequence
from pathlib import Path

from rlctl import registry
from rlctl.check_env import studies
from rlctl.check_env.evidence import Evidence
from rlctl.check_env.finding import Rule, Severity
from rlctl.check_env.judge import Verdict, judge
from rlctl.check_env.progress import Where
from rlctl.check_env.rules import RULES
from rlctl.check_env.watch import Watch
from rlctl.check_env.wire import Message
from rlctl.env_spec import EnvSpec
from rlctl.errors import RecipeError, UsageError


@dataclasses.dataclass(frozen=True)
class Report:
    """What was found, and what it was found by."""

    task: str
    verdict: Verdict
    evidence: Evidence
    seconds: float
    """How long the check took."""
    budget_s: float
    """How long the studies of one process might take."""
    strict: bool = False
    """Whether warnings count as errors."""

    @property
    def exit_code(self) -> int:
        """70 if a rule crashed, 3 if no instance could be built, 1 for errors, 0 otherwise."""
        if self.verdict.crashed:
            return 70
        if self.evidence.built is None:
            return 3
        bad = (Severity.ERROR, Severity.WARNING) if self.strict else (Severity.ERROR,)
        return int(any(finding.severity in bad for finding in self.verdict.findings))

    @property
    def place(self) -> tuple[Path, int] | None:
        """File and line of the environment's class; line 1 where only the file is known."""
        built = self.evidence.built
        if built is not None and built.file is not None:
            return Path(built.file), built.line or 1
        file = registry.find_source_file(self.task)
        return (file, 1) if file else None


def check(
    spec: EnvSpec,
    *,
    env_timeout_s: float,
    rules: Sequence[Rule] = RULES,
    strict: bool = False,
    only: Collection[str] | None = None,
    budget_s: float = studies.PART_S,
    show_progress: bool = True,
) -> Report:
    """Check an environment with some rules, or with what these can tell from some studies `only`.

    Raises `UsageError` for a task or a parameter that does not exist. Whatever the environment itself does, a crash
    or a hang of more than `env_timeout_s` seconds in a call included, is in the report.
    """
    started = time.monotonic()
    evidence = Evidence(spec.task, normalizes=_normalizes(spec.task))
    mistakes: list[UsageError] = []

    def receive(message: Message) -> None:
        header, arrays = message
        if header["type"] == "usage_error":
            kind = RecipeError if header["kind"] == "RecipeError" else UsageError
            mistakes.append(kind(header["message"]))
        else:
            evidence.add(header, arrays)

    needed = {study for rule in rules for study in rule.needs if only is None or study in only}
    parts = {part: [study.name for study in studies.of_part(part, needed)] for part in studies.PARTS}
    watch = Watch(spec, budget_s, env_timeout_s, receive)
    try:
        with _status(spec.task, show_progress) as say:
            watch.run({part: names for part, names in parts.items() if names or part == "probe"}, say)
    finally:
        watch.close()
    if mistakes:
        raise mistakes[0]
    evidence.printed_lines, evidence.printed_first = watch.children[0].printed, watch.children[0].first_line
    verdict = judge(evidence, rules)
    return Report(spec.task, verdict, evidence, time.monotonic() - started, budget_s, strict)


def _normalizes(task: str) -> bool | None:
    """Say whether the recipe that comes with a task normalises observations."""
    from rlctl.run import recipe

    if registry.find_recipe_file(task) is None:
        return None
    normalize = recipe.resolve(task, None, {}).normalize
    return normalize is not None and normalize.observation


@contextlib.contextmanager
def _status(task: str, wanted: bool) -> Iterator[Callable[[Where], None]]:
    """Show a line about what is going on, on a terminal only."""
    from rlctl import output

    console = output.err()
    if not wanted or not console.is_terminal:
        yield lambda where: None
        return
    with console.status(f"checking {task}") as status:

        def say(where: Where) -> None:
            number = f" {where.episode + 1}" if where.phase == "episodes" else ""
            status.update(f"checking {task}: {where.phase}{number}")

        yield say
