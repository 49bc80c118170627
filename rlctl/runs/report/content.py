"""What a report says, before it has a format."""

from __future__ import annotations

import dataclasses
import json
import shlex
from collections.abc import Sequence
from typing import Any

import numpy as np

from rlctl.errors import ArtifactError, RlctlError, UsageError
from rlctl.recipe.recipe import NOT_SET, find_mixed
from rlctl.run.episode import RecordedEpisode
from rlctl.runs.diagnosis import Finding
from rlctl.runs.selection import find_runs_of
from rlctl.runs.show import RunDescription
from rlctl.runs.summary import Rows, list_points


@dataclasses.dataclass(frozen=True)
class Report:
    """One run, or several of one task."""

    runs: list[RunDescription]
    notes: list[str]
    """What a reader must know of the runs themselves."""

    @property
    def title(self) -> str:
        first = self.runs[0].summary
        seeds = ", ".join(str(each.summary.seed) for each in self.runs)
        algorithms = " and ".join(dict.fromkeys(each.summary.algo for each in self.runs))
        return f"{first.task}, {algorithms}, {'seed' if len(self.runs) == 1 else 'seeds'} {seeds}"

    @property
    def terms(self) -> list[str]:
        """The names of the reward terms."""
        columns = self.runs[0].metrics[0] if self.runs[0].metrics else {}
        return [name.removeprefix("term/") for name in columns if name.startswith("term/")]


def collect(texts: Sequence[str]) -> Report:
    """Read the runs that some words name.

    Raises `ArtifactError` for a damaged run and one that has nothing yet, `UsageError` for runs of several tasks.
    """
    found = {run.path.resolve(): run for text in texts for run in find_runs_of(text)}
    runs = [RunDescription(run) for run in found.values()]
    for each in runs:
        if each.summary.state == "damaged":
            raise ArtifactError(f"{each.run.path}: damaged: {each.summary.reason}")
    if len(tasks := {each.summary.task for each in runs}) > 1:
        raise UsageError(f"runs of several tasks, {', '.join(sorted(tasks))}: a report is of one")
    if not any(each.metrics or each.evaluations for each in runs):
        raise ArtifactError(f"{runs[0].run.path}: nothing to report yet: not one update is done")
    return Report(runs, _find_notes(runs))


def _find_notes(runs: Sequence[RunDescription]) -> list[str]:
    notes = [
        f"{each.summary.name} is {each.summary.state_text}, {each.summary.steps or 0:,} steps so far"
        for each in runs
        if each.summary.state in ("running", "stopped")
    ]
    for each in runs:
        warnings = [each.summary.state_text] if each.summary.state == "failed" else each.warnings
        notes += [f"{each.summary.name}: {warning}" for warning in warnings]
    notes += [f"{each.summary.name} has no evaluation yet" for each in runs if not each.evaluations]
    try:
        recipes = [each.run.recipe() for each in runs]
    except RlctlError as error:
        return [*notes, f"a recipe cannot be read: {error}"]
    keys = find_mixed(recipes)
    return [*notes, f"the recipes differ: {', '.join(keys)}"] if keys else notes


def summarize_result(report: Report) -> str:
    """Return the result as a sentence.

    It says where its figures come from: the best of several evaluations is better than new episodes will be.
    """
    scored = [each for each in report.runs if each.summary.best_return is not None]
    if not scored:
        return "No evaluation yet."
    if len(scored) == 1:
        summary = scored[0].summary
        best = next((row for row in scored[0].evaluations if row.get("steps") == summary.best_step), {})
        count = f"{best['episodes']:,.0f}" if best.get("episodes") else "its"
        verb = "has"
        if summary.best_success is not None:
            verb = f"succeeds in {summary.best_success:.1%} of {count} episodes, with"
        of_return = f"a mean return of {summary.best_return:.4g}, at step {summary.best_step:,}"
        return f"In the evaluation that chose it the best policy {verb} {of_return}."
    successes = [each.summary.best_success for each in scored if each.summary.best_success is not None]
    returns = [each.summary.best_return for each in scored if each.summary.best_return is not None]
    of_returns = f"a mean return of {np.mean(returns):.4g} ({min(returns):.4g} to {max(returns):.4g})"
    start = f"In the evaluations that chose them the best policies of {len(scored)} trainings"
    if len(successes) < len(scored):
        return f"{start} have {of_returns}."
    rates = f"{np.mean(successes):.1%} of the episodes ({min(successes):.1%} to {max(successes):.1%})"
    return f"{start} succeed in {rates}, with {of_returns}."


