"""Reads the bodies of PyBullet clients in this process, whoever made them, without changing the simulation.

`computeForwardKinematics` is never used: it also changes what the environment reads afterwards with getLinkState, and
the directions of its forces in link frames. Link poses are computed from the joints instead.
"""

import dataclasses
import itertools
import math
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlctl.environments.bullet_clients import find_clients
from rlctl.task.pybullet.library import pybullet
from rlctl.task.rotations import from_axis, invert, multiply, normalize, rotate

Array = NDArray[np.float64]
BulletPose = tuple[tuple[float, ...], tuple[float, ...]]  # position [m], quaternion (x, y, z, w)
Visuals = tuple[tuple[Any, ...], ...]  # what getVisualShapeData returns: link, kind, size, file, pose, colour

_GROUND_SIZE = 8.0  # [m]; a flat body that is longer and wider is the ground
_FLAT = ("GEOM_PLANE", "GEOM_BOX")
_ENDLESS = 1e6  # [m]; an infinite plane has an infinite box
_RAIL = 100.0  # [m]; a sliding joint that is longer has no limits
_INERTIAL = slice(3, 5)  # of getDynamicsInfo: the centre of mass in the link frame
_BODY_TYPE, _SOFT = 10, 3  # of getDynamicsInfo


@dataclasses.dataclass(frozen=True)
class BulletJoint:
    """The joint between a link and its parent, and the link's centre of mass."""

    name: str
    kind: int  # JOINT_REVOLUTE, JOINT_FIXED, ...
    parent: int  # index of the parent link; -1 is the base
    limits: tuple[float, float]  # [rad or m]; the lower one is above the upper one if there are none
    max_force: float  # in the model [N m or N]
    max_speed: float  # in the model [rad/s or m/s]
    axis: tuple[float, ...]  # in the inertial frame of the link
    pivot: tuple[float, ...]  # position in the inertial frame of the parent [m]
    turn: tuple[float, ...]  # quaternion that turns the inertial frame of the parent into that of the link
    inertial: BulletPose  # inertial frame in the link frame

    @property
    def moves(self) -> bool:
        """Whether it has one degree of freedom."""
        return self.kind in (pybullet.JOINT_REVOLUTE, pybullet.JOINT_PRISMATIC)


@dataclasses.dataclass(frozen=True)
class BulletBody:
    """A body of a client."""

    client: int
    id: int
    name: str  # of the model; `body 3` if it has none
    links: list[str]  # unique names, the base first: link `i` of PyBullet is `links[i + 1]`
    joints: list[BulletJoint]  # one per link without the base
    inertial: BulletPose  # inertial frame of the base in its link frame
    mass: float  # of all links [kg]
    is_fixed: bool  # whether the base is fixed to the world
    is_soft: bool
    signature: tuple[Any, ...]  # of `read_signature`
    visuals: Visuals

    @property
    def moving(self) -> list[int]:
        """Indices of the joints with one degree of freedom."""
        return [index for index, joint in enumerate(self.joints) if joint.moves]

    def find_moving_links(self) -> list[int]:
        """Return PyBullet's numbers of the links that are not fixed to the world, -1 for the base."""
        moving = [] if self.is_fixed else [-1]
        for index, joint in enumerate(self.joints):  # a parent comes before its children
            if joint.moves or joint.kind == pybullet.JOINT_SPHERICAL or joint.parent in moving:
                moving.append(index)
        return moving

    def find_trunk(self) -> int | None:
        """Return the index in `links` of the link that travels: a free base, or one on a sliding joint without limits.

        None for an object without joints and for a robot that stays where it is.
        """
        if not self.joints:
            return None
        if not self.is_fixed:
            return 0
        first = self.joints[0]
        limited = 0 <= first.limits[1] - first.limits[0] < _RAIL
        if first.kind != pybullet.JOINT_PRISMATIC or limited:
            return None
        drawn = {shape[1] for shape in self.visuals}
        return next((link + 1 for link in range(len(self.joints)) if link in drawn), None)

    def find_ground_height(self) -> float | None:
        """Return the height of the upper face [m] if the body is flat, level and wide; else None."""
        kinds = {getattr(pybullet, name) for name in _FLAT}
        flat = all(shape[2] in kinds or b"plane" in shape[4].lower() for shape in self.visuals)
        if self.joints or not self.visuals or not flat:
            return None
        position, orientation = pybullet.getBasePositionAndOrientation(self.id, physicsClientId=self.client)
        low, high = pybullet.getAABB(self.id, -1, physicsClientId=self.client)
        if min(high[0] - low[0], high[1] - low[1]) < _GROUND_SIZE or max(map(abs, orientation[:2])) > 1e-6:
            return None
        return float(position[2] + self.visuals[0][5][2] if high[2] - low[2] > _ENDLESS else high[2])


