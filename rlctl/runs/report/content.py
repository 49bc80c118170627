"""The content of a report, before it is formatted."""

import dataclasses
import json
import re
import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from rlctl.environments import installed
from rlctl.errors import ArtifactError, RlctlError, UsageError
from rlctl.output import format_duration
from rlctl.play.episode import RecordedEpisode
from rlctl.recipe.recipe import NOT_SET, Recipe, find_difference
from rlctl.runs.diagnosis.findings import Finding, list_followers
from rlctl.runs.directory import is_group
from rlctl.runs.listing import find_runs_of
from rlctl.runs.recipe_names import name_recipes
from rlctl.runs.report.show import RunDescription, list_changes
from rlctl.runs.tables import TableRows, list_points

_GOOD_SUCCESS = 0.5
_TIME = re.compile(r"\d{4}-\d\d-\d\d_\d\d-\d\d-\d\d")  # what rlctl names runs and groups by
_COMPLETE = 0.95  # of the steps of the longest seed: rollouts end at slightly different steps


@dataclasses.dataclass(frozen=True)
class RecipeRuns:
    """The runs of one recipe."""

    name: str  # what distinguishes this recipe from the others; empty for a single one
    runs: list[RunDescription]
    label: str = ""  # in legends: the name of its run or group; where a recipe has none, `name`


@dataclasses.dataclass(frozen=True)
class RunReport:
    """One run, or several of one task."""

    recipes: list[RecipeRuns]
    notes: list[str]  # warnings about the runs

    @property
    def runs(self) -> list[RunDescription]:
        """All runs, recipe by recipe."""
        return [run for recipe in self.recipes for run in recipe.runs]

    @property
    def title(self) -> str:
        """Task, algorithms and seeds."""
        first = self.runs[0].summary
        numbers = dict.fromkeys(str(run.summary.seed) for run in self.runs)
        algorithms = " and ".join(dict.fromkeys(run.summary.algo for run in self.runs))
        return f"{first.task}, {algorithms}, {'seed' if len(numbers) == 1 else 'seeds'} {', '.join(numbers)}"


def collect(texts: Sequence[str], labels: Sequence[str] = ()) -> RunReport:
    """Read the runs that arguments name; raises `RlctlError` for runs that cannot be in one report.

    `labels` are names of the recipes in legends and tables, in the order of the arguments; by default those of the
    arguments, where each has one recipe, or else what differs.
    """
    named = [(text, run) for text in texts for run in find_runs_of(text)]
    folders = {run.path.resolve(): run for _, run in named}
    arguments = {run.path.resolve(): text for text, run in reversed(named)}
    runs = [RunDescription(run) for run in folders.values()]
    for run in runs:
        if run.summary.state == "damaged":
            raise ArtifactError(f"{run.run.path}: damaged: {run.summary.reason}")
    if len(tasks := {run.summary.task for run in runs}) > 1:
        raise UsageError(f"runs of several tasks ({', '.join(sorted(tasks))}); a report covers one task")
    if not any(run.metrics or run.evaluations for run in runs):
        raise ArtifactError(f"{runs[0].run.path}: nothing to report yet: no update is finished")
    notes = [note for run in runs for note in _find_notes(run)]
    try:
        recipes = _group_by_recipe(runs, arguments)
    except RlctlError as error:
        recipes = [RecipeRuns("", runs)]
        notes.append(f"a recipe cannot be read: {error}")
    if labels:
        recipes = _label(recipes, labels)
    return RunReport(recipes, notes)


def _label(recipes: Sequence[RecipeRuns], labels: Sequence[str]) -> list[RecipeRuns]:
    if len(labels) != len(recipes):
        names = ", ".join(recipe.label or recipe.name or "the only one" for recipe in recipes)
        raise UsageError(f"--label: {len(labels)} given, and there are {len(recipes)} recipes: {names}")
    twice = next((label for label in labels if labels.count(label) > 1), None)
    if twice is not None:
        raise UsageError(f"--label {twice} is given twice; rows and curves need different names")
    return [dataclasses.replace(recipe, label=label) for recipe, label in zip(recipes, labels, strict=True)]


