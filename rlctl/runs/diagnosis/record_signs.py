"""Signs in where the time went, and in how a run ended. Functions as in `signs`."""

from __future__ import annotations

import numpy as np

from rlctl.runs.diagnosis.history import LEAST_ROWS, Curve, History


def learner_slow(run: History) -> str | None:
    """Most of the time goes into updates."""
    playing, fps = run.curve("playing"), run.curve("fps")
    if len(playing) < LEAST_ROWS or (share := float(np.median(playing.values))) > 0.25:
        return None
    return (
        f"the environments are waited for {share:.0%} of the time, updates take the rest; {_median(fps):,.0f} steps/s"
    )


def environments_slow(run: History) -> str | None:
    """Most of the time goes into slow environments, with the policy that acts in them."""
    playing, fps = run.curve("playing"), run.curve("fps")
    if len(playing) < LEAST_ROWS or (share := float(np.median(playing.values))) < 0.8 or _median(fps) > 300:
        return None
    return f"the environments are waited for {share:.0%} of the time; {_median(fps):,.0f} steps/s"


def _median(curve: Curve) -> float:
    return float(np.median(curve.values)) if len(curve) else 0.0


def observations_outside(run: History) -> str | None:
    """Observations were outside their space."""
    count = run.status.get("observations_outside")
    return f"{count:,} observations were outside their space" if isinstance(count, int) and count else None


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
