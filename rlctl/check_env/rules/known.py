"""What rules ask of the evidence before they judge."""

from __future__ import annotations

from rlctl.check_env.evidence import Built, Evidence, Trajectory
from rlctl.check_env.finding import NotJudged


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
