"""Policies that ship with a plugin, `policies/<task>.safetensors` beside its module: where they are from, what they do.

A shipped policy is the actor alone, as `rlctl export RUN --policy FILE` writes it.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pydantic

from rlctl.environments import installed
from rlctl.errors import ArtifactError, UsageError, did_you_mean

PRETRAINED = "pretrained"
"""The word for a task's shipped policy where a command or a function takes `checkpoint`."""

Interval = tuple[float, float]
"""Lower and upper bound of a 95 % interval."""


class MeasuredScore(pydantic.BaseModel, extra="forbid"):
    """What a policy, or a baseline, scored over a list of episodes that its training has not seen."""

    episodes: int
    seed: int
    """Of the list of episodes: `rlctl eval --episodes N --seed SEED` plays the same."""
    mean_return: float
    return_interval: Interval
    """Of the mean."""
    success: float | None
    success_interval: Interval | None
    mean_length: float
    """[steps]"""
    ended_early: float | None
    """Part of the episodes that ended before the time limit, by a fall or else; None where none is known."""
    action_change: float
    """Mean of |action - action before|, over elements and steps; 0 for discrete actions."""


class Provenance(pydantic.BaseModel, extra="forbid"):
    """Where an exported policy is from, and what was measured of it."""

    run: str
    """Name of the run, with its task."""
    origin: dict[str, str] = {}
    """Distribution and version of the task that it was measured on."""
    source_sha256: str | None = None
    """Of that task's file."""
    git_commit: str | None = None
    """Of the folder in which it was trained."""
    recipe: dict[str, Any]
    """The resolved recipe."""
    score: MeasuredScore
    baselines: dict[str, MeasuredScore] = {}
    """`zero` and `random`, on the same episodes."""


def list_shipped() -> list[str]:
    """Return the installed tasks that ship a policy."""
    return [
        entry.name for entry in installed.list_installed() if entry.problem is None and entry.policy_file is not None
    ]


def find_shipped_policy(task: str | None) -> Path:
    """Return the file of a task's shipped policy; raises `UsageError` for no task, `ArtifactError` for no policy."""
    if task is None:
        raise UsageError(f"--pretrained: give a task that ships a policy: {', '.join(list_shipped()) or 'none does'}")
    entry = installed.find(task)
    if entry is None:
        names = [entry.name for entry in installed.list_installed()]
        raise UsageError(
            f"no task {task!r} is installed, and only installed tasks ship policies.{did_you_mean(task, names)}"
        )
    if (file := entry.policy_file) is None:
        others = ", ".join(list_shipped()) or "none does"
        raise ArtifactError(f"{task} ships no policy; train one: rlctl train {task}. Tasks that ship one: {others}")
    return file