def _find_notes(run: RunDescription) -> list[str]:
    name, notes = run.summary.name, []
    if run.summary.state in ("running", "stopped"):
        notes.append(f"{name} is {run.summary.state_text}, {run.summary.steps or 0:,} steps so far")
    warnings = [run.summary.state_text] if run.summary.state == "failed" else run.warnings
    notes += [f"{name}: {warning}" for warning in warnings]
    return notes if run.evaluations else [*notes, f"{name} has no evaluation yet"]


def _group_by_recipe(runs: Sequence[RunDescription], arguments: Mapping[Path, str]) -> list[RecipeRuns]:
    """Group runs that differ only in the seed; raises `RlctlError` for a recipe that cannot be read.

    `arguments` are the texts that named the runs, by their resolved paths.
    """
    groups: list[tuple[Recipe, list[RunDescription]]] = []
    for run in runs:
        recipe = run.run.recipe()
        same = next((group for other, group in groups if not find_difference(recipe, other)), None)
        if same is None:
            groups.append((recipe, [run]))
        else:
            same.append(run)
    names = name_recipes([recipe for recipe, _ in groups])
    labels = names
    candidates = [
        [_find_argument(group, arguments) for _, group in groups],
        [_find_folder(group) for _, group in groups],
        [_find_algorithm(group) for _, group in groups],
    ]
    if len(groups) > 1:
        distinct = (texts for texts in candidates if "" not in texts and len(set(texts)) == len(texts))
        labels = next(distinct, names)
    return [RecipeRuns(name, group, label) for name, label, (_, group) in zip(names, labels, groups, strict=True)]


def _find_argument(runs: Sequence[RunDescription], arguments: Mapping[Path, str]) -> str:
    """Return the last part of the argument that named all runs; empty for several, globs, `latest`, times."""
    texts = {arguments[run.run.path.resolve()] for run in runs}
    text = texts.pop()
    is_pattern = any(character in text for character in "*?[")
    name = Path(text).resolve().name
    is_time = len(runs) > 1 and _TIME.match(name)  # of a group; a single run is known by its name
    is_name = not (texts or is_pattern or text == "latest" or is_time)
    return name if is_name else ""


def _find_folder(runs: Sequence[RunDescription]) -> str:
    """Return the name of a single run's folder, or of the group that all are in; empty for names that are times."""
    paths = [run.run.path.resolve() for run in runs]
    if len(paths) == 1:
        name = paths[0].name
    else:
        folders = {path.parent for path in paths}
        group = folders.pop()
        name = "" if folders or not is_group(group) else group.name
    return "" if _TIME.match(name) else name


def _find_algorithm(runs: Sequence[RunDescription]) -> str:
    algorithms = {run.summary.algo for run in runs}
    return algorithms.pop() if len(algorithms) == 1 else ""


def list_facts(report: RunReport) -> list[tuple[str, str]]:
    """Return names and texts: task, differences from its recipe, start, duration, machine and versions."""
    summaries = [run.summary for run in report.runs]
    task = summaries[0].task
    entry = installed.find(task)
    summary = entry.summary if entry else ""
    hosts = dict.fromkeys(f"{run.status.get('host', '')}, {run.status.get('device', '')}" for run in report.runs)
    started = sorted(summary.started[:16].replace("T", " ") for summary in summaries if summary.started)
    steps = sorted({summary.steps or 0 for summary in summaries})
    of_steps = f"{steps[0]:,}" if len(steps) == 1 else f"{steps[0]:,} to {steps[-1]:,}"
    seconds = format_duration(sum(summary.seconds or 0.0 for summary in summaries))
    trained = f"{of_steps} steps in {seconds}"
    if len(summaries) > 1:
        trained = f"{len(summaries)} trainings, {of_steps} steps each, {seconds} together"
    facts = {
        "Task": f"{task}: {summary}" if summary else task,
        "Differs from the task's recipe": "; ".join(_list_changes(report)),
        "Started": " to ".join(dict.fromkeys((started[0], started[-1]))) + " UTC" if started else "",
        "Trained": trained,
        "Machine": "; ".join(host.strip(", ") for host in hosts),
        "Versions": ", ".join(f"{name} {version}" for name, version in summaries[0].versions.items()),
    }
    return [(name, text) for name, text in facts.items() if text]


