"""The arguments of `rlctl eval` as data. Imports nothing heavy."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from rlctl.options import Argument, Option

if TYPE_CHECKING:
    from rlctl.environments.spec import EnvChanges, EnvSpec


@dataclasses.dataclass(frozen=True)
class EvalOptions:
    """The arguments of `rlctl eval` that choose the policy and its episodes."""

    run: Annotated[
        str | None,
        Argument("Run folder, policy file, task name, or latest.", completes="run", default_text="latest"),
    ] = None
    """With `baseline`, the name of a task."""
    task: Annotated[str | None, Option("Evaluate on this task instead of the one it was trained on.")] = None
    checkpoint: Annotated[str, Option("Which policy of the run.", metavar="best|last|STEP")] = "best"
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
    seed: Annotated[int, Option("Seed of the list of episodes.", min=0)] = 0
    stage: Annotated[int | None, Option("Stage of the policy's curriculum.", min=1, default_text="the last")] = None
    """From 1."""
    deterministic: Annotated[bool, Option("Sample actions instead of taking the mean.", ("/--stochastic",))] = True
    n_envs: Annotated[int | None, Option("Environments stepped in parallel.", min=1)] = None
    limits: Annotated[Path | None, Option("Compare with and without these safety limits (YAML).", metavar="FILE")] = (
        None
    )
    """Limits on the policy's actions; it is also evaluated without them."""
    env_timeout_s: Annotated[
        float, Option("Time limit of a step or reset.", ("--env-timeout",), metavar="SECONDS", min=0.1, max=1e6)
    ] = 60.0


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
