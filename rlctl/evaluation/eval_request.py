"""The arguments of `rlctl eval` as data: what to evaluate, and the gates. Imports nothing heavy."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from rlctl.errors import UsageError
from rlctl.evaluation.sequential import EarlyGate, find_interval, find_least_episodes
from rlctl.options import Checkpoint, EnvTimeout, EpisodeSeed, Option, RunName

if TYPE_CHECKING:
    from rlctl.environments.spec import EnvChanges, EnvSpec


@dataclasses.dataclass(frozen=True)
class EvalOptions:
    """The arguments of `rlctl eval` that choose the policy and its episodes."""

    run: RunName = None
    task: Annotated[str | None, Option("Evaluate on this task instead of the one it was trained on.")] = None
    checkpoint: Checkpoint = "best"
    baseline: Annotated[
        str | None,
        Option(
            "Play on a TASK: zero, random, MODULE:FUNCTION, PATH.py:FUNCTION, or a policy server.",
            ("--policy",),
            metavar="POLICY",
        ),
    ] = None
    episodes: Annotated[int, Option("Episodes, each with its own seed.", min=1, max=1_000_000)] = 100
    seed: EpisodeSeed = 0
    stage: Annotated[int | None, Option("Stage of the policy's curriculum.", min=1, default_text="the last")] = None
    deterministic: Annotated[bool, Option("Sample actions instead of taking the mean.", ("/--stochastic",))] = True
    n_envs: Annotated[int | None, Option("Environments stepped in parallel.", min=1, max=10_000)] = None
    limits: Annotated[Path | None, Option("Compare with and without safety limits (YAML).", metavar="FILE")] = None
    record: Annotated[Path | None, Option("New folder for the episodes (.npz), for --demos.", metavar="FOLDER")] = None
    env_timeout_s: EnvTimeout = 60.0
    decide_early: Annotated[
        bool,
        Option("End when a 95 % interval that is valid at any time decides the success gate.", ("--decide-early",)),
    ] = False


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


Scores = tuple[float | None, tuple[float, float] | None, float]
"""Success rate and its interval, where the task reports success, and mean return."""


@dataclasses.dataclass(frozen=True)
class Gates:
    """The minimum scores that an evaluation must reach."""

    min_success: float | None = None
    min_success_lower: float | None = None
    min_return: float | None = None

    def __post_init__(self) -> None:
        for name in ("min_success", "min_success_lower"):
            rate = getattr(self, name)
            if rate is not None and not 0 <= rate <= 1:
                raise UsageError(f"--{name.replace('_', '-')} {rate:g}: {_explain_rate(rate)}")
        if self.min_return is not None and math.isnan(self.min_return):
            raise UsageError("--min-return nan: every return would pass; give a number")

    def check_possible(self, has_success: bool) -> None:
        """Raise `UsageError` for a gate on success where the environment does not report it."""
        if not has_success and (self.min_success is not None or self.min_success_lower is not None):
            raise UsageError(
                "--min-success: this task reports no success at the end of an episode (no is_success); use --min-return"
            )

    def check_reachable(self, episodes: int, *, decide_early: bool = False) -> None:
        """Raise `UsageError` for a lower bound that so many episodes cannot reach, even if all succeed."""
        lower = self.min_success_lower or 0.0
        highest = find_interval(episodes, episodes)[0] if decide_early else 0.025 ** (1 / episodes)  # Clopper, Pearson
        if lower > highest:
            needed = find_least_episodes(lower) if decide_early else _count_successes(lower)
            enough = f"; use --episodes {needed}" if needed else ""
            raise UsageError(f"--min-success-lower {lower:g}: {episodes} successes reach at most {highest:.3f}{enough}")

    def choose_early(self, has_limits: bool) -> EarlyGate:
        """Return the gate that may end an evaluation; raises `UsageError` where there is not exactly one."""
        rates = [rate for rate in (self.min_success, self.min_success_lower) if rate is not None]
        if len(rates) != 1 or has_limits or self.min_return is not None:
            raise UsageError(
                "--decide-early needs either --min-success or --min-success-lower, and cannot be combined with "
                "--min-return or --limits"
            )
        return EarlyGate(rates[0], on_lower_end=self.min_success is None)

    def list_missed(self, rate: float | None, interval: tuple[float, float] | None, mean_return: float) -> list[str]:
        """Return a phrase for each gate that these scores miss."""
        return list(self.find_missed(rate, interval, mean_return).values())

    def list_given(self) -> dict[str, str]:
        """Return name and text of each gate that is set: `--min-success-lower 0.9`."""
        values = {name: value for name, value in vars(self).items() if value is not None}
        return {name: f"--{name.replace('_', '-')} {value:g}" for name, value in values.items()}

    def find_missed(
        self, rate: float | None, interval: tuple[float, float] | None, mean_return: float
    ) -> dict[str, str]:
        """Return the names of the gates that these scores miss, each with a phrase."""
        missed = {}
        if self.min_success is not None and rate is not None and rate < self.min_success:
            missed["min_success"] = f"success rate {rate:.3f} is below {self.min_success:g}"
        lower = self.min_success_lower
        if lower is not None and interval is not None and interval[0] < lower:
            missed["min_success_lower"] = f"lower bound {interval[0]:.3f} of the success rate is below {lower:g}"
        if self.min_return is not None and mean_return < self.min_return:
            missed["min_return"] = f"mean return {mean_return:.3f} is below {self.min_return:g}"
        return missed


def _parse_rate(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        percent = text.strip().removesuffix("%")
        number = float(percent) if percent.strip().replace(".", "", 1).isdecimal() else math.nan
        raise UsageError(f"{text}: {_explain_rate(number)}") from None


def _explain_rate(rate: float) -> str:
    return f"a rate is between 0 and 1{f'; {rate:g} % is {rate / 100:g}' if 1 < rate <= 100 else ''}"


def _count_successes(lower: float) -> int:
    return math.ceil(math.log(0.025) / math.log(lower)) if lower < 1 else 0


NO_GATES = Gates()


def judge(command: str, missed: list[str], *, has_gate: bool) -> dict[str, Any]:
    """Return what the JSON of a command with gates says of them; `passed` is None without a gate."""
    return {
        "format": f"rlctl {command} 1",
        "exit_code": int(bool(missed)),
        "passed": not missed if has_gate else None,
        "gates_missed": missed,
    }


MinSuccess = Annotated[
    float | None, Option("Gate: exit 1 if the measured success rate is lower.", metavar="RATE", parse=_parse_rate)
]
MinSuccessLower = Annotated[
    float | None,
    Option("Gate: exit 1 if the 95 % interval begins below this rate.", metavar="RATE", parse=_parse_rate),
]
MinReturn = Annotated[float | None, Option("Gate: exit 1 below this mean return.", metavar="RETURN")]
