"""Where the pictures of an environment come from: a camera in its PyBullet world, or the environment itself."""

import dataclasses
from collections.abc import Sequence

import numpy as np

from rlctl.environments import registry
from rlctl.environments.spec import EnvSpec
from rlctl.errors import UsageError, describe_exception
from rlctl.replaying.bullet_bodies import read_body
from rlctl.replaying.bullet_camera import BulletCamera, Picture, find_world
from rlctl.replaying.camera import FIELD_OF_VIEW, FilmCamera, Viewpoint
from rlctl.replaying.captions import CameraPose, annotate
from rlctl.replaying.drawable import DrawableEnv, make_drawable
from rlctl.replaying.mujoco_scene import find_missing_floor, find_mujoco_bounds
from rlctl.replaying.scene import Env
from rlctl.task.env import TaskEnv
from rlctl.task.mujoco.sim import MujocoSim
from rlctl.task.pybullet.sim import PybulletSim


def make_filmable(spec: EnvSpec) -> Env:
    """Build an environment for pictures; raises `UsageError` if it is known to make none."""
    return spec.make("rgb_array") if registry.is_task(spec.constructor()) else make_drawable(spec)


class _PlainView:
    """A plain environment: its own pictures, or else a camera in its PyBullet world."""

    def __init__(self, env: Env, size: tuple[int, int], viewpoint: Viewpoint) -> None:
        self._env = env
        self._size, self._viewpoint = size, viewpoint
        self._reason = env.no_pictures if isinstance(env, DrawableEnv) else ""

    def begin(self, headroom: float = 0.0) -> None:
        """Prepare for a new episode; a camera in a task's world leaves `headroom` free, as in `Viewpoint`."""
        self._camera = self._place_camera() if self._reason else None
        if self._reason and self._camera is None:
            raise UsageError(self._reason)

    def draw(self, lines: Sequence[str] = ()) -> Picture:
        """Return a picture of the present state, shape (height, width, 3); `lines` are written into those of tasks."""
        if self._camera is None:
            try:
                return self._render()
            except UsageError as error:
                self._reason = str(error)
                self._camera = self._place_camera()
                if self._camera is None:
                    raise
        return self._camera.draw()

    def _place_camera(self) -> BulletCamera | None:
        bodies = find_world(self._env.bullet_log) if isinstance(self._env, DrawableEnv) else []
        return BulletCamera(bodies, (), self._size, self._viewpoint) if bodies else None

    def _render(self) -> Picture:
        try:
            picture = np.asarray(self._env.render())
        except Exception as error:  # missing pygame, no OpenGL
            raise UsageError(f"the environment's render() raised {describe_exception(error)}") from None
        if picture.ndim != 3 or picture.shape[2] != 3:
            raise UsageError(f"the environment's render() returned {picture.dtype} of shape {picture.shape}")
        height, width = (size - size % 2 for size in picture.shape[:2])  # encoders need even sizes
        return np.ascontiguousarray(picture[:height, :width].astype(np.uint8))


def _leave(headroom: float, viewpoint: Viewpoint) -> Viewpoint:
    return dataclasses.replace(viewpoint, headroom=headroom)


class _TaskView:
    """A camera in a task's PyBullet world."""

    def __init__(self, env: TaskEnv, size: tuple[int, int], viewpoint: Viewpoint) -> None:
        self._env = env
        self._size, self._viewpoint = size, viewpoint

    def begin(self, headroom: float = 0.0) -> None:
        sim, markers = self._env.sim, self._env.markers()
        assert isinstance(sim, PybulletSim)  # `look_at` asks
        bodies = [read_body(sim.client, body.id) for body in sim.bodies.values()]
        points = [np.asarray(position) for position in markers.values()]
        self._camera = BulletCamera(bodies, points, self._size, _leave(headroom, self._viewpoint))

    def draw(self, lines: Sequence[str] = ()) -> Picture:
        self._env.move_markers()
        picture = self._camera.draw()
        return annotate(picture, self._env.markers(), self._camera.look, lines)


class _MujocoTaskView:
    """A camera in a task's MuJoCo world, which follows the first body with a free base."""

    def __init__(self, env: TaskEnv, size: tuple[int, int], viewpoint: Viewpoint) -> None:
        self._env = env
        self._size, self._viewpoint = size, viewpoint

    def begin(self, headroom: float = 0.0) -> None:
        sim = self._env.sim
        assert isinstance(sim, MujocoSim)  # `look_at` asks
        bodies = list(sim.bodies.values())
        self._followed = next((body for body in bodies if body.link_names and not body.fixed), None)
        self._moving = [body for body in bodies if body.parts.moving]
        if self._followed is None:
            markers = [np.asarray(position) for position in self._env.markers().values()]
            low, high = find_mujoco_bounds(sim, self._moving, markers)
        else:
            low, high = find_mujoco_bounds(sim, [self._followed], [])
        self._camera = FilmCamera(low, high, self._size, _leave(headroom, self._viewpoint))
        self._floor = find_missing_floor(sim)

    def draw(self, lines: Sequence[str] = ()) -> Picture:
        self._env.move_markers()
        sim, moving, followed = self._env.sim, self._moving, None
        assert isinstance(sim, MujocoSim)
        if self._followed is not None:
            followed = self._followed.base_position
            moving = [body for body in moving if np.linalg.norm(body.base_position - followed) < self._camera.near]
        eye, target = self._camera.aim(*find_mujoco_bounds(sim, moving, []), followed)
        picture = sim.render(
            *self._size, eye=eye, target=target, field_of_view=FIELD_OF_VIEW, sun=True, floor=self._floor
        )
        return annotate(picture, self._env.markers(), CameraPose(eye, target), lines)


def look_at(
    env: Env, width: int, height: int, viewpoint: Viewpoint | None = None
) -> _TaskView | _MujocoTaskView | _PlainView:
    """Return the view of an environment: a camera in its task's world, or a plain environment's own pictures.

    Pictures of a camera have `width` and `height` [pixels].
    """
    inner, size, chosen = env.unwrapped, (width, height), viewpoint or Viewpoint()
    if not isinstance(inner, TaskEnv):
        return _PlainView(env, size, chosen)
    if isinstance(inner.sim, PybulletSim):
        return _TaskView(inner, size, chosen)
    return _MujocoTaskView(inner, size, chosen)
