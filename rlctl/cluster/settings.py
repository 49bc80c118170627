"""`cluster.yaml`: the resources of a run on a cluster and the preparation of a node; every key is checked."""

from pathlib import Path
from typing import Any

import pydantic
from pydantic import Field

from rlctl.errors import RecipeError
from rlctl.storage import validation, yaml_text

FILE = Path("cluster.yaml")  # read if it exists and no other file is given


class ClusterSettings(pydantic.BaseModel, extra="forbid"):
    """The content of `cluster.yaml`."""

    cpus: int = Field(2, ge=1)  # cores of each run
    retries: int = Field(3, ge=0, le=1000)  # how often a run is retried after its machine was lost or it was preempted
    lease_s: float = Field(60.0, gt=0)
    """A run ends itself if the driver has not answered for this time [s]; not with `--detach`."""
    sbatch: list[str] = []  # options for `sbatch`, such as `--time=04:00:00`
    setup: list[str] = []  # shell commands that a SLURM node runs first, such as `source .venv/bin/activate`


def read_settings(path: Path | None) -> ClusterSettings:
    """Read a file, by default `cluster.yaml` if it exists; raises `RecipeError` if it is invalid."""
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
