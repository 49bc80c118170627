"""`cluster.yaml`: what a run gets on a cluster, and how a node is prepared. Typed, every key checked."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pydantic
from pydantic import Field

from rlctl.errors import RecipeError
from rlctl.storage import validation, yaml_text

FILE = Path("cluster.yaml")
"""Read where no other file is given, if it is there."""


class ClusterSettings(pydantic.BaseModel, extra="forbid"):
    """The content of `cluster.yaml`."""

    cpus: int = Field(2, ge=1)
    """Cores of each run."""
    retries: int = Field(3, ge=0, le=1000)
    """How often a run is started again after its machine was lost, or after it was preempted."""
    lease_s: float = Field(60.0, gt=0)
    """A run on Ray ends itself after so long without an answer from the driver [s]."""
    sbatch: list[str] = []
    """Options that are passed on to `sbatch`, such as `--time=04:00:00`."""
    setup: list[str] = []
    """Shell commands that a SLURM node runs first, such as `source .venv/bin/activate`."""


def read_settings(path: Path | None) -> ClusterSettings:
    """Read a file, by default `cluster.yaml` if there is one; raises `RecipeError` for what is wrong in it."""
    if path is None and not FILE.is_file():
        return ClusterSettings()
    path = path or FILE
    text = yaml_text.read_text(path)
    content = yaml_text.load(text, str(path))
    try:
        return ClusterSettings.model_validate({} if content is None else content)
    except pydantic.ValidationError as error:
        schema = ClusterSettings.model_json_schema()

        def explain(problem: Any, place: validation.Place) -> str:
            key = ".".join(str(part) for part in place)
            message = validation.explain(problem, place, schema, content, key=key, unit="")
            return f"{path}:{yaml_text.find_line(text, place)}: {message}"

        raise RecipeError(validation.explain_all(error, schema, explain)) from None
