"""The files of a policy of another project, as options of commands. Imports nothing heavy."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Annotated

from rlctl.options import Option


@dataclasses.dataclass(frozen=True)
class ForeignFiles:
    """What belongs to a policy of another project besides its network."""

    deploy: Annotated[
        Path | None, Option("How a policy of another project is deployed: that project's YAML.", metavar="FILE")
    ] = None
    model: Annotated[str | None, Option("The robot of a policy of another project: URDF or MJCF.", metavar="ROBOT")] = (
        None
    )
    terrain: Annotated[str | None, Option("Its ground: URDF or MJCF.", metavar="FILE", default_text="flat")] = None
    motion: Annotated[
        Path | None, Option("The clip that a policy of another project follows: .csv or .npz.", metavar="FILE")
    ] = None
    motion_rate: Annotated[
        float | None, Option("Frames per second of that clip, if the file does not say.", metavar="HZ", min=1e-3)
    ] = None

    @property
    def is_given(self) -> bool:
        """Whether any of them is given."""
        return self != NO_FILES


NO_FILES = ForeignFiles()
