"""The legs of a robot model: chains of joints that leave its trunk in pairs, left and right, down to the ground."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from rlctl.errors import UsageError
from rlctl.tasks.shapes import Array, list_points

if TYPE_CHECKING:
    from rlctl.task.mujoco.body import MujocoBody

MIRRORS = (np.array([1.0, -1.0, 1.0]), np.array([-1.0, 1.0, 1.0]))
"""Left and right exchanged, for a robot that faces along x and along y."""
ENDLESS = np.pi  # [rad], to each side, of a joint that can turn around
_SAMPLES = 300
_SAME_PLACE = 0.1  # of the distance of the farthest hip: how far from its mirror image the other hip may be
_LEVEL_AXIS = 0.5  # component z of the axis of a wheel, at most
_ROUND = 0.8  # of a wheel's radius: its smallest
_DEPTH = 0.6  # of the deepest reach: arms do not get as far down as legs


@dataclasses.dataclass(frozen=True)
class Foot:
    """Points of the shapes that a leg ends in, each with a radius around it [m]."""

    link: str
    bodies: list[int]  # MuJoCo's number of the link of each point
    points: Array  # (n, 3), in the frame of its link
    radii: Array  # (n,)


@dataclasses.dataclass(frozen=True)
class Leg:
    """A chain of joints and what it ends in."""

    joints: list[int]  # indices in `joint_names`, from the trunk on
    foot: Foot
    other: int  # index of the leg on the other side


class Skeleton:
    """A free body in MuJoCo, with its trunk's centre of mass at the origin, of which only the joints are moved."""

    def __init__(self, body: MujocoBody) -> None:
        self.body, self.model, self.data = body, body._sim.model, body._sim.data
        self._mujoco = body._sim.mujoco
        body.set_base((0.0, 0.0, 0.0))
        self.joints = np.array(body.parts.joints, int)  # MuJoCo's numbers
        self._places = self.model.jnt_qposadr[self.joints]
        bounded = body.joint_high - body.joint_low < 2 * ENDLESS
        self.low = np.where(bounded, body.joint_low, -ENDLESS)
        self.high = np.where(bounded, body.joint_high, ENDLESS)
        middle = (self.low + self.high) / 2
        self.rest: Array = np.where((self.low <= 0) & (self.high >= 0), 0.0, middle)
        """Positions of all joints: 0, or the middle of a range without 0."""
        self.trunk = body.find_link(body.base_name)
        self._find_parts()

    def _find_parts(self) -> None:
        """Join links without joints between them to one part, whose number is that of its first link."""
        model = self.model
        self.part_of = {self.trunk: self.trunk}
        for link in sorted(self.body.parts.link_names):
            above = self.part_of.get(int(model.body_parentid[link]))
            if link != self.trunk and above is not None:
                self.part_of[link] = link if model.body_jntnum[link] else above
        self.above = {part: self.part_of.get(int(model.body_parentid[part]), -1) for part in self.part_of.values()}
        self.above[self.trunk] = -1

    def place(self, positions: Array) -> None:
        """Set all joints."""
        self.data.qpos[self._places] = positions
        self._mujoco.mj_kinematics(self.model, self.data)

    def forward(self) -> None:
        """Compute accelerations."""
        self._mujoco.mj_forward(self.model, self.data)

    def anchors(self, joints: Sequence[int]) -> Array:
        """Return where joints are [m], shape (joints, 3)."""
        found: Array = self.data.xanchor[self.joints[list(joints)]].copy()
        return found

    def axes(self, joints: Sequence[int]) -> Array:
        """Return the axes of joints, shape (joints, 3)."""
        found: Array = self.data.xaxis[self.joints[list(joints)]].copy()
        return found

    def touch(self, foot: Foot) -> Array:
        """Return where a foot would touch the ground [m]: the middle of its lowest points, shape (3,)."""
        frames = self.data.xmat[foot.bodies].reshape(-1, 3, 3)
        places = self.data.xpos[foot.bodies] + np.einsum("nij,nj->ni", frames, foot.points)
        places[:, 2] -= foot.radii
        lowest = places[places[:, 2] < places[:, 2].min() + self.thickness(foot)]
        return np.array([*((lowest.min(axis=0) + lowest.max(axis=0)) / 2)[:2], places[:, 2].min()])

    def thickness(self, foot: Foot) -> float:
        """Return within which height [m] of its lowest one points of a foot count as its sole."""
        return 0.05 * float(np.ptp(foot.points, axis=0).max()) + 1e-4

    def chain(self, part: int) -> list[int]:
        """Return the indices of the joints from the trunk to a part."""
        numbers: list[int] = []
        while part != self.trunk:
            own = [index for index, joint in enumerate(self.joints) if self.model.jnt_bodyid[joint] == part]
            numbers, part = own + numbers, self.above[part]
        return numbers

    def centre_of_mass(self) -> Array:
        """Return the centre of mass of all links [m], shape (3,)."""
        self._mujoco.mj_comPos(self.model, self.data)
        centre: Array = self.data.subtree_com[self.trunk].copy()
        return centre

    def lowest_of_trunk(self) -> float:
        """Return the height of the trunk's lowest point, 0 or less [m]."""
        geoms = [geom for geom in self.body.parts.geoms if self.part_of.get(self._owner(geom)) == self.trunk]
        if not geoms:
            return 0.0
        return min(0.0, float(self.touch(_make_foot(self, self.trunk, geoms))[2]))

    def _owner(self, geom: int) -> int:
        return int(self.model.geom_bodyid[geom])


