"""Reads a PyBullet client that somebody else made: its bodies, their state, and which links touch.

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

Link = tuple[int, int]
"""Body id and link index; the base is link -1."""
Pair = tuple[Link, Link]


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
        """Whether its model declares limits."""
        return self.low < self.high and self.high - self.low < WIDEST_RANGE


@dataclasses.dataclass(frozen=True)
class Body:
    """A body of a world, as it was loaded."""

    id: int
    name: str
    links: tuple[str, ...]
    """The base first: link `i` of PyBullet is `links[i + 1]`."""
    joints: tuple[Joint, ...]
    is_free: bool
    """Whether its base is not fixed to the world."""


@dataclasses.dataclass(frozen=True)
class Dynamics:
    """What may be randomised of a body, per link."""

    masses: tuple[float, ...]
    frictions: tuple[float, ...]


@dataclasses.dataclass(frozen=True)
class State:
    """A body at one moment."""

    position: NDArray[np.float64]
    """Of the base [m]. Shape (3,)."""
    velocity: NDArray[np.float64]
    """Linear [m/s]. Shape (3,)."""
    angular: NDArray[np.float64]
    """Angular velocity [rad/s]. Shape (3,)."""
    joints: NDArray[np.float64]
    """Positions and speeds [rad, rad/s; m, m/s]. Shape (2, joints)."""

    @property
    def numbers(self) -> NDArray[np.float64]:
        """All of it. Shape (9 + 2 * joints,)."""
        return np.concatenate([self.position, self.velocity, self.angular, self.joints.ravel()])


@dataclasses.dataclass(frozen=True)
class World:
    """The bodies of one client."""

    client: int
    bodies: tuple[Body, ...]

    @property
    def key(self) -> tuple[Any, ...]:
        """Equal for worlds that are built alike."""
        return tuple((body.name, body.links) for body in self.bodies)

    def link_name(self, link: Link) -> str:
        """Return how to write a link: `tip of arm`."""
        for body in self.bodies:
            if body.id == link[0] and len(body.links) == 1:
                return body.name
            if body.id == link[0]:
                return f"{body.links[link[1] + 1] or 'base'} of {body.name}"
        return f"link {link[1]} of body {link[0]}"


def read_world(client: int) -> World:
    """Return what a client holds now."""
    p = bullet()
    ids = [p.getBodyUniqueId(i, physicsClientId=client) for i in range(p.getNumBodies(physicsClientId=client))]
    bodies = []
    for each in ids:
        with contextlib.suppress(p.error):  # a soft body, which has neither links nor a mass
            bodies.append(_body(client, each))
    bodies.sort(key=lambda body: (not body.joints, not body.is_free))
    return World(client, tuple(_number_names(bodies[:MOST_BODIES])))


def _body(client: int, body: int) -> Body:
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
    return Body(body, name or base or "a body", tuple(links), tuple(joints[:MOST_JOINTS]), mass > 0)


def _number_names(bodies: list[Body]) -> list[Body]:
    """Number bodies of one name; not by their ids, which are others at every reset of some environments."""
    counts: Counter[str] = Counter()
    numbered = []
    for body in bodies:
        counts[body.name] += 1
        count = counts[body.name]
        numbered.append(dataclasses.replace(body, name=f"{body.name} ({count})") if count > 1 else body)
    return numbered


def read_states(world: World) -> list[State]:
    """Return the state of each body."""
    p, client = bullet(), world.client
    states = []
    for body in world.bodies:
        position, _ = p.getBasePositionAndOrientation(body.id, physicsClientId=client)
        velocity, angular = p.getBaseVelocity(body.id, physicsClientId=client)
        joints = p.getJointStates(body.id, [j.index for j in body.joints], physicsClientId=client) or ()
        numbers = np.array([each[:2] for each in joints], np.float64).reshape(-1, 2).T
        states.append(State(np.array(position), np.array(velocity), np.array(angular), numbers))
    return states


def read_dynamics(client: int, body: Body) -> Dynamics:
    """Return masses and frictions."""
    p = bullet()
    infos = [p.getDynamicsInfo(body.id, i - 1, physicsClientId=client) for i in range(len(body.links))]
    return Dynamics(tuple(float(info[0]) for info in infos), tuple(float(info[1]) for info in infos))


def read_gravity(client: int) -> list[float]:
    """Return the gravity of a client [m/s^2]."""
    parameters = bullet().getPhysicsEngineParameters(physicsClientId=client)
    return [float(parameters[f"gravityAcceleration{axis}"]) for axis in "XYZ"]


def read_contacts(client: int) -> dict[Pair, float]:
    """Return the deepest distance per pair of links that touch [m]; below zero they are inside each other."""
    deepest: dict[Pair, float] = {}
    for contact in bullet().getContactPoints(physicsClientId=client) or ():
        pair = (contact[1], contact[3]), (contact[2], contact[4])
        deepest[pair] = min(deepest.get(pair, math.inf), contact[8])
    return deepest


def thickness(client: int, link: Link) -> float:
    """Return the smallest extent of the box around a link [m]."""
    low, high = bullet().getAABB(*link, physicsClientId=client)
    return float(min(b - a for a, b in zip(low, high, strict=True)))