def list_body_ids(client: int) -> list[int]:
    """Return the ids of the bodies of a client."""
    count = pybullet.getNumBodies(physicsClientId=client)
    return [pybullet.getBodyUniqueId(index, physicsClientId=client) for index in range(count)]


def read_visuals(client: int, body: int) -> Visuals:
    """Return the visual shapes of a body; those for collisions where it has no others. Takes 1 us per shape."""
    return tuple(pybullet.getVisualShapeData(body, physicsClientId=client) or ())


def read_signature(client: int, body: int) -> tuple[Any, ...]:
    """Return what shows in 0.3 us whether another body has this id now: the names in the model, the number of links."""
    return pybullet.getBodyInfo(body, physicsClientId=client), pybullet.getNumJoints(body, physicsClientId=client)


def read_body(client: int, body: int) -> BulletBody:
    """Return the description of a body."""
    signature = read_signature(client, body)
    (base, name), count = (text.decode(errors="replace") for text in signature[0]), signature[1]
    infos = [pybullet.getJointInfo(body, index, physicsClientId=client) for index in range(count)]
    dynamics = [pybullet.getDynamicsInfo(body, index, physicsClientId=client) for index in range(-1, count)]
    names = [base or "base", *(info[12].decode(errors="replace") or f"link {info[0]}" for info in infos)]
    joints = [
        BulletJoint(
            name=info[1].decode(errors="replace"),
            kind=info[2],
            parent=info[16],
            limits=info[8:10],
            max_force=info[10],
            max_speed=info[11],
            axis=info[13],
            pivot=info[14],
            turn=info[15],
            inertial=values[_INERTIAL],
        )
        for info, values in zip(infos, dynamics[1:], strict=True)
    ]
    return BulletBody(
        client=client,
        id=body,
        name=name or f"body {body}",
        links=make_unique(names),
        joints=joints,
        inertial=dynamics[0][_INERTIAL],
        mass=sum(values[0] for values in dynamics),
        is_fixed=dynamics[0][0] == 0.0,
        is_soft=dynamics[0][_BODY_TYPE] == _SOFT,
        signature=signature,
        visuals=read_visuals(client, body),
    )


def read_bodies(clients: Iterable[int] | None = None) -> list[BulletBody]:
    """Return all bodies of clients, in their order; by default of all connected clients of this process."""
    chosen = find_clients() if clients is None else clients
    return [read_body(client, body) for client in chosen for body in list_body_ids(client)]


def name_bodies(bodies: Sequence[BulletBody]) -> list[str]:
    """Return a unique name per body: that of the model, with the base where bodies of a model have different ones."""
    bases = {name: {body.links[0] for body in bodies if body.name == name} for name in {body.name for body in bodies}}
    return make_unique([body.name if len(bases[body.name]) == 1 else f"{body.name} {body.links[0]}" for body in bodies])


def make_unique(names: Sequence[str]) -> list[str]:
    """Return the names; the second `cube` becomes `cube (2)`."""
    unique: list[str] = []
    for name in names:
        numbered = (f"{name} ({number})" for number in itertools.count(2))
        unique.append(name if name not in unique else next(other for other in numbered if other not in unique))
    return unique


def read_pose(body: BulletBody, link: int) -> BulletPose:
    """Return the pose of the inertial frame of `links[link]` in the world.

    That of a link which is not the base is from the beginning of the last physics step.
    """
    if link == 0:
        return pybullet.getBasePositionAndOrientation(body.id, physicsClientId=body.client)
    return pybullet.getLinkState(body.id, link - 1, physicsClientId=body.client)[:2]


def find_bounds(
    bodies: Iterable[BulletBody], points: Sequence[Array] = (), *, only_moving: bool = False
) -> tuple[Array, Array]:
    """Return the lowest and highest corner [m] of bodies as they are now, without the ground, and of points.

    With `only_moving` links that are fixed to the world are left out.
    """
    corners = list(points)
    for body in bodies:
        links = body.find_moving_links() if only_moving else range(-1, len(body.joints))
        boxes = [np.array(pybullet.getAABB(body.id, link, physicsClientId=body.client)) for link in links]
        wide = any((box[1] - box[0])[:2].min() > _GROUND_SIZE for box in boxes)
        corners += [] if wide else list(itertools.chain(*boxes))
        if not wide:
            corners += _find_drawn_corners(body, set(links))
    return (np.min(corners, axis=0), np.max(corners, axis=0)) if corners else (-np.ones(3), np.ones(3))


