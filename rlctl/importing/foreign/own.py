"""A deployment as rlctl itself describes it, in YAML: for projects whose scripts contain what theirs need."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from rlctl.importing.foreign.draft import Draft
from rlctl.importing.foreign.network import ForeignNetwork
from rlctl.task.mujoco.robot import Robot

TITLE = "deployment of rlctl"


def matches(content: Mapping[str, Any]) -> bool:
    """Return whether a file has this form."""
    observations = content.get("observations")
    return isinstance(observations, list) and all(isinstance(part, dict) and "kind" in part for part in observations)


def read(content: Mapping[str, Any], source: str, robot: Robot, network: ForeignNetwork) -> Draft:
    """Return what the file says."""
    return Draft(source, dict(content))
