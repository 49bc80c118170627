"""The arguments of `rlctl train` as data. Imports nothing heavy."""

import dataclasses
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, ClassVar, Self

from rlctl.options import Config, EnvTimeout, Option, OptionalTask, RunsFolder


@dataclasses.dataclass(frozen=True)
class TrainRequest:
    """The arguments of `rlctl train`; either `task` or `resume` is given."""

    __pydantic_config__: ClassVar[dict[str, Any]] = {"extra": "forbid", "strict": True}

    task: OptionalTask = None
    resume: Annotated[
        str | None,
        Option("Resume a run or a group: its folder, a task's name, or latest.", metavar="RUN", completes="run"),
    ] = None
    initial_policy: Annotated[
        str | None,
        Option(
            "Begin with a policy: a run, a .safetensors file, or the name of a task that ships one.",
            ("--from",),
            metavar="POLICY",
            completes="run",
        ),
    ] = None
    demos: Annotated[
        str | None,
        Option("Clone demonstrations first: episodes (.npz), or a Minari or LeRobot dataset.", metavar="PATH"),
    ] = None
    config: Config = None
    settings: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    """Keys of the recipe and their values, nested as in a recipe; they override `config`."""
    device: Annotated[str, Option("cpu, cuda, or auto: the faster one for this network.")] = "cpu"
    record: Annotated[int, Option("Write the last N evaluation episodes as .rrd.", metavar="N", min=0)] = 0
    check: Annotated[bool, Option("Train without checking the environment first.", ("/--no-check",))] = True
    force: Annotated[bool, Option("Resume a run even if its task has changed.", ("--force",))] = False
    env_timeout_s: EnvTimeout = 60.0
    root: RunsFolder = Path("runs")

    def to_resume(self, run: Path, settings: Mapping[str, Any]) -> Self:
        """Return the request that resumes a run of this one."""
        return dataclasses.replace(
            self, task=None, config=None, initial_policy=None, demos=None, resume=str(run), settings=settings
        )

    def to_json(self) -> dict[str, Any]:
        """Return the request as JSON data."""
        from pydantic_core import to_jsonable_python

        return dict(to_jsonable_python(self))

    @classmethod
    def from_json(cls, content: Any) -> "TrainRequest":
        """Return the request of `to_json`; raises `ValueError` for invalid data."""
        import pydantic

        adapter: pydantic.TypeAdapter[TrainRequest] = pydantic.TypeAdapter(cls)
        return adapter.validate_json(json.dumps(content))  # JSON, where a path is a string