def _find_drawn_corners(body: BulletBody, links: set[int]) -> list[Array]:
    """Return corners [m] of the visual boxes, balls, capsules and cylinders of links: they may not collide."""
    corners = []
    for shape in body.visuals:
        halves = _find_halves(shape[2], shape[3])
        if shape[1] not in links or halves is None:
            continue
        if shape[1] < 0:
            mass = pybullet.getBasePositionAndOrientation(body.id, physicsClientId=body.client)
            frame = pybullet.multiplyTransforms(*mass, *pybullet.invertTransform(*body.inertial))
        else:
            state = pybullet.getLinkState(body.id, shape[1], physicsClientId=body.client)
            frame = state[4:6]
        place, turn = pybullet.multiplyTransforms(*frame, shape[5], shape[6])
        axes = np.abs(np.array(pybullet.getMatrixFromQuaternion(turn)).reshape(3, 3))
        reach = axes @ halves
        corners += [np.array(place) - reach, np.array(place) + reach]
    return corners


def _find_halves(kind: int, size: Sequence[float]) -> Array | None:
    """Return the half sides of the box around a shape [m]; None for meshes and planes."""
    if kind == pybullet.GEOM_BOX:
        return np.array(size) / 2
    if kind == pybullet.GEOM_SPHERE:
        return np.full(3, size[0])
    if kind in (pybullet.GEOM_CYLINDER, pybullet.GEOM_CAPSULE):
        length, radius = size[:2]
        return np.array([radius, radius, length / 2 + radius])
    return None


@dataclasses.dataclass(frozen=True)
class BodyState:
    """Where a body is."""

    base: BulletPose  # inertial frame of the base in the world frame
    joints: Sequence[tuple[tuple[float, ...], tuple[float, ...]]]  # positions and velocities of each joint


def read_state(body: BulletBody) -> BodyState:
    """Return where a body is now. Takes 3 us for a robot of seven joints."""
    base = pybullet.getBasePositionAndOrientation(body.id, physicsClientId=body.client)
    if not body.joints:
        return BodyState(base, ())
    joints = range(len(body.joints))
    states = pybullet.getJointStatesMultiDof(body.id, joints, physicsClientId=body.client)
    return BodyState(base, [state[:2] for state in states])


def place_links(body: BulletBody, states: Sequence[BodyState]) -> tuple[Array, Array]:
    """Return the link frames of a body in T states: positions [m], shape (T, links, 3), and quaternions, (T, links, 4).

    The same arithmetic as Bullet's btMultiBody::forwardKinematics. A planar joint is at its zero. Rows of states that
    are not finite, because the simulation diverged, are NaN.
    """
    finite = [row for row, state in enumerate(states) if _is_finite(state)]
    positions, orientations = (np.full((len(states), len(body.links), size), np.nan) for size in (3, 4))
    if finite:
        positions[finite], orientations[finite] = _compute_frames(body, [states[row] for row in finite])
    return positions, orientations


def _is_finite(state: BodyState) -> bool:
    numbers = itertools.chain(*state.base, *(position for position, _ in state.joints))
    return all(map(math.isfinite, numbers)) and any(state.base[1])


def _compute_frames(body: BulletBody, states: Sequence[BodyState]) -> tuple[Array, Array]:
    centers = [np.array([state.base[0] for state in states])]  # of inertial frames, in the world
    turns = [normalize([state.base[1] for state in states])]
    for index, joint in enumerate(body.joints):
        parent, turn = joint.parent + 1, invert(normalize(joint.turn))
        offset = rotate(invert(normalize(joint.inertial[1])), joint.inertial[0])  # from the pivot to the centre
        slide = np.zeros((len(states), 3))
        if joint.kind in (pybullet.JOINT_REVOLUTE, pybullet.JOINT_PRISMATIC):
            moved = np.array([state.joints[index][0] for state in states])
            if joint.kind == pybullet.JOINT_REVOLUTE:
                turn = multiply(turn, from_axis(joint.axis, moved[:, 0]))  # MJCF axes have any length
            else:
                slide = moved * joint.axis
        elif joint.kind == pybullet.JOINT_SPHERICAL:
            turn = multiply(turn, normalize([state.joints[index][0] for state in states]))
        turns.append(multiply(turns[parent], turn))
        centers.append(centers[parent] + rotate(turns[parent], joint.pivot) + rotate(turns[-1], offset + slide))
    inertials = [body.inertial, *(joint.inertial for joint in body.joints)]
    frames = [multiply(turn, invert(normalize(pose[1]))) for turn, pose in zip(turns, inertials, strict=True)]
    positions = [
        center - rotate(frame, pose[0]) for center, frame, pose in zip(centers, frames, inertials, strict=True)
    ]
    return np.stack(positions, axis=1), np.stack(frames, axis=1)
