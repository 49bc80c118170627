"""Command-line options of the fields of a request, declared once, next to the field.

A request is a dataclass with the arguments of a command. The command line fills it (`rlctl.arguments.command`),
Python passes it, a group stores it and a child process receives it.
"""

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, Literal

from rlctl.engine import Engine, read_option


@dataclasses.dataclass(frozen=True)
class Option:
    """An option of the command line, as metadata of a field: `Annotated[int, Option("How many episodes.", min=1)]`."""

    help: str
    flags: tuple[str, ...] = ()
    """`("--from",)`; empty: the field's name. `("/--no-check",)` is a flag that makes the field False."""
    metavar: str | None = None
    min: float | None = None
    max: float | None = None
    completes: Literal["task", "run", "algorithm"] | None = None  # what the shell offers after TAB
    default_text: str | None = None  # the default in help, if it differs from the field's own
    parse: Callable[[str], Any] | None = None  # raises `UsageError` for a text that is no value


@dataclasses.dataclass(frozen=True)
class Argument(Option):
    """A positional argument."""


KEY_VARIABLE = "RLCTL_API_KEY"
"""The environment variable with the key of a policy server: the server demands it, clients send it."""

TASK_FORMS = (
    "Installed name, package.module:Class or path/to/file.py:Class (or a function), Gymnasium id, or package:Id."
)

TaskName = Annotated[str, Argument(TASK_FORMS, metavar="TASK", completes="task")]
OptionalTask = Annotated[str | None, Argument(TASK_FORMS, metavar="TASK", completes="task")]
RunName = Annotated[
    str | None, Argument("Run folder, policy file, task name, or latest.", completes="run", default_text="latest")
]
Checkpoint = Annotated[str, Option("The policy of the run to use.", metavar="best|last|STEP")]
Pretrained = Annotated[bool, Option("The policy that ships with the task.", ("--pretrained",))]
Settings = Annotated[
    list[str], Option("Set a key, e.g. task.tolerance=0.02, randomize=true.", ("--set",), metavar="KEY=VALUE")
]
SimOption = Annotated[
    Engine | None,
    Option(
        "Physics engine of a task; default: that of the policy or recipe, else PyBullet if it is installed.",
        metavar="pybullet|mujoco[:SOLREF]",
        parse=read_option,
    ),
]
EpisodeSeed = Annotated[int, Option("Seed of the list of episodes.", min=0)]
Json = Annotated[str | None, Option("Also write the result as JSON; - writes only JSON, to stdout.", metavar="FILE")]
Junit = Annotated[
    Path | None,
    Option("Also write the result as JUnit XML, whose failures CI services list.", ("--junit",), metavar="FILE"),
]
PictureFile = Annotated[
    Path | None, Option("Also draw the maps: FILE.png, .svg or .pdf.", ("--picture",), metavar="FILE")
]
Yes = Annotated[bool, Option("Do not ask.", ("--yes",))]
Config = Annotated[Path | None, Option("Recipe that overrides the task's own, or presets/NAME.", metavar="FILE")]
RunsFolder = Annotated[Path, Option("Folder for the folders of runs.", ("--output", "-o"), metavar="FOLDER")]
EnvTimeout = Annotated[
    float, Option("How long a step or reset may take.", ("--env-timeout",), metavar="SECONDS", min=0.1, max=1e6)
]
On = Annotated[
    str | None,
    Option("Where to compute: local, slurm, ray, ray:auto, ray:HOST:PORT.", metavar="WHERE", default_text="local"),
]
Cluster = Annotated[
    Path | None, Option("Settings for slurm and ray.", ("--cluster",), metavar="FILE", default_text="cluster.yaml")
]
Jobs = Annotated[int | None, Option("How many train at the same time.", min=1, default_text="half as many as cores")]
