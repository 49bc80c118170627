"""What an evaluation is asked for: the arguments of `rlctl eval` as data. Imports nothing heavy."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from rlctl.options import Argument, Option

if TYPE_CHECKING:
    from rlctl.environments.spec import EnvChanges, EnvSpec


@dataclasses.dataclass(frozen=True)
class EvalOptions:
    """The arguments of `rlctl eval` that say what is played, and how."""

    run: Annotated[
        str | None,
        Argument("Run folder, policy file, task name, or latest.", completes="run", default_text="latest"),
    ] = None
    """The task, where `baseline` is given."""
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
    episodes: Annotated[int, Option("Episodes, each with its own seed.", min=1)] = 100
    seed: Annotated[int, Option("Seed of the list of episodes.", min=0)] = 0
    stage: Annotated[
        int | None, Option("Stage of the curriculum it was trained in.", min=1, default_text="the last")
    ] = None
    """From 1."""
    deterministic: Annotated[bool, Option("Sample actions instead of taking the mean.", (" /--stochastic",))] = True
    n_envs: Annotated[int | None, Option("Environments stepped side by side.", min=1)] = None
    limits: Annotated[
        Path | None, Option("Say what these safety limits (YAML) cost, and how often they act.", metavar="FILE")
    ] = None
    """Limits that the policy acts within; it is evaluated without them too."""
    env_timeout_s: Annotated[
        float, Option("How long a step or reset may take.", ("--env-timeout",), metavar="SECONDS", min=0.1)
    ] = 60.0


def _change_nothing() -> EnvChanges:
    from rlctl.environments.spec import UNCHANGED

    return UNCHANGED


@dataclasses.dataclass(frozen=True)
class EvalRequest(EvalOptions):
    """What to evaluate, on what, and how."""

    changes: EnvChanges = dataclasses.field(default_factory=_change_nothing)
    spec: EnvSpec | None = None
    """What to play in, where it is not what the policy, or for a baseline the task's recipe, was trained in."""
    measure_actions: bool = False
    """Whether to measure how much actions change, for which episodes are kept in memory."""
