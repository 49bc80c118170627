"""What rules ask of the evidence before they judge."""

from __future__ import annotations

import re
from typing import TypeVar

from rlctl.check_env.evidence import Built, Evidence, Failure, Trajectory
from rlctl.check_env.finding import NotJudged

T = TypeVar("T")

NO_DISPLAY = re.compile(
    r"cannot connect to x server|could ?n.t connect to display|could not connect to display|no \$DISPLAY|"
    r"DISPLAY environment variable is missing|no available video device|cannot open display|"
    r"could not load the qt platform plugin|NoSuchDisplayException|failed to open display",
    re.IGNORECASE,
)
"""What X11, PyBullet, GLFW, pygame, Qt, Tk and pyglet print where there is no display."""


def built(evidence: Evidence) -> Built:
    """Return the environment that was built."""
    if evidence.built is None:
        raise NotJudged("no instance could be built")
    return evidence.built


def lived(evidence: Evidence) -> list[Trajectory]:
    """Return everything that was lived on the probe's instance and, alone, on others."""
    together = ("interleaved", "after close")  # what a neighbour does to an instance is other rules' matter
    trajectories = [each for each in evidence.trajectories if each.role not in together]
    if not any(each.steps or each.observations for each in trajectories):
        raise NotJudged("no episode was recorded")
    return trajectories


def one(evidence: Evidence, role: str) -> Trajectory:
    """Return the trajectory of a comparison."""
    found = evidence.role(role)
    if not found:
        raise NotJudged(evidence.skipped.get(role, f"the comparison {role!r} could not be made"))
    return found[0]


def result(evidence: Evidence, kind: type[T], study: str) -> T:
    """Return what a study found out; raises `NotJudged` with the reason where it did not come to its end."""
    found: T | None = evidence.results.get(kind.__name__)
    if found is None:
        raise NotJudged(why_missing(evidence, study))
    return found


def why_missing(evidence: Evidence, study: str) -> str:
    """Return why there is no result of a study."""
    if study in evidence.skipped:
        return evidence.skipped[study]
    failed = [failure for failure in evidence.failures if failure.phase == study]
    if failed:
        return f"the environment failed in {failed[0].call} while it was tried: {failed[0].error}"
    return f"the process ended before {study!r} could be tried"


def lost_display(failure: Failure) -> bool:
    """Say whether a process ended for want of a display."""
    return failure.kind == "died" and NO_DISPLAY.search(failure.details or "") is not None
