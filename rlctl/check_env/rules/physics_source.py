"""RL8: calls of PyBullet that are wrong as they are written."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from rlctl.check_env.evidence import Evidence
from rlctl.check_env.finding import Seen, Severity, rule
from rlctl.check_env.rules.known import result
from rlctl.check_env.rules.physics import watched
from rlctl.check_env.world_results import Place, Source, WorldBody, WorldLink

ERROR, WARNING, INFO = Severity.ERROR, Severity.WARNING, Severity.INFO

SHOWN = 4
FARTHEST_CENTRE = 1e-3
"""Closer than this to its frame a link's centre of mass may stand for it [m]."""


def _source(evidence: Evidence) -> Source:
    watched(evidence)  # without a world in use, calls in the source do not matter
    return result(evidence, Source, "source")


def _listed(places: Sequence[Place]) -> str:
    shown = [f"{Path(each.file).name}:{each.line} {each.call.rpartition('.')[2]}" for each in places[:SHOWN]]
    more = f" and {len(places) - SHOWN} more" if len(places) > SHOWN else ""
    return ", ".join(shown) + more


def _evidence(places: Sequence[Place]) -> dict[str, Any]:
    return {
        "file": places[0].file,
        "line": places[0].line,
        "places": [f"{Path(each.file).name}:{each.line}" for each in places],
        "functions": sorted({each.call.rpartition(".")[2] for each in places}),
    }


@rule(
    "RL808",
    "physicsClientId left out",
    ERROR,
    "Keep the id that connect returns and pass physicsClientId=self.client to every call, or make all calls through "
    "pybullet_utils.bullet_client.BulletClient, which adds it.",
    needs=("worlds", "source"),
)
def client_left_out(evidence: Evidence) -> Iterator[Seen]:
    """PyBullet is called without physicsClientId and takes client 0, whoever made it. Alone that works; the second
    instance in a process then moves the first one's world, and closing one ends the other."""
    places = _source(evidence).without_client
    if places:
        count = f"{len(places)} calls" if len(places) > 1 else "a call"
        yield Seen(f"{count} of PyBullet without physicsClientId: {_listed(places)}", _evidence(places))


@rule(
    "RL809",
    "centre of mass read as link position",
    INFO,
    "Read elements 4 and 5, the link's frame: getLinkState(body, link, computeForwardKinematics=True, ...)[4].",
    needs=("worlds", "source"),
)
def centre_of_mass(evidence: Evidence) -> Iterator[Seen]:
    """The first element of getLinkState is where the link's centre of mass is. Only where the model's links have it
    in their origin is that the position of the link; forward kinematics and real encoders mean the frame."""
    source = _source(evidence)
    places = source.centre_as_frame
    links = [
        (body, link)
        for world in watched(evidence)
        for body in world.bodies
        for index, link in enumerate(body.links[1:])
        if source.links is None or index in source.links
    ]
    if not places or not links:
        return
    body, link = max(links, key=_offset)
    if link.centre_offset > FARTHEST_CENTRE:
        yield Seen(
            f"getLinkState(...)[0] is the centre of mass, {1e3 * link.centre_offset:.0f} mm from the frame of "
            f"{link.name} of {body.name}: {_listed(places)}",
            {**_evidence(places), "link": link.name, "value": link.centre_offset, "expected": 0.0},
        )


def _offset(place: tuple[WorldBody, WorldLink]) -> float:
    return place[1].centre_offset


@rule(
    "RL810",
    "force applied at the origin",
    WARNING,
    "Pass the point in the world where the force acts (getBasePositionAndOrientation(...)[0] for the centre of mass), "
    "or [0, 0, 0] with LINK_FRAME.",
    needs=("worlds", "source"),
)
def force_at_origin(evidence: Evidence) -> Iterator[Seen]:
    """applyExternalForce with position (0, 0, 0) in WORLD_FRAME acts at the world's origin, not on the middle of the
    body: the farther the body goes, the more it is turned instead of pushed."""
    places = _source(evidence).force_at_origin
    if places:
        message = f"a force acts at the world's origin, not at the body: {_listed(places)}"
        yield Seen(message, _evidence(places))
