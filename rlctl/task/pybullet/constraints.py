"""Constraints between links: gears, points held together, links held at a pose."""

from typing import Any

from rlctl.errors import TaskError
from rlctl.task.attachments import Attachment, Joined, Point
from rlctl.task.pybullet.body import PybulletBody
from rlctl.task.pybullet.library import pybullet
from rlctl.task.sim import Sim

_APART = 0.01  # [m]; frames farther apart would jump together and make the world unstable


class Constraints(Sim):
    """The part of `PybulletSim` that connects links.

    A constraint is not exact: with physics steps of 1/240 s a free body of any mass hangs 1.2 mm too low. The error is
    proportional to the square of the step.
    """

    client: int

    def connect_gear(
        self, body: Any, driver: str, driven: str, *, ratio: float, max_force: float = 1e4, stiffness: float = 0.1
    ) -> None:
        _ = body.find_joints([driver, driven])  # raises for one that does not move
        indices = [body.all_joint_names.index(joint) for joint in (driven, driver)]
        links, axis = (body.id, indices[0], body.id, indices[1]), (0, 0, 1)
        constraint = pybullet.createConstraint(
            *links, pybullet.JOINT_GEAR, axis, (0, 0, 0), (0, 0, 0), physicsClientId=self.client
        )
        # PyBullet keeps driven + gearRatio * driver at 0.
        self._change_constraint(constraint, max_force, gearRatio=-ratio, erp=stiffness)

    def connect_point(self, first: Attachment, second: Attachment, *, max_force: float = 1e4) -> Joined:
        return self._connect(pybullet.JOINT_POINT2POINT, first, second, max_force)

    def connect_fixed(self, first: Attachment, second: Attachment, *, max_force: float = 1e4) -> Joined:
        return self._connect(pybullet.JOINT_FIXED, first, second, max_force)

    def _connect(self, kind: int, first: Attachment, second: Attachment, max_force: float) -> Joined:
        joined = Joined(first, second)
        if joined.gap > _APART:
            raise TaskError(
                f"constraint: {first.link!r} of {first.body.name!r} and {second.link!r} of {second.body.name!r} are "
                f"{joined.gap:.3g} m apart, too far to connect them. Place them with set_joints first."
            )
        one, index, position, orientation = _find_inertial_frame(first)
        other, other_index, other_position, other_orientation = _find_inertial_frame(second)
        links = one, index, other, other_index
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


def _find_inertial_frame(end: Attachment) -> tuple[int, int, Point, Point]:
    """Return PyBullet's numbers of body and link, and the frame relative to the link's centre of mass."""
    body = end.body
    assert isinstance(body, PybulletBody)  # bodies of one world are of one engine
    index = body._part_index(end.link)
    if index < 0:
        return body.id, index, end.position, end.orientation
    info = pybullet.getDynamicsInfo(body.id, index, physicsClientId=body.client)
    inverse = pybullet.invertTransform(info[3], info[4])
    return body.id, index, *pybullet.multiplyTransforms(*inverse, end.position, end.orientation)
