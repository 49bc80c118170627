"""Frames on links at which constraints act, and what a constraint holds together."""

import dataclasses
from collections.abc import Sequence

import numpy as np

from rlctl.task.body import Array, Body
from rlctl.task.rotations import multiply, rotate

Point = Sequence[float]


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
    def world_pose(self) -> tuple[Array, Array]:
        """Position [m] and orientation (x, y, z, w) in the world."""
        if self.link == self.body.base_name:
            position, orientation = self.body.base_position, self.body.base_orientation
        else:
            position, orientation = self.body.link_position(self.link), self.body.link_orientation(self.link)
        return position + rotate(orientation, self.position), multiply(orientation, self.orientation)


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
