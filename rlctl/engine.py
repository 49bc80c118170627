"""`Engine`: which physics engine simulates a task, and how soft its contacts are. Imports nothing that takes time."""

from __future__ import annotations

import dataclasses
import math
from typing import Any, Literal, cast, get_args

from rlctl.errors import UsageError, did_you_mean

EngineName = Literal["pybullet", "mujoco"]
_NAMES = get_args(EngineName)
_TITLES = {"": "", "pybullet": "PyBullet", "mujoco": "MuJoCo"}
_DEFAULT_SOLREF = 0.02  # [s], of MuJoCo
FORMS = "pybullet, mujoco, or mujoco:SOLREF with 0 < SOLREF < 1 s"


@dataclasses.dataclass(frozen=True)
class Engine:
    """The physics engine of a task. Runs, policy files and episodes store it as the text that `read_engine` reads.

    `Engine()` is no choice, and false: the task's default is meant, which `EnvSpec.resolve` finds.
    """

    name: Literal["", "pybullet", "mujoco"] = ""
    solref: float | None = None
    """Time constant of MuJoCo's contacts [s], between 0 and 1; None: MuJoCo's default."""

    def __str__(self) -> str:
        return self.name if self.solref is None else f"{self.name}:{self.solref!r}"

    def __bool__(self) -> bool:
        return self.name != ""

    @property
    def title(self) -> str:
        """The name of the engine, for people; empty for no choice."""
        return _TITLES[self.name]

    @property
    def contact_time(self) -> float:
        """The time constant of MuJoCo's contacts [s]."""
        return _DEFAULT_SOLREF if self.solref is None else self.solref

    @classmethod
    def __get_pydantic_core_schema__(cls, source: Any, handler: Any) -> Any:
        """Let models contain an engine: as text in files, as itself in Python."""
        from pydantic_core import core_schema

        from_text = core_schema.no_info_after_validator_function(_read_stored, core_schema.str_schema())
        from_python = core_schema.no_info_wrap_validator_function(_keep, from_text)
        to_text = core_schema.plain_serializer_function_ser_schema(str, return_schema=core_schema.str_schema())
        return core_schema.json_or_python_schema(from_text, from_python, serialization=to_text)


PYBULLET = Engine("pybullet")
MUJOCO = Engine("mujoco")


def read_engine(text: str, option: str = "sim") -> Engine:
    """Return the engine that `pybullet`, `mujoco` or `mujoco:0.01` names.

    Raises `UsageError` for anything else, which names `option`, the source of the text.
    """
    name, colon, value = text.partition(":")
    if name not in _NAMES:
        raise UsageError(f"{option} {text!r}: no such engine.{did_you_mean(name, _NAMES)} Give {FORMS}")
    if not colon:
        return Engine(cast(EngineName, name))
    try:
        solref = float(value)
    except ValueError:
        solref = math.nan
    if name != "mujoco" or not 0 < solref < 1:
        raise UsageError(f"{option} {text!r}: give {FORMS}")
    return Engine("mujoco", solref)


def read_option(text: str) -> Engine:
    """Return the engine of `--sim`; raises `UsageError` for a text that names none."""
    return read_engine(text, "--sim")


def _read_stored(text: str) -> Engine:
    """Return the engine of a file; an empty text is no choice."""
    try:
        return read_engine(text) if text else Engine()
    except UsageError as error:
        raise ValueError(str(error).removeprefix("sim ")) from None


def _keep(value: Any, read: Any) -> Any:
    return value if isinstance(value, Engine) else read(value)
