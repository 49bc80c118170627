"""Finds model files: a path, or the name of a model of rlctl or of `pybullet_data`. Needs no PyBullet."""

import difflib
import importlib
from pathlib import Path

from rlctl.errors import TaskError
from rlctl.task.pybullet.library import INSTALL_PYBULLET

MODELS = Path(__file__).parent / "models"
"""rlctl's own models."""
_SUFFIXES = (".urdf", ".xml")
_MOST_NAMES = 4


def find_model_file(file: str | Path) -> Path:
    """Return the path of a model file, which may be a name in `MODELS` or `pybullet_data`.

    The current folder is searched first, then rlctl's own models. Raises `TaskError` if the file is missing.
    """
    path, other_models = Path(file), _find_pybullet_models()
    folders = [Path(), MODELS, *([other_models] if other_models else [])]
    for folder in folders:
        if (folder / path).is_file():  # PyBullet crashes on a folder
            return folder / path
    if path.is_absolute() or (path.parent != Path() and path.parent.is_dir()):
        raise TaskError(explain_missing(path))
    own = ", ".join(sorted(model.name for model in MODELS.glob("*.urdf")))
    hint = f"for a file next to your module: Path(__file__).with_name({path.name!r})"
    if other_models is None:
        raise TaskError(
            f"model file {str(file)!r} not found, and rlctl's models are {own}. If it is one of PyBullet's: "
            f"{INSTALL_PYBULLET}; {hint}"
        )
    raise TaskError(
        f"model file {str(file)!r} not found: neither under {Path.cwd()}, nor among rlctl's models ({own}), "
        f"nor in pybullet_data; {hint}"
    )


def explain_missing(path: Path) -> str:
    """Return the message for a missing file in a folder: the closest model files there."""
    if not path.parent.is_dir():
        return f"model file {str(path)!r} not found: there is no folder {path.parent}"
    names = sorted(file.name for file in path.parent.iterdir() if file.suffix in _SUFFIXES)
    close = difflib.get_close_matches(path.name, names, n=_MOST_NAMES, cutoff=0.0)
    listed = ", ".join(close) or f"no file that ends in {' or '.join(_SUFFIXES)}"
    return f"model file {str(path)!r} not found. That folder has: {listed}"


def _find_pybullet_models() -> Path | None:
    try:
        return Path(importlib.import_module("pybullet_data").getDataPath())
    except ModuleNotFoundError:
        return None
