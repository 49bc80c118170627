"""Reads a PyBullet client that somebody else made: its bodies, their state, and who touches whom.

Nothing here changes a world. `getCollisionShapeData` is left alone: it crashes on some models.
"""

from __future__ import annotations

import contextlib
import dataclasses
import math
import sys
from collections import Counter
from typing import Any

import numpy as np
from numpy.typing import NDArray

MOST_BODIES = 20
"""So many bodies of a world are read, robots and free ones first."""
MOST_JOINTS = 60
WIDEST_RANGE = 1e3
"""Limits farther apart are none: some models write 1e16 for a joint without limits."""
BASE_KINDS = ("position", "angle", "linear velocity", "angular velocity")
AXES = {
    "position": ("x", "y", "z"),
    "angle": ("roll", "pitch", "yaw"),
    "linear velocity": ("vx", "vy", "vz"),
    "angular velocity": ("wx", "wy", "wz"),
}


def bullet() -> Any:
    """Return PyBullet, which the environment has loaded."""
    return sys.modules["pybullet"]


@dataclasses.dataclass(frozen=True)
class Joint:
    """A joint that moves, of one degree of freedom."""

    index: int
    name: str
    is_angle: bool
    low: float
    high: float

    @property
    def has_limits(self) -> bool:
        return self.low < self.high and self.high - self.low < WIDEST_RANGE


@dataclasses.dataclass(frozen=True)
class BodyModel:
    """A body of a world, as it was loaded."""

    id: int
    name: str
    links: tuple[str, ...]
    """The base first: link `i` of PyBullet is `links[i + 1]`."""
    joints: tuple[Joint, ...]
    is_free: bool


@dataclasses.dataclass(frozen=True)
class Column:
    """One number of a world's state."""

    body: int
    """Its place in the world's list of bodies."""
    kind: str
    name: str
    joint: Joint | None = None


@dataclasses.dataclass(frozen=True)
class Dynamics:
    """What may be randomised of a body, per link."""

    masses: tuple[float, ...]
    frictions: tuple[float, ...]


@dataclasses.dataclass(frozen=True)
class WorldModel:
    """The bodies of one client."""

    client: int
    bodies: tuple[BodyModel, ...]
    columns: tuple[Column, ...]

    @property
    def key(self) -> tuple[Any, ...]:
        """Equal for worlds that are built alike."""
        return tuple((body.name, body.links) for body in self.bodies)


def read_world(client: int) -> WorldModel:
    """Return what a client holds now."""
    p = bullet()
    ids = [p.getBodyUniqueId(i, physicsClientId=client) for i in range(p.getNumBodies(physicsClientId=client))]
    bodies = []
    for each in ids:
        with contextlib.suppress(p.error):  # a soft body, which has neither links nor a mass
            bodies.append(_body(client, each))
    bodies = _named_apart(sorted(bodies, key=lambda body: (not body.joints, not body.is_free))[:MOST_BODIES])
    columns = [column for place, body in enumerate(bodies) for column in _columns(place, body)]
    return WorldModel(client, tuple(bodies), tuple(columns))


def _body(client: int, body: int) -> BodyModel:
    p = bullet()
    base, name = (text.decode(errors="replace") for text in p.getBodyInfo(body, physicsClientId=client))
    infos = [
        p.getJointInfo(body, i, physicsClientId=client) for i in range(p.getNumJoints(body, physicsClientId=client))
    ]
    joints = [
        Joint(info[0], info[1].decode(errors="replace"), info[2] == p.JOINT_REVOLUTE, info[8], info[9])
        for info in infos
        if info[2] in (p.JOINT_REVOLUTE, p.JOINT_PRISMATIC)
    ]
    links = [base, *(info[12].decode(errors="replace") for info in infos)]
    mass = p.getDynamicsInfo(body, -1, physicsClientId=client)[0]
    return BodyModel(body, name or base or "a body", tuple(links), tuple(joints[:MOST_JOINTS]), mass > 0)


def _named_apart(bodies: list[BodyModel]) -> list[BodyModel]:
    """Number bodies of one name; not by their ids, which are others at every reset of some environments."""
    counts: Counter[str] = Counter()
    apart = []
    for body in bodies:
        counts[body.name] += 1
        count = counts[body.name]
        apart.append(dataclasses.replace(body, name=f"{body.name} ({count})") if count > 1 else body)
    return apart


def _columns(place: int, body: BodyModel) -> list[Column]:
    columns = [Column(place, kind, axis) for kind in BASE_KINDS for axis in AXES[kind]]
    for kind in ("joint position", "joint velocity"):
        columns += [Column(place, kind, joint.name, joint) for joint in body.joints]
    return columns


def read_state(world: WorldModel) -> NDArray[np.float64]:
    """Return the numbers of the world's columns. Shape (columns,)."""
    p, client = bullet(), world.client
    numbers: list[float] = []
    for body in world.bodies:
        position, turn = p.getBasePositionAndOrientation(body.id, physicsClientId=client)
        linear, angular = p.getBaseVelocity(body.id, physicsClientId=client)
        numbers += [*position, *p.getEulerFromQuaternion(turn), *linear, *angular]
        states = p.getJointStates(body.id, [j.index for j in body.joints], physicsClientId=client) or ()
        numbers += [state[0] for state in states]
        numbers += [state[1] for state in states]
    return np.array(numbers, np.float64)


def read_dynamics(client: int, body: BodyModel) -> Dynamics:
    """Return masses and frictions."""
    p = bullet()
    infos = [p.getDynamicsInfo(body.id, i - 1, physicsClientId=client) for i in range(len(body.links))]
    return Dynamics(tuple(float(info[0]) for info in infos), tuple(float(info[1]) for info in infos))


def read_gravity(client: int) -> list[float]:
    """Return the gravity of a client [m/s^2]."""
    parameters = bullet().getPhysicsEngineParameters(physicsClientId=client)
    return [float(parameters[f"gravityAcceleration{axis}"]) for axis in "XYZ"]


Pair = tuple[tuple[int, int], tuple[int, int]]
"""Two (body id, link index)."""


def read_contacts(client: int) -> dict[Pair, float]:
    """Return the deepest distance per pair of links that touch [m]; below zero they are inside each other."""
    deepest: dict[Pair, float] = {}
    for contact in bullet().getContactPoints(physicsClientId=client) or ():
        pair = (contact[1], contact[3]), (contact[2], contact[4])
        deepest[pair] = min(deepest.get(pair, math.inf), contact[8])
    return deepest


def thickness(client: int, link: tuple[int, int]) -> float:
    """Return the smallest extent of the box around a link [m]."""
    low, high = bullet().getAABB(*link, physicsClientId=client)
    return float(min(b - a for a, b in zip(low, high, strict=True)))
