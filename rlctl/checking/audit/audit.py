"""`audit`: lets scripted competitors play in child processes, and says who earns most."""

import dataclasses
import time
from collections.abc import Callable
from pathlib import Path

from rlctl.checking.audit import child
from rlctl.checking.audit.play_world import PlayedEpisode
from rlctl.checking.audit.ranking import Ranking, rank
from rlctl.checking.check import show_status
from rlctl.checking.children import ChildMain, Supervisor
from rlctl.checking.records import ChildMessage, Fact, Records
from rlctl.environments import installed
from rlctl.environments.spec import EnvSpec
from rlctl.errors import RlctlError, TaskError, UsageError

PROCESS_S = 45.0  # for the plays of one process [s], besides importing and building


@dataclasses.dataclass(frozen=True)
class AuditReport:
    """Who earns most in an environment."""

    task: str
    ranking: Ranking
    not_played: dict[str, str]  # competitor -> reason
    is_cut: bool  # whether time ran out before all had played
    seconds: float

    @property
    def exit_code(self) -> int:
        """1 if a competitor earns as much as what is wanted, else 0."""
        return int(bool(self.ranking.beaten))

    @property
    def verdict(self) -> str:
        """The result in a line."""
        ranking = self.ranking
        if not ranking.wanted:
            return f"ranking alone: {ranking.why_alone}"
        if not ranking.beaten:
            return f"nobody earns as much as {ranking.wanted}{ranking.next_best}"
        return ranking.beaten[0].describe()


def audit(
    spec: EnvSpec,
    *,
    env_timeout_s: float,
    budget_s: float | None = None,
    learned: Path | None = None,
    show_progress: bool = True,
) -> AuditReport:
    """Let competitors play in an environment, and the policy `learned`, for at most `budget_s` seconds a process.

    Raises `UsageError` for a task or a parameter that does not exist, and for actions of another kind than
    competitors can take; `TaskError` if every play failed.
    """
    started = time.monotonic()
    records, played = Records(spec.task), list[PlayedEpisode]()

    def receive(message: ChildMessage) -> None:
        if isinstance(message, Fact) and message.experiment == child.PLAYED:
            played.append(message.value)
        else:
            records.add(message)

    with show_status(f"auditing {spec.task}", show_progress) as say:
        _run(spec, budget_s or PROCESS_S, env_timeout_s, receive, learned, say)
    crashes = [end.crash for end in records.finished.values() if end.crash]
    if crashes:
        raise RuntimeError(f"a competitor crashed, a bug in rlctl:\n{crashes[0]}")
    if not played:
        raise _explain_failure(records)
    is_cut = any(end.is_cut for end in records.finished.values()) or child.AUDIT in records.skipped
    skipped = {name: why for name, why in records.skipped.items() if name != child.AUDIT}
    for failure in records.failures:
        skipped.setdefault(failure.phase, failure.message)
    has_success = any(episode.success is not None for episode in played)
    return AuditReport(spec.task, rank(played, has_success), skipped, is_cut, time.monotonic() - started)


def _run(
    spec: EnvSpec,
    budget_s: float,
    env_timeout_s: float,
    receive: Callable[[ChildMessage], None],
    learned: Path | None,
    say: Callable[[str], None],
) -> None:
    entry = installed.find(spec.task)
    shipped = entry.policy_file if entry is not None else None
    files = {"shipped": str(shipped or ""), "learned": str(learned or "")}
    wanted = {f"audit {number}": ["build", child.AUDIT] for number in range(child.PROCESSES)}
    main = ChildMain("rlctl.checking.audit.child:main", files)
    Supervisor(spec, budget_s, env_timeout_s, receive, main=main).run(wanted, say)


def _explain_failure(records: Records) -> RlctlError:
    """Return why nobody could play."""
    if records.built is None and records.findings:
        first = records.findings[0]
        return TaskError(f"{records.task}: {first.message}\n{first.fix}")
    if records.failures:
        return TaskError(f"{records.task}: {records.failures[0].message}", details=records.failures[0].details)
    if any(end.is_cut for end in records.finished.values()):
        return UsageError(f"{records.task}: time ran out before the first episode; give more: --budget SECONDS")
    why = next(iter(records.skipped.values()), "no episode was played")
    return UsageError(f"--audit: {records.task}: {why}")
