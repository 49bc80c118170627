"""Finds model files: a path, or the name of a model of rlctl or of `pybullet_data`. Needs no PyBullet."""

import importlib
from pathlib import Path

from rlctl.errors import TaskError
from rlctl.task.pybullet.library import INSTALL_PYBULLET

MODELS = Path(__file__).parent / "models"
"""rlctl's own models."""


def find_model_file(file: str | Path) -> Path:
    """Return the path of a model file, which may be a name in `MODELS` or `pybullet_data`.

    The current folder is searched first, then rlctl's own models. Raises `TaskError` if the file is missing.
    """
    path, other_models = Path(file), _find_pybullet_models()
    folders = [Path(), MODELS, *([other_models] if other_models else [])]
    for folder in folders:
        if (folder / path).is_file():  # PyBullet crashes on a folder
            return folder / path
    own = ", ".join(sorted(model.name for model in MODELS.glob("*.urdf")))
    hint = f"for a file next to your module: Path(__file__).with_name({path.name!r})"
    if other_models is None:
        raise TaskError(f"model file {str(file)!r} not found. If it is one of PyBullet's: {INSTALL_PYBULLET}; {hint}")
    raise TaskError(
        f"model file {str(file)!r} not found: neither under {Path.cwd()}, nor among rlctl's models ({own}), "
        f"nor in pybullet_data; {hint}"
    )


def _find_pybullet_models() -> Path | None:
    try:
        return Path(importlib.import_module("pybullet_data").getDataPath())
    except ModuleNotFoundError:
        return None
