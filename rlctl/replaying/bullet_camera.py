"""A camera in a PyBullet world: the software renderer, which needs no display and changes nothing."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from rlctl.replaying.bullet_bodies import BulletBody, find_bounds, list_body_ids, read_body, read_pose
from rlctl.replaying.bullet_log import BulletLog
from rlctl.replaying.camera import FIELD_OF_VIEW, FilmCamera, Viewpoint
from rlctl.replaying.captions import CameraPose
from rlctl.task.pybullet.library import draw_world, pybullet

Picture = NDArray[np.uint8]
Array = NDArray[np.float64]


def find_world(log: BulletLog) -> list[BulletBody]:
    """Return the bodies of the first client that an environment made with a robot, or else with any body."""
    worlds = [
        [body for body in (read_body(client, key) for key in list_body_ids(client)) if not body.is_soft]
        for client in log.find_own_clients()
    ]
    worlds.sort(key=lambda bodies: (not any(body.joints for body in bodies), not bodies))
    return worlds[0] if worlds else []


def _find_missing_floor(bodies: Sequence[BulletBody]) -> float | None:
    """Return the height of the lowest point [m] where a floor is drawn; None where a world has a ground."""
    terrain = pybullet.GEOM_HEIGHTFIELD
    for body in bodies:
        is_terrain = any(shape[2] == terrain for shape in body.visuals)
        if is_terrain or body.find_ground_height() is not None:
            return None
    return float(find_bounds(bodies)[0][2])


class BulletCamera:
    """A camera that follows the first robot that travels, or else shows all that moves and the points of interest."""

    def __init__(
        self, bodies: Sequence[BulletBody], points: Sequence[Array], size: tuple[int, int], view: Viewpoint
    ) -> None:
        self._client = bodies[0].client
        self._size = size  # width and height [pixels]
        trunks = [(body, trunk) for body in bodies if (trunk := body.find_trunk()) is not None]
        self._followed = trunks[0] if trunks else None
        self._moving = [body for body in bodies if not body.is_fixed or body.moving] or list(bodies)
        if self._followed is None:
            low, high = find_bounds(self._moving, points, only_moving=True)
        else:
            low, high = find_bounds([self._followed[0]], only_moving=True)
        self._camera = FilmCamera(low, high, size, view)
        self._floor = _find_missing_floor(bodies)

    def draw(self) -> Picture:
        """Return a picture of the present state, shape (height, width, 3)."""
        present = set(list_body_ids(self._client))
        moving, followed = [body for body in self._moving if body.id in present], None
        if self._followed is not None and self._followed[0].id in present:
            followed = np.array(read_pose(*self._followed)[0])
            moving = [body for body in moving if body is self._followed[0] or self._is_near(body, followed)]
        low, high = find_bounds(moving, only_moving=True)
        eye, target = self._camera.aim(low, high, followed)
        self.look = CameraPose(eye, target)
        return draw_world(
            self._client,
            *self._size,
            eye=eye,
            target=target,
            field_of_view=FIELD_OF_VIEW,
            sun=True,
            floor=self._floor,
        )

    def _is_near(self, body: BulletBody, place: Array) -> bool:
        return bool(np.linalg.norm(np.array(read_pose(body, 0)[0]) - place) < self._camera.near)
