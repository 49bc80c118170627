"""Signs in the use of time and in the end of a run. Functions as in `signs`."""

import dataclasses

import numpy as np

from rlctl.output import format_count
from rlctl.runs.diagnosis.history import LEAST_ROWS, Curve, History


def learner_slow(run: History) -> str | None:
    """Updates take most of the time."""
    shares = _read_shares(run)
    return shares.describe() if shares and shares.learner >= 0.75 else None


def policy_slow(run: History) -> str | None:
    """Choosing actions takes more time than stepping the environments."""
    shares = _read_shares(run)
    return shares.describe() if shares and shares.policy > max(0.4, shares.environments) else None


def environments_slow(run: History) -> str | None:
    """Slow environments take most of the time."""
    shares = _read_shares(run)
    if shares is None or shares.environments < 0.5 or shares.learner > 0.2 or shares.steps_per_s > 300:
        return None
    return shares.describe()


@dataclasses.dataclass(frozen=True)
class _Shares:
    """Fractions of the learner's time; environments that step during updates do not count."""

    environments: float
    policy: float
    learner: float
    steps_per_s: float

    def describe(self) -> str:
        """Return the shares as text."""
        return (
            f"waiting for environments takes {self.environments:.0%} of the time, for the policy that acts in them "
            f"{self.policy:.0%}, updates the rest; {self.steps_per_s:,.0f} steps/s"
        )


def _read_shares(run: History) -> _Shares | None:
    playing = run.curve("playing")
    if len(playing) < LEAST_ROWS:
        return None
    waited, acting = _median(playing), _median(run.curve("acting"))
    return _Shares(waited * (1 - acting), waited * acting, 1 - waited, _median(run.curve("fps")))


def _median(curve: Curve) -> float:
    return float(np.median(curve.values)) if len(curve) else 0.0


def observations_outside(run: History) -> str | None:
    """Observations were outside their space."""
    count = run.status.get("observations_outside")
    return f"outside their space: {format_count(count, 'observation')}" if isinstance(count, int) and count else None


def diverged(run: History) -> str | None:
    """Losses or weights were not finite."""
    return str(run.status.get("error")).partition("\n")[0] if run.status.get("status") == "diverged" else None


def model_file_missing(run: History) -> str | None:
    """The run failed because a model could not be loaded."""
    error = str(run.status.get("error") or "")
    names = (".urdf", ".xml", ".sdf", ".mjcf", ".obj", ".stl")
    if run.status.get("status") != "failed" or not any(name in error.lower() for name in names):
        return None
    return error.partition("\n")[0]


def last_stage_never_begun(run: History) -> str | None:
    """The training is over, and ended before the last stage of its curriculum."""
    reached = run.curve("stage").values
    if run.status.get("status") != "finished" or not len(reached) or reached[-1] >= run.stage_count:
        return None
    return f"trained in stage {reached[-1]:.0f} of {run.stage_count} to the end"


def stage_never_succeeds(run: History) -> str | None:
    """A stage before the last took a large part of all steps, and none of its episodes succeeded."""
    reached, success = run.curve("stage"), run.curve("success")
    if not len(reached) or not len(success) or reached.values[-1] >= run.stage_count:
        return None
    stage, total = reached.values[-1], run.recipe.get("total_timesteps")
    began = float(reached.steps[reached.values == stage][0])
    spent = float(reached.steps[-1]) - began
    if not isinstance(total, int | float) or spent < 0.4 * total or success.values[success.steps >= began].any():
        return None
    return f"no episode succeeded in stage {stage:.0f} of {run.stage_count}, which has taken {spent:,.0f} steps"
