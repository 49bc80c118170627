"""`--on`: which executor runs the trainings of a group."""

from __future__ import annotations

import functools
import os
from pathlib import Path

from rlctl.cluster.settings import ClusterSettings, read_settings
from rlctl.errors import UsageError
from rlctl.training.trainings import MakeTrainings, Trainings, make_local_trainings

VARIABLE = "RLCTL_ON"
"""The environment variable with another default than `local`."""


def choose_executor(
    on: str | None, cluster: Path | None = None, *, detach: bool = False, verb: str = "train"
) -> MakeTrainings:
    """Return what makes the trainings of `local`, `slurm`, `ray`, `ray:auto` or `ray:HOST:PORT`.

    Raises `UsageError` for another word, and `RecipeError` for a `cluster.yaml` that is wrong.
    """
    on = on or os.environ.get(VARIABLE) or "local"
    kind, _, address = on.partition(":")
    if detach and kind != "slurm":
        raise UsageError(f"--detach is for --on slurm: trainings on {kind} end with this process")
    if on == "local":
        return make_local_trainings
    if on == "slurm" and verb == "tune":
        raise UsageError("tune --on slurm: trials follow from each other, one at a time; give ray or local")
    if on == "slurm":
        return functools.partial(_make_slurm_trainings, settings=read_settings(cluster), detach=detach)
    if kind == "ray" and (on == "ray" or address):
        return functools.partial(_make_ray_trainings, address, settings=read_settings(cluster))
    raise UsageError(f"--on {on}: give local, slurm, ray, ray:auto or ray:HOST:PORT")


def _make_slurm_trainings(
    folder: Path, waiting: int, jobs: int | None, *, settings: ClusterSettings, detach: bool
) -> Trainings:
    from rlctl.cluster.slurm import SlurmTrainings

    return SlurmTrainings(folder, waiting, settings, detach=detach)


def _make_ray_trainings(
    address: str, folder: Path, waiting: int, jobs: int | None, *, settings: ClusterSettings
) -> Trainings:
    from rlctl.cluster.ray_trainings import RayTrainings

    return RayTrainings(address, folder, waiting, jobs, settings)
