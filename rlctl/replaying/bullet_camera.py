"""A camera in a PyBullet world: the software renderer, which needs no display and changes nothing."""

import itertools
import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from rlctl.replaying.bullet_bodies import BulletBody, find_bounds, list_body_ids, read_body, read_pose
from rlctl.replaying.bullet_log import BulletLog
from rlctl.task.pybullet.library import draw_world

Picture = NDArray[np.uint8]
Array = NDArray[np.float64]

EYE_DIRECTION = np.array([1.0, -0.9, 0.55])  # from the right of a robot that looks along x, from above
_FIELD_OF_VIEW = 45.0  # [degrees]
_MARGIN = 1.05  # the corners of the box are empty anyway
_CLOSEST, _FARTHEST = 0.2, 8.0  # [m]; the renderer draws nothing beyond 10 m


def find_distance(low: Array, high: Array, size: tuple[int, int]) -> float:
    """Return the distance [m] from which a box fills the picture.

    `low` and `high` are its corners [m]; the camera looks from `EYE_DIRECTION` to its centre; `size` is width and
    height of the picture.
    """
    forward = -EYE_DIRECTION / np.linalg.norm(EYE_DIRECTION)
    right = np.cross(forward, (0.0, 0.0, 1.0))
    right /= np.linalg.norm(right)
    axes = np.stack([right, np.cross(right, forward), forward])
    corners = np.array(list(itertools.product(*np.stack([low, high], axis=1)))) - (low + high) / 2
    across, up, depth = axes @ corners.T
    slope = math.tan(math.radians(_FIELD_OF_VIEW) / 2)
    needed = _MARGIN * np.maximum(abs(up) / slope, abs(across) / (slope * size[0] / size[1])) - depth
    return max(_CLOSEST, float(needed.max()))


def find_world(log: BulletLog) -> list[BulletBody]:
    """Return the bodies of the first client that an environment made with a robot, or else with any body."""
    worlds = [
        [body for body in (read_body(client, key) for key in list_body_ids(client)) if not body.is_soft]
        for client in log.find_own_clients()
    ]
    worlds.sort(key=lambda bodies: (not any(body.joints for body in bodies), not bodies))
    return worlds[0] if worlds else []


class BulletCamera:
    """A camera that follows the first robot that travels, or else shows all bodies and the points of interest."""

    def __init__(self, bodies: Sequence[BulletBody], points: Sequence[Array], size: tuple[int, int]) -> None:
        self._client = bodies[0].client
        self._size = size  # width and height [pixels]
        trunks = [(body, trunk) for body in bodies if (trunk := body.find_trunk()) is not None]
        self._followed = trunks[0] if trunks else None
        low, high = find_bounds([trunks[0][0]]) if trunks else find_bounds(bodies, points)
        self._target = (low + high) / 2
        distances = [find_distance(low, high, size)]
        if trunks:
            distances += [2.5 * float(np.linalg.norm(point - self._target)) for point in points]
        self._offset = np.clip(max(distances), _CLOSEST, _FARTHEST) * EYE_DIRECTION / np.linalg.norm(EYE_DIRECTION)

    def draw(self) -> Picture:
        """Return a picture of the present state, shape (height, width, 3)."""
        if self._followed is not None and self._followed[0].id in list_body_ids(self._client):
            # The height is constant: a gait would shake the film.
            self._target[:2] = read_pose(*self._followed)[0][:2]
        eye, target = (self._target + self._offset).tolist(), self._target.tolist()
        return draw_world(self._client, *self._size, eye=eye, target=target, field_of_view=_FIELD_OF_VIEW)
