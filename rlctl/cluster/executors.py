"""`--on`: where the trainings of a group and the cells of a robustness map run."""

import functools
import os
from pathlib import Path

from rlctl.cluster.work import read_settings
from rlctl.errors import UsageError
from rlctl.evaluation.vary import PlayCells
from rlctl.launching.trainings import MakeTrainings, make_local_trainings

VARIABLE = "RLCTL_ON"  # environment variable that replaces the default, `local`
_NOT_ON_SLURM = {
    "tune": "each trial depends on the results of earlier ones",
    "eval": "a cell takes seconds, less than a job waits in SLURM's queue",
}


def choose_executor(
    on: str | None, cluster: Path | None = None, *, detach: bool = False, verb: str = "train"
) -> MakeTrainings:
    """Return the factory of trainings for `--on`; raises `UsageError`, or `RecipeError` for `cluster.yaml`."""
    kind, address = _parse(on, verb)
    if detach and kind != "slurm":
        raise UsageError(f"--detach is for --on slurm: trainings on {kind} end with this process")
    if kind == "local":
        return make_local_trainings
    if kind == "slurm":
        from rlctl.cluster.slurm import SlurmTrainings

        return functools.partial(SlurmTrainings, settings=read_settings(cluster), detach=detach)
    from rlctl.cluster.ray_trainings import RayTrainings

    return functools.partial(RayTrainings, address, settings=read_settings(cluster))


def choose_cell_player(on: str | None, cluster: Path | None = None) -> PlayCells | None:
    """Return the player of a robustness map's cells, None for this machine; same errors as `choose_executor`."""
    kind, address = _parse(on, "eval")
    if kind == "local":
        return None
    from rlctl.cluster.ray_cells import RayCells

    settings = read_settings(cluster)
    return lambda policy, request, specs: RayCells(address, settings, policy, request).play(specs)


def _parse(on: str | None, verb: str) -> tuple[str, str]:
    on = on or os.environ.get(VARIABLE) or "local"
    kind, _, address = on.partition(":")
    if on == "slurm" and verb in _NOT_ON_SLURM:
        raise UsageError(f"{verb} --on slurm: {_NOT_ON_SLURM[verb]}; give ray or local")
    if on in ("local", "slurm", "ray") or (kind == "ray" and address):
        return kind, address
    raise UsageError(f"--on {on}: give local, slurm, ray, ray:auto or ray:HOST:PORT")
