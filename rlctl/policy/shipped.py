"""Policies that ship with a plugin, `policies/<task>.safetensors` next to its module: origin and scores.

A shipped policy has the actor only; `rlctl export RUN --policy FILE` writes it.
"""

from pathlib import Path
from typing import Any

import pydantic

from rlctl.environments import installed
from rlctl.errors import ArtifactError, UsageError, did_you_mean

PRETRAINED = "pretrained"  # the word for a task's shipped policy where a command or a function takes `checkpoint`

Interval = tuple[float, float]  # lower and upper bound of a 95 % interval


class MeasuredScore(pydantic.BaseModel, extra="forbid"):
    """The score of a policy or a baseline on episodes that were not used in training."""

    episodes: int
    seed: int  # `rlctl eval --episodes N --seed SEED` plays the same episodes
    mean_return: float
    return_interval: Interval  # for the mean
    success: float | None
    success_interval: Interval | None
    mean_length: float  # [steps]
    ended_early: float | None
    """Fraction of the episodes that ended before the time limit, such as by a fall; None without a time limit."""
    action_change: float  # mean of |action - previous action|, over elements and steps; 0 for discrete actions


class Provenance(pydantic.BaseModel, extra="forbid"):
    """Where an exported policy comes from, and its scores."""

    run: str  # `TASK/RUN`, the last two folders of the run's path
    origin: dict[str, str] = {}  # distribution and version of the task that it was measured on
    source_sha256: str | None = None  # sha256 of that task's file
    git_commit: str | None = None  # commit of the folder in which it was trained
    recipe: dict[str, Any]  # the resolved recipe
    score: MeasuredScore
    baselines: dict[str, MeasuredScore] = {}  # `zero` and `random`, on the same episodes


def list_shipped() -> list[str]:
    """Return the installed tasks that ship a policy."""
    entries = [entry for entry in installed.list_installed() if entry.problem is None]
    return [entry.name for entry in entries if entry.policy_file is not None]


def find_shipped_policy(task: str | None) -> Path:
    """Return the file of a task's shipped policy.

    Raises `UsageError` for None or a task that is not installed, `ArtifactError` for a task without one.
    """
    if task is None:
        raise UsageError(f"--pretrained: give a task that ships a policy: {', '.join(list_shipped()) or 'none'}")
    entry = installed.find(task)
    if entry is None:
        close = did_you_mean(task, [entry.name for entry in installed.list_installed()])
        raise UsageError(f"no task {task!r} is installed, and only installed tasks ship policies.{close}")
    if (file := entry.policy_file) is None:
        others = ", ".join(list_shipped()) or "none"
        raise ArtifactError(f"{task} ships no policy; train one: rlctl train {task}. Tasks that ship one: {others}")
    return file
