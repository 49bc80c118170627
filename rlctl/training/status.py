"""What `run.json` says of the start and the end of a training."""

from __future__ import annotations

import datetime
import os
import platform
import sys
import uuid
from typing import TYPE_CHECKING, Any

from rlctl.environments.registry import find_git_commit, identify_files, identify_task
from rlctl.errors import DivergedError, Interrupted, RlctlError, RunTaken
from rlctl.recipe.recipe import Recipe, find_difference
from rlctl.recipe.sources import resolve_with_stages
from rlctl.runs.directory import RunDirectory
from rlctl.training.progress import Progress
from rlctl.version import collect_versions

if TYPE_CHECKING:
    from rlctl.policy.file import PolicyInfo
    from rlctl.training.start import Start


def write_start(run: RunDirectory, start: Start, device: str) -> None:
    """Write the recipe, the status `running`, and the device on which the network learns."""
    recipe = start.recipe
    run.write_recipe(recipe)
    changed = find_recipe_changes(start.task, recipe)
    changes: dict[str, Any] = {
        "status": "running",
        "error": None,
        "task": start.task,
        **identify_task(start.task),
        "files_sha256": identify_files(start.task),
        "callbacks": {name: identify_task(name) for name in recipe.callbacks},
        "algo": recipe.algo,
        "seed": recipe.seed,
        "recipe_changes": {key: value for key, (value, _) in changed.items()},
        "recipe_before": {key: before for key, (_, before) in changed.items()},
        "device": device,
        "versions": collect_versions(),
        "git_commit": find_git_commit(),
        "command": ["rlctl", *sys.argv[1:]],
        "host": platform.node(),
        "pid": os.getpid(),
    }
    if start.run is not None:
        changes |= {"resumed": _now(), "resumed_at_step": start.step}
    else:
        folder = os.environ.get("RLCTL_FOLDER") or os.getcwd()  # a task's path may be relative to it
        changes |= {"id": uuid.uuid4().hex, "started": _now(), "folder": folder}
        teacher = None if start.teacher is None else start.teacher.describe()
        sources = {"from": start.source, "demos": start.demos, "teacher": teacher}
        changes |= {name: source for name, source in sources.items() if source is not None}
    run.write_status(changes)


def find_recipe_changes(task: str, recipe: Recipe) -> dict[str, tuple[Any, Any]]:
    """Return the keys in which a recipe differs from the task's own, each with its value and the task's, without keys
    derived from these."""
    chosen = {key: getattr(recipe, key) for key in ("algo", "n_envs", "total_timesteps")}
    try:
        packaged, adapted = resolve_with_stages(task), resolve_with_stages(task, None, chosen)
    except RlctlError:  # the packaged recipe is invalid; --config or --set corrected it
        return {}
    pairs = {key: (value, getattr(packaged, key)) for key, value in chosen.items()}
    own = {key: pair for key, pair in pairs.items() if pair[0] != pair[1]}
    return own | find_difference(recipe, adapted)


def write_failure(run: RunDirectory, error: BaseException) -> None:
    """Write the status and error of a training that ended early."""
    kind = {Interrupted: "interrupted", DivergedError: "diverged"}.get(type(error), "failed")
    if run.status_file.exists() and not isinstance(error, RunTaken):  # else the run was removed or taken over
        run.write_status({"status": kind, "error": str(error) or repr(error), "ended": _now()})


def write_end(run: RunDirectory, steps: int, progress: Progress, best: PolicyInfo | None) -> None:
    """Write the status `finished` and the results; `best` is the best policy."""
    score = best.evaluation if best else None
    run.write_status(
        {
            "status": "finished",
            "ended": _now(),
            "steps": steps,
            "seconds": round(progress.seconds, 3),
            "best_step": best.training_steps if best else None,
            "best_success": score.success if score else None,
            "best_return": score.mean_return if score else None,
            "observations_outside": progress.observations_outside,
            "failed_evaluations": progress.failed_evaluations,
            **({"stop_reason": progress.stop_reason} if progress.stop_reason else {}),
            **({"stage": progress.stage} if progress.stage else {}),
        }
    )


def _now() -> str:
    return datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")
