"""An `EnvSpec` in a file that somebody may have sent: whatever the file says, its task is named by that file."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Annotated, Any

from pydantic import AfterValidator, PlainSerializer

from rlctl.environments.named_task import EPISODE, POLICY
from rlctl.environments.spec import EnvSpec


def _name_by(kind: str) -> Callable[[EnvSpec], EnvSpec]:
    return lambda spec: dataclasses.replace(spec, named_by=kind)


def _dump(spec: EnvSpec) -> dict[str, Any]:
    content = dataclasses.asdict(spec)
    del content["named_by"]
    return content


PolicySpec = Annotated[EnvSpec, AfterValidator(_name_by(POLICY)), PlainSerializer(_dump)]
EpisodeSpec = Annotated[EnvSpec, AfterValidator(_name_by(EPISODE)), PlainSerializer(_dump)]