def collect_findings(report: Report) -> list[tuple[Finding, list[str]]]:
    """Return what the runs' records show, each finding once, with its evidence; of several runs with their seeds."""
    found: dict[str, tuple[Finding, list[str]]] = {}
    for run in report.runs:
        for finding in run.findings:
            seed = f"seed {run.summary.seed}: " if len(report.runs) > 1 else ""
            _, evidence = found.setdefault(f"{finding.id} {finding.name}", (finding, []))
            evidence.append(seed + "; ".join(finding.evidence))
    return list(found.values())


def list_commands(report: Report) -> list[str]:
    """Return the commands that train the same again: one for all seeds of a recipe."""
    seeds: dict[tuple[str, ...], list[int]] = {}
    for each in report.runs:
        changes = [
            f"{key}={value if isinstance(value, str) else json.dumps(value)}"
            for key, value in each.summary.changes.items()
            if value != NOT_SET  # another algorithm's, which its own `algo` leaves out
        ]
        source = each.status.get("from")
        start = ["--from", str(source.get("policy"))] if isinstance(source, dict) else []
        options = (*start, *(part for change in changes for part in ("--set", change)))
        seeds.setdefault(options, []).append(each.summary.seed or 0)
    task = report.runs[0].summary.task
    return [
        shlex.join(
            ["rlctl", "train", task, "--seed" if len(each) == 1 else "--seeds", ",".join(map(str, each)), *options]
        )
        for options, each in seeds.items()
    ]


def choose_episodes(report: Report) -> list[tuple[str, RecordedEpisode]]:
    """Return the best and the worst recorded episode of the best evaluation there are episodes of, with their names."""
    episodes = max(report.runs, key=lambda each: each.summary.score).episodes
    steps = max((_trained_steps(each) for each in episodes), default=-1)
    last = [each for each in episodes if _trained_steps(each) == steps]
    if not last:
        return []
    ordered = sorted(last, key=lambda each: (each.info.success is True, each.info.total_reward))
    named = [("best", ordered[-1]), ("worst", ordered[0])] if len(ordered) > 1 else [("one", ordered[0])]
    return [(f"The {name} recorded episode of the last evaluation: {_outcome(each)}", each) for name, each in named]


def _trained_steps(episode: RecordedEpisode) -> int:
    step = episode.info.policy.rpartition(" ")[2]
    return int(step) if step.isdecimal() else -1


def _outcome(episode: RecordedEpisode) -> str:
    success = {True: "success, ", False: "no success, ", None: ""}[episode.info.success]
    return f"{success}return {episode.info.total_reward:.4g}, {len(episode.rewards)} steps"


def mean_curve(tables: Sequence[Rows], column: str, points: int = 200) -> dict[str, Any] | None:
    """Return steps, mean, lowest and highest over several tables at common steps; None without a value.

    All of one shape, at most (points,); a single table gives its own rows, averaged where there are more.
    """
    curves = [np.array(found) for rows in tables if (found := list_points(rows, column))]
    if not curves:
        return None
    if len(curves) == 1:
        parts = np.array_split(curves[0], min(points, len(curves[0])))
        steps, values = np.array([part.mean(axis=0) for part in parts]).T
        return {"steps": steps, "mean": values, "low": values, "high": values, "count": 1}
    first, last = max(curve[0, 0] for curve in curves), min(curve[-1, 0] for curve in curves)
    if last < first:
        return None
    steps = np.linspace(first, last, min(points, max(map(len, curves))))
    values = np.array([np.interp(steps, *curve.T) for curve in curves])
    return {"steps": steps, "mean": values.mean(0), "low": values.min(0), "high": values.max(0), "count": len(curves)}
