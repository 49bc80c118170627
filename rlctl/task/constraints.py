"""Constraints between links: gears, points held together, links held at a pose."""

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np

from rlctl.errors import TaskError
from rlctl.task.body import Array, Body
from rlctl.task.bullet import pybullet

Point = Sequence[float]
_APART = 0.01  # [m]; frames farther apart would jump together and make the world unstable


@dataclasses.dataclass(frozen=True)
class Attachment:
    """A frame on a link, at which a constraint acts."""

    body: Body
    link: str
    position: Point = (0.0, 0.0, 0.0)
    """[m], in the link's frame; for a base, in its inertial frame."""
    orientation: Point = (0.0, 0.0, 0.0, 1.0)
    """Quaternion (x, y, z, w), in the same frame."""

    @property
    def index(self) -> int:
        """PyBullet's number of the link, -1 for the base."""
        return self.body._part_index(self.link)

    @property
    def world_pose(self) -> tuple[Array, Array]:
        """Position [m] and orientation (x, y, z, w) in the world."""
        if self.link == self.body.base_name:
            pose = self.body.base_position, self.body.base_orientation
        else:
            pose = self.body.link_position(self.link), self.body.link_orientation(self.link)
        position, orientation = pybullet.multiplyTransforms(*pose, self.position, self.orientation)
        return np.array(position), np.array(orientation)

    @property
    def inertial_pose(self) -> tuple[Point, Point]:
        """The frame relative to the link's centre of mass, as PyBullet's constraints need it."""
        if self.index < 0:
            return self.position, self.orientation
        info = pybullet.getDynamicsInfo(self.body.id, self.index, physicsClientId=self.body.client)
        inverse = pybullet.invertTransform(info[3], info[4])
        return pybullet.multiplyTransforms(*inverse, self.position, self.orientation)


@dataclasses.dataclass(frozen=True)
class Joined:
    """Two frames that a constraint holds together."""

    first: Attachment
    second: Attachment

    @property
    def gap(self) -> float:
        """Distance between the frames' origins [m]."""
        return float(np.linalg.norm(self.first.world_pose[0] - self.second.world_pose[0]))

    @property
    def angle(self) -> float:
        """Angle between the frames [rad], in [0, pi]."""
        product = abs(float(np.dot(self.first.world_pose[1], self.second.world_pose[1])))
        return 2 * float(np.arccos(min(1.0, product)))


class Constraints:
    """The part of `Sim` that connects links. Call it in `build`: constraints last as long as the world.

    `max_force` is the largest force of a constraint [N], for gears the largest torque [N m]; a stronger load pulls the
    frames apart. A constraint is not exact: with physics steps of 1/240 s a free body of any mass hangs 1.2 mm too low.
    The error is proportional to the square of the step.
    """

    client: int

    def connect_gear(
        self, body: Body, driver: str, driven: str, *, ratio: float, max_force: float = 1e4, stiffness: float = 0.1
    ) -> None:
        """Gear two joints of a body: the position of `driven` is `ratio` times that of `driver`.

        `stiffness` is the fraction of the position error that one physics step removes, in (0, 1].
        """
        _ = body.find_joints([driver, driven])  # raises for one that does not move
        indices = [body.all_joint_names.index(joint) for joint in (driven, driver)]
        links, axis = (body.id, indices[0], body.id, indices[1]), (0, 0, 1)
        constraint = pybullet.createConstraint(
            *links, pybullet.JOINT_GEAR, axis, (0, 0, 0), (0, 0, 0), physicsClientId=self.client
        )
        # PyBullet keeps driven + gearRatio * driver at 0.
        self._change_constraint(constraint, max_force, gearRatio=-ratio, erp=stiffness)

    def connect_point(self, first: Attachment, second: Attachment, *, max_force: float = 1e4) -> Joined:
        """Join a point of a link to a point of another; both links can rotate. A URDF cannot describe such a loop."""
        return self._connect(pybullet.JOINT_POINT2POINT, first, second, max_force)

    def connect_fixed(self, first: Attachment, second: Attachment, *, max_force: float = 1e4) -> Joined:
        """Join a frame of a link to a frame of another: both links move as one."""
        return self._connect(pybullet.JOINT_FIXED, first, second, max_force)

    def _connect(self, kind: int, first: Attachment, second: Attachment, max_force: float) -> Joined:
        joined = Joined(first, second)
        if joined.gap > _APART:
            raise TaskError(
                f"constraint: {first.link!r} of {first.body.name!r} and {second.link!r} of {second.body.name!r} are "
                f"{joined.gap:.3g} m apart, too far to connect them. Place them with set_joints first."
            )
        position, orientation = first.inertial_pose
        other_position, other_orientation = second.inertial_pose
        links = first.body.id, first.index, second.body.id, second.index
        constraint = pybullet.createConstraint(
            *links,
            kind,
            (0, 0, 0),
            position,
            other_position,
            parentFrameOrientation=orientation,
            childFrameOrientation=other_orientation,
            physicsClientId=self.client,
        )
        self._change_constraint(constraint, max_force)
        return joined

    def _change_constraint(self, constraint: int, max_force: float, **values: Any) -> None:
        pybullet.changeConstraint(constraint, maxForce=max_force, **values, physicsClientId=self.client)
