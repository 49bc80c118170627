"""`--on`: which executor runs the trainings of a group."""

from __future__ import annotations

import functools
import os
from pathlib import Path

from rlctl.cluster.settings import read_settings
from rlctl.errors import UsageError
from rlctl.training.trainings import MakeTrainings, make_local_trainings

VARIABLE = "RLCTL_ON"
"""Environment variable that replaces the default, `local`."""


def choose_executor(
    on: str | None, cluster: Path | None = None, *, detach: bool = False, verb: str = "train"
) -> MakeTrainings:
    """Return the factory of trainings for `local`, `slurm`, `ray`, `ray:auto` or `ray:HOST:PORT`.

    Raises `UsageError` for any other value, and `RecipeError` for an invalid `cluster.yaml`.
    """
    on = on or os.environ.get(VARIABLE) or "local"
    kind, _, address = on.partition(":")
    if detach and kind != "slurm":
        raise UsageError(f"--detach is for --on slurm: trainings on {kind} end with this process")
    if on == "local":
        return make_local_trainings
    if on == "slurm" and verb == "tune":
        raise UsageError("tune --on slurm: each trial depends on the results of earlier ones; give ray or local")
    if on == "slurm":
        from rlctl.cluster.slurm import SlurmTrainings

        return functools.partial(SlurmTrainings, settings=read_settings(cluster), detach=detach)
    if kind == "ray" and (on == "ray" or address):
        from rlctl.cluster.ray_trainings import RayTrainings

        return functools.partial(RayTrainings, address, settings=read_settings(cluster))
    raise UsageError(f"--on {on}: give local, slurm, ray, ray:auto or ray:HOST:PORT")