def _list_changes(report: RunReport) -> list[str]:
    """Return what differs from the task's recipe, of several recipes each with its name."""
    texts = []
    for recipe in report.recipes:
        changes = ", ".join(list_changes(recipe.runs[0].summary))
        if changes:
            texts.append(f"{recipe.name}: {changes}" if len(report.recipes) > 1 else changes)
    return texts


def summarize_result(runs: Sequence[RunDescription]) -> str:
    """Return the result of the runs of a recipe as a sentence.

    It names the source of its numbers: the best of several evaluations overestimates new episodes.
    """
    scored = [run for run in runs if run.summary.best_return is not None]
    if not scored:
        return "No evaluation yet."
    successes = [run.summary.best_success for run in scored if run.summary.best_success is not None]
    returns = [run.summary.best_return for run in scored if run.summary.best_return is not None]
    start, verbs = "In the evaluation that selected it, the best policy", ("succeeds", "has")
    episodes, end = "the episodes", f", at step {scored[0].summary.best_step or 0:,}"
    if len(scored) > 1:
        start = f"In the evaluations that selected them, the best policies of {len(scored)} trainings"
        verbs, end = ("succeed", "have"), ""
    elif count := scored[0].evaluations[-1].get("episodes"):
        episodes = f"{count:,.0f} episodes"
    of_return = f"a mean return of {_format_range(returns, '.4g')}{end}"
    if len(successes) < len(scored):
        return f"{start} {verbs[1]} {of_return}."
    return f"{start} {verbs[0]} in {_format_range(successes, '.1%')} of {episodes}, with {of_return}."


def _format_range(values: Sequence[float], form: str) -> str:
    """Return `80.0%`, or of several values `90.0% (80.0% to 100.0%)`."""
    mean = f"{np.mean(values):{form}}"
    return mean if len(values) == 1 else f"{mean} ({min(values):{form}} to {max(values):{form}})"


def describe_absence(report: RunReport) -> str:
    """Return the diagnosis without findings: no known problem, which does not mean a good result."""
    which = "this training" if len(report.runs) == 1 else "these trainings"
    rates = [run.summary.best_success for run in report.runs if run.summary.best_success is not None]
    if not rates or (best := max(rates)) >= _GOOD_SUCCESS:
        return f"Nothing unusual in the records of {which}."
    run = next(run for run in report.runs if run.summary.best_success == best)
    return (
        f"No sign of a known mistake was found in the records of {which}, but the best policy succeeds in only "
        f"{best:.1%} of the episodes. What has it learned instead? rlctl runs show "
        f"{shlex.quote(str(run.summary.path))} --audit"
    )


def collect_findings(report: RunReport) -> list[tuple[Finding, list[str]]]:
    """Return the findings of all runs, each once, with the evidence of every run; without those that only follow."""
    findings: dict[str, tuple[Finding, list[str]]] = {}
    for run in report.runs:
        for finding in run.findings:
            if finding.follows:
                continue
            seed = f"seed {run.summary.seed}: " if len(report.runs) > 1 else ""
            _, evidence = findings.setdefault(f"{finding.id} {finding.name}", (finding, []))
            evidence.append(seed + "; ".join(finding.evidence))
    return list(findings.values())


def collect_followers(report: RunReport) -> list[str]:
    """Return a line for each finding of a run that others probably follow from."""
    lines = []
    for run in report.runs:
        seed = f"seed {run.summary.seed}: " if len(report.runs) > 1 else ""
        lines += [seed + line for line in list_followers(run.findings)]
    return lines