def find_legs(skeleton: Skeleton) -> tuple[list[Leg], Array]:
    """Return the legs, and the mirror of `MIRRORS` by which they are in pairs; raises `UsageError` without any."""
    chains = _find_chains(skeleton)
    name = skeleton.body.file.name
    skeleton.place(skeleton.rest)
    for mirror in MIRRORS:
        pairs = _find_pairs(skeleton, [joints for joints, _ in chains], mirror)
        legs = [Leg(*chains[index], other) for index, other in pairs.items()]
        if legs:
            return _keep_deepest(skeleton, legs, list(pairs)), mirror
    if not chains:
        raise UsageError(f"--model {name}: no link that a joint moves has a collision shape, so it cannot stand")
    raise UsageError(
        f"--model {name}: found no legs: --walk needs pairs of chains of joints, left and right of the trunk "
        f"{skeleton.body.base_name!r}; for an arm leave out --walk"
    )


def _find_chains(skeleton: Skeleton) -> list[tuple[list[int], Foot]]:
    """Return the joints that only this chain has, and the end, of each chain with a shape at its end."""
    geoms: dict[int, list[int]] = {}
    for geom in skeleton.body.parts.geoms:
        part = skeleton.part_of.get(skeleton._owner(geom))
        if part is not None:
            geoms.setdefault(part, []).append(geom)
    inner: set[int] = set()
    for part in geoms:
        while part != -1 and (part := skeleton.above[part]) != -1:
            inner.add(part)
    ends: dict[int, list[int]] = {}
    for end in (part for part in geoms if part not in inner):
        chain = skeleton.chain(end)
        # Fingers of one hand, or toes of one foot, are one end.
        if chain and not any(len(set(chain) & set(known)) > len(chain) / 2 for known in ends.values()):
            ends[end] = chain
    shared = [joint for chain in ends.values() for joint in chain]
    own = {end: [joint for joint in chain if shared.count(joint) == 1] for end, chain in ends.items()}
    return [(joints, _make_foot(skeleton, end, geoms[end])) for end, joints in own.items() if joints]


