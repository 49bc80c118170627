"""The arguments of `rlctl eval` as data. Imports nothing heavy."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from rlctl.options import Checkpoint, EnvTimeout, EpisodeSeed, Option, RunName

if TYPE_CHECKING:
    from rlctl.environments.spec import EnvChanges, EnvSpec


@dataclasses.dataclass(frozen=True)
class EvalOptions:
    """The arguments of `rlctl eval` that choose the policy and its episodes."""

    run: RunName = None
    """With `baseline`, the name of a task."""
    task: Annotated[str | None, Option("Evaluate on this task instead of the one it was trained on.")] = None
    checkpoint: Checkpoint = "best"
    baseline: Annotated[
        str | None,
        Option(
            "Play on a TASK: zero, random, MODULE:FUNCTION, PATH.py:FUNCTION, or a policy server.",
            ("--policy",),
            metavar="zero|random|FUNCTION|ws://HOST:PORT",
        ),
    ] = None
    """What to play instead of a trained policy."""
    episodes: Annotated[int, Option("Episodes, each with its own seed.", min=1, max=1_000_000)] = 100
    seed: EpisodeSeed = 0
    stage: Annotated[int | None, Option("Stage of the policy's curriculum.", min=1, default_text="the last")] = None
    """From 1."""
    deterministic: Annotated[bool, Option("Sample actions instead of taking the mean.", ("/--stochastic",))] = True
    n_envs: Annotated[int | None, Option("Environments stepped in parallel.", min=1)] = None
    limits: Annotated[Path | None, Option("Compare with and without these safety limits (YAML).", metavar="FILE")] = (
        None
    )
    """Limits on the policy's actions; it is also evaluated without them."""
    record: Annotated[
        Path | None, Option("Write the episodes (.npz) into this new folder; --demos reads it.", metavar="FOLDER")
    ] = None
    env_timeout_s: EnvTimeout = 60.0


def _change_nothing() -> EnvChanges:
    from rlctl.environments.spec import UNCHANGED

    return UNCHANGED


@dataclasses.dataclass(frozen=True)
class EvalRequest(EvalOptions):
    """What to evaluate, on what, and how."""

    changes: EnvChanges = dataclasses.field(default_factory=_change_nothing)
    spec: EnvSpec | None = None
    """Default: the environment of the policy's training, or for a baseline of the task's recipe."""
    measure_actions: bool = False
    """Whether to measure how much actions change; all episodes are then kept in memory."""