def list_commands(report: RunReport) -> list[str]:
    """Return the commands that train the same again: one for all seeds of a recipe."""
    seeds: dict[tuple[str, ...], list[int]] = {}
    for run in report.runs:
        changes = [
            f"{key}={value if isinstance(value, str) else json.dumps(value)}"
            for key, value in run.summary.changes.items()
            if value != NOT_SET  # a key of another algorithm, which `algo` removes
        ]
        source = run.status.get("from")
        start = ["--from", str(source.get("policy"))] if isinstance(source, dict) else []
        options = (*start, *(part for change in changes for part in ("--set", change)))
        seeds.setdefault(options, []).append(run.summary.seed or 0)
    task = report.runs[0].summary.task
    return [
        shlex.join(
            ["rlctl", "train", task, "--seed" if len(own) == 1 else "--seeds", ",".join(map(str, own)), *options]
        )
        for options, own in seeds.items()
    ]


def choose_episodes(report: RunReport) -> list[tuple[str, RecordedEpisode]]:
    """Return the best and the worst recorded episode of the best run's last evaluation, with captions."""
    pairs = ((recipe, run) for recipe in report.recipes for run in recipe.runs)
    recipe, best = max(pairs, key=lambda pair: pair[1].summary.score)
    of_recipe = f" of {recipe.name}" if recipe.name else ""
    steps = [episode.info.evaluated_at or 0 for episode in best.episodes]  # those of evaluations only, no replays
    last = [episode for episode, step in zip(best.episodes, steps, strict=True) if step == max(steps)]
    if not last:
        return []
    ordered = sorted(last, key=lambda episode: (episode.info.success is True, episode.info.total_reward))
    named = [("best", ordered[-1]), ("worst", ordered[0])] if len(ordered) > 1 else [("one", ordered[0])]
    return [
        (f"The {name} recorded episode of the last evaluation{of_recipe}: {_outcome(episode)}", episode)
        for name, episode in named
    ]


def _outcome(episode: RecordedEpisode) -> str:
    success = {True: "success, ", False: "no success, ", None: ""}[episode.info.success]
    return f"{success}return {episode.info.total_reward:.4g}, {len(episode.rewards)} steps"


def mean_curve(tables: Sequence[TableRows], column: str, points: int = 200) -> dict[str, Any] | None:
    """Return steps, mean, lowest and highest over several tables at common steps; None without a value.

    All of one shape, at most (points,); the rows of a single table are averaged down to `points`. Where a table ends
    early, the mean is that of the others from there on; `ended` has its number, last step and value.
    """
    curves = [np.array(list_points(rows, column)).reshape(-1, 2) for rows in tables]
    numbers = [number for number, curve in enumerate(curves) if len(curve)]
    curves = [curves[number] for number in numbers]
    if not curves:
        return None
    if len(curves) == 1:
        parts = np.array_split(curves[0], min(points, len(curves[0])))
        steps, values = np.array([part.mean(axis=0) for part in parts]).T
        return {"steps": steps, "mean": values, "low": values, "high": values, "count": 1, "ended": []}
    longest = max(curve[-1, 0] for curve in curves)
    ended = [
        (number, *curve[-1].tolist())
        for number, curve in zip(numbers, curves, strict=True)
        if curve[-1, 0] < _COMPLETE * longest
    ]
    first = max(curve[0, 0] for curve in curves)
    last = min(curve[-1, 0] for curve in curves if curve[-1, 0] >= _COMPLETE * longest)
    if last < first:
        return None
    steps = np.linspace(first, last, min(points, max(map(len, curves))))
    values = np.array([np.interp(steps, curve[:, 0], curve[:, 1], right=np.nan) for curve in curves])
    low, high = np.nanmin(values, axis=0), np.nanmax(values, axis=0)
    mean = np.nanmean(values, axis=0)
    return {"steps": steps, "mean": mean, "low": low, "high": high, "count": len(curves), "ended": ended}