def _find_pairs(skeleton: Skeleton, chains: list[list[int]], mirror: Array) -> dict[int, int]:
    """Return the index of the chain on the other side, for all that have one."""
    hips = np.array([skeleton.anchors(joints)[0] for joints in chains]).reshape(-1, 3)
    centre = (hips.min(axis=0) + hips.max(axis=0)) / 2 if len(hips) else np.zeros(3)
    tolerance = _SAME_PLACE * float(np.linalg.norm(hips - centre, axis=1).max(initial=0.0))
    found: dict[int, int] = {}
    for index, hip in enumerate(hips):
        distances = np.linalg.norm(hips - centre - (hip - centre) * mirror, axis=1)
        other = int(distances.argmin())
        if other != index and distances[other] < tolerance and len(chains[other]) == len(chains[index]):
            found[index] = other
    return {index: other for index, other in found.items() if found.get(other) == index}


def _keep_deepest(skeleton: Skeleton, legs: list[Leg], numbers: list[int]) -> list[Leg]:
    """Return the legs that reach down about as far as any, in the order of their joints, with `other` adapted."""
    rng, depths = np.random.default_rng(0), np.zeros(len(legs))
    moved = [joint for leg in legs for joint in leg.joints]
    for _ in range(_SAMPLES):
        positions = skeleton.rest.copy()
        positions[moved] = rng.uniform(skeleton.low[moved], skeleton.high[moved])
        skeleton.place(positions)
        depths = np.minimum(depths, [skeleton.touch(leg.foot)[2] for leg in legs])
    deep = {numbers[index]: leg for index, leg in enumerate(legs) if depths[index] <= _DEPTH * depths.min()}
    kept = {number: leg for number, leg in deep.items() if leg.other in deep}
    order = sorted(kept, key=lambda number: kept[number].joints)
    return [dataclasses.replace(kept[number], other=order.index(kept[number].other)) for number in order]


def _make_foot(skeleton: Skeleton, part: int, geoms: list[int]) -> Foot:
    clouds = [list_points(skeleton.model, geom) for geom in geoms]
    bodies = [skeleton._owner(geom) for geom, (points, _) in zip(geoms, clouds, strict=True) for _ in points]
    points, radii = (np.concatenate(column) for column in zip(*clouds, strict=True))
    names = [skeleton.body.parts.link_names[body] for body in bodies]
    # The link farthest down the tree, such as a foot that is fixed to a shank.
    return Foot(names[int(np.argmax(bodies))] if names else skeleton.body.base_name, bodies, points, radii)


def find_wheels(skeleton: Skeleton) -> list[str]:
    """Return the links that are wheels: round about the only joint that moves them, which is level and endless."""
    skeleton.place(skeleton.rest)
    wheels = []
    for joints, foot in _find_chains(skeleton):
        if len(joints) == 1 and _is_endless(skeleton, joints[0]) and _is_round(skeleton, joints[0], foot):
            wheels.append(foot.link)
    return wheels


def _is_endless(skeleton: Skeleton, joint: int) -> bool:
    body = skeleton.body
    return bool(body.joint_high[joint] - body.joint_low[joint] >= 2 * ENDLESS)


def _is_round(skeleton: Skeleton, joint: int, foot: Foot) -> bool:
    """Return whether a foot's shapes are round about a joint that is level: as far from it in all directions."""
    data = skeleton.data
    anchor, axis = skeleton.anchors([joint])[0], skeleton.axes([joint])[0]
    if abs(axis[2]) > _LEVEL_AXIS:
        return False
    frames = data.xmat[foot.bodies].reshape(-1, 3, 3)
    places = data.xpos[foot.bodies] + np.einsum("nij,nj->ni", frames, foot.points) - anchor
    forwards = np.cross(axis, (0.0, 0.0, 1.0))
    upwards = np.cross(forwards, axis)
    turns = np.linspace(0.0, 2 * np.pi, 16, endpoint=False)
    directions = np.cos(turns)[:, None] * forwards + np.sin(turns)[:, None] * upwards
    farthest = (places @ directions.T + foot.radii[:, None]).max(axis=0)
    return bool(farthest.min() > _ROUND * farthest.max())
