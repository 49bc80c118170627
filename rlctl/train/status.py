"""The content of `run.json`: how it began and how it ended."""

from __future__ import annotations

import datetime
import os
import platform
import subprocess
import sys
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from rlctl import registry
from rlctl.errors import DivergedError, Interrupted, RlctlError
from rlctl.run import files
from rlctl.run.directory import RunDirectory
from rlctl.run.policy import collect_versions
from rlctl.run.recipe import Recipe, resolve
from rlctl.run.recipe_difference import find_difference

if TYPE_CHECKING:
    from rlctl.train.progress import Progress

_STATUS: dict[type[BaseException], str] = {Interrupted: "interrupted", DivergedError: "diverged"}


def write_start(run: RunDirectory, task: str, recipe: Recipe, device: str, resumed_at: int | None) -> None:
    """Write the recipe, and that a training runs; `resumed_at` is the step it goes on from."""
    run.write_recipe(recipe)
    changes: dict[str, Any] = {
        "status": "running",
        "error": None,
        "task": task,
        **_identity(task),
        "algo": recipe.algo,
        "seed": recipe.seed,
        "recipe_changes": _find_recipe_changes(task, recipe),
        "device": device,
        "versions": collect_versions(),
        "git_commit": _git_commit(),
        "command": ["rlctl", *sys.argv[1:]],
        "host": platform.node(),
        "pid": os.getpid(),
    }
    if resumed_at is not None:
        changes["resumed"] = _now()
        changes["resumed_at_step"] = resumed_at
    else:
        changes["started"] = _now()
        changes["folder"] = os.getcwd()  # what a task's path may be relative to
    run.write_status(changes)


def _find_recipe_changes(task: str, recipe: Recipe) -> dict[str, Any]:
    """Return the keys in which a recipe differs from the task's own, and their values."""
    constructor: Any = registry.load(task)
    stages = constructor.stages if registry.is_task(constructor) else ()
    try:
        packaged = resolve(task, None, {}, stages)
    except RlctlError:  # a packaged recipe that is wrong in itself; this one was made right by --config or --set
        return {}
    return {key: value for key, (value, _) in find_difference(recipe, packaged).items()}


def _identity(task: str) -> dict[str, Any]:
    """Return what identifies a version of a task: its distribution's, and its source."""
    source = registry.find_source_file(task)
    digest = files.digest(source.read_bytes()) if source is not None and source.is_file() else None
    return {"origin": registry.find_origin(task), "source_sha256": digest}


def describe_task_changes(before_status: Mapping[str, Any], task: str) -> list[str]:
    """Describe how a task differs from what `run.json` has of the start; empty if it does not."""
    now = _identity(task)
    before, after = (each if isinstance(each, dict) else {} for each in (before_status.get("origin"), now["origin"]))
    if before != after:
        names = (" ".join(map(str, each.values())) or "no installed package" for each in (before, after))
        return ["task {} came from {} when the run began, and comes from {} now".format(task, *names)]
    if before_status.get("source_sha256") != now["source_sha256"]:
        file = registry.find_source_file(task)
        gone = file is not None and not file.is_file()
        return [f"{file or task} {'is not there any more' if gone else 'is not what it was when the run began'}"]
    return []


def write_failure(run: RunDirectory, error: BaseException) -> None:
    """Write what ended a training before its time."""
    kind = _STATUS.get(type(error), "failed")
    run.write_status({"status": kind, "error": str(error) or repr(error), "ended": _now()})


def write_end(run: RunDirectory, steps: int, progress: Progress) -> None:
    """Write that a training is done, and what came of it."""
    run.write_status(
        {
            "status": "finished",
            "ended": _now(),
            "steps": steps,
            "seconds": round(progress.seconds, 3),
            "best_step": progress.best_step,
            "best_success": progress.best_success,
            "best_return": progress.best_return,
            "observations_outside": progress.observations_outside,
            "observations_cast": progress.observations_cast,
            "failed_evaluations": progress.failed_evaluations,
            **({"stage": progress.stage} if progress.stage else {}),
        }
    )


def _now() -> str:
    return datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")


def _git_commit() -> str | None:
    try:
        found = subprocess.run(["git", "rev-parse", "HEAD"], capture_output=True, text=True, timeout=5.0, check=False)
    except (OSError, subprocess.TimeoutExpired):
        return None
    return found.stdout.strip() or None
