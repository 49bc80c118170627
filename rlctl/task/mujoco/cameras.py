"""What the cameras of a task see in MuJoCo, of one world or of each world of a batch, drawn one after the other.

Pictures are small and many, so they are drawn coarsely: round shapes have few corners, edges are not smoothed, one
light gives no shadow. A picture takes about 1 ms of a core without a graphics card, at 64 x 64 pixels hardly more than
at 32 x 32; with twice the corners half as much again, with smooth edges twice as much, with a shadow five times.
"""

from __future__ import annotations

import math
import os
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlctl.task.camera import SHAPES, Camera, Distractor, Pictures
from rlctl.task.mujoco.drawn_world import DrawnWorld
from rlctl.task.mujoco.opengl import draw_without_display, explain_failure
from rlctl.task.mujoco.scene import MujocoScene
from rlctl.task.mujoco.world import Array, MujocoWorld
from rlctl.task.rotations import from_axis, rotate

MOST_DISTRACTORS = 8
_SUN = (-0.3, 0.4, -0.85)  # the direction of the light
_AMBIENT, _DIFFUSE = 0.45, 0.6
_CORNERS = {"numslices": 12, "numstacks": 6, "offsamples": 0}
_NEAR, _FAR = 0.01, 100.0  # [m]


def make_looks(cameras: Mapping[str, Camera]) -> dict[str, Array]:
    """Return the arrays of a world's looks that events change and a reset restores, by name.

    `light` has its brightness and direction, `camera_pose` a row of shift [m] and turn [rad] per camera, and
    `distractors` a row per thing: number of its shape, position, size, yaw, colour; NaN where there is none.
    """
    return {
        "light": np.array([1.0, *_SUN]),
        "camera_pose": np.zeros((len(cameras), 6)),
        "distractors": np.full((MOST_DISTRACTORS, 11), np.nan),
    }


def as_row(distractor: Distractor) -> list[float]:
    """Return a distractor as a row of `distractors`."""
    number = float(SHAPES.index(distractor.shape))
    return [number, *distractor.position, *distractor.size, distractor.yaw, *distractor.color]


class CameraPictures:
    """Draws what cameras see; `scene` has the files of the world, with visual shapes."""

    def __init__(self, scene: MujocoScene, cameras: Mapping[str, Camera]) -> None:
        self._mujoco = scene.mujoco
        self._cameras = cameras
        for setting, value in _CORNERS.items():
            setattr(scene.spec.visual.quality, setting, value)
        largest = [max(camera.size[axis] for camera in cameras.values()) for axis in (0, 1)]
        scene.spec.visual.global_.offwidth, scene.spec.visual.global_.offheight = largest
        self._drawn = DrawnWorld(scene)
        self._renderers: dict[tuple[int, int], Any] = {}  # by size: a new one takes half a second
        self._free = self._mujoco.MjvCamera()
        self._numbers = {name: number for number, name in enumerate(cameras)}
        self._axes = {name: camera.look() for name, camera in cameras.items()}
        self._mounts = {name: self._find_mount(camera, scene) for name, camera in cameras.items()}

    def _find_mount(self, camera: Camera, scene: MujocoScene) -> int:
        """Return the number of the MuJoCo body that carries a camera; 0 is the world."""
        if not camera.body:
            return 0
        link = camera.link or scene.parts[camera.body].base_name
        return int(self._drawn.model.body(f"{camera.body}/{link}").id)

    def take(self, name: str, world: MujocoWorld, rows: NDArray[np.int64]) -> Pictures:
        """Return what a camera sees in some worlds of a batch, shape (k, height, width, 3); raises `UsageError`."""
        camera = self._cameras[name]
        pictures = np.empty((len(rows), *camera.shape), np.uint8)
        with explain_failure():
            renderer = self._find_renderer(camera.size)
            for picture, row in zip(pictures, rows.tolist(), strict=True):
                self._drawn.follow(world, row)
                moved = world.model_row("camera_pose", row)[self._numbers[name]]
                eye, axes = self._locate(name, moved)
                renderer.update_scene(self._drawn.data, self._free)
                scene = renderer.scene
                _place(scene, camera, eye, axes)
                self._light(scene, world.model_row("light", row))
                self._show(scene, world.model_row("distractors", row))
                renderer.render(out=picture)
        return pictures

    def _find_renderer(self, size: tuple[int, int]) -> Any:
        if size not in self._renderers:
            draw_without_display()
            # Mesa's threads take longer to begin a small picture than they save, and the cores are for the workers.
            os.environ.setdefault("LP_NUM_THREADS", "0")
            renderer = self._mujoco.Renderer(self._drawn.model, size[1], size[0], max_geom=1000)
            for flag in ("mjRND_SHADOW", "mjRND_REFLECTION", "mjRND_HAZE", "mjRND_FOG"):
                renderer.scene.flags[int(getattr(self._mujoco.mjtRndFlag, flag))] = 0
            self._renderers[size] = renderer
        return self._renderers[size]

    def _locate(self, name: str, moved: Array) -> tuple[Array, Array]:
        """Return where a camera is and its directions right, up and forward, after it was `moved` by an event."""
        data, mount, axes = self._drawn.data, self._mounts[name], self._axes[name]
        eye = np.array(self._cameras[name].eye) + moved[:3] @ axes
        if moved[3:].any():
            angle = float(np.linalg.norm(moved[3:]))
            axes = rotate(from_axis(moved[3:] @ axes, angle), axes)
        turn = data.xmat[mount].reshape(3, 3)
        return data.xpos[mount] + turn @ eye, axes @ turn.T

    def _light(self, scene: Any, values: Array) -> None:
        brightness, direction = values[0], values[1:]
        scene.nlight = 1
        light = scene.lights[0]
        light.type, light.headlight = int(self._mujoco.mjtLightType.mjLIGHT_DIRECTIONAL), 0
        light.castshadow = 0
        light.dir, light.pos = direction, -4.0 * direction
        light.ambient = [_AMBIENT * brightness] * 3
        light.diffuse = [_DIFFUSE * brightness] * 3
        light.specular = [0.1 * brightness] * 3

    def _show(self, scene: Any, rows: Array) -> None:
        geoms = self._mujoco.mjtGeom
        kinds = (geoms.mjGEOM_BOX, geoms.mjGEOM_SPHERE, geoms.mjGEOM_CYLINDER)
        for row in rows[~np.isnan(rows[:, 0])]:
            sine, cosine = math.sin(row[7]), math.cos(row[7])
            turn = np.array([cosine, -sine, 0.0, sine, cosine, 0.0, 0.0, 0.0, 1.0])
            color = np.array([*row[8:], 1.0], np.float32)
            self._mujoco.mjv_initGeom(scene.geoms[scene.ngeom], kinds[int(row[0])], row[4:7], row[1:4], turn, color)
            scene.ngeom += 1

    def close(self) -> None:
        """Free what OpenGL holds."""
        for renderer in self._renderers.values():
            renderer.close()
        self._renderers.clear()


def _place(scene: Any, camera: Camera, eye: Array, axes: Array) -> None:
    """Put the eyes of a scene where a camera is."""
    height = _NEAR * math.tan(math.radians(camera.field_of_view) / 2)
    for own in scene.camera:  # of the left and the right eye
        own.pos, own.up, own.forward = eye, axes[1], axes[2]
        own.frustum_center, own.frustum_width, own.orthographic = 0.0, 0.0, 0
        own.frustum_bottom, own.frustum_top = -height, height
        own.frustum_near, own.frustum_far = _NEAR, _FAR
