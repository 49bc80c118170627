"""Pictures of a world in MuJoCo, drawn by OpenGL without a display."""

import os
import sys
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlctl.errors import UsageError, describe_exception
from rlctl.task.mujoco.world import import_mujoco

_DISPLAYS = {"DISPLAY", "WAYLAND_DISPLAY"}
_HINT = "without a display set MUJOCO_GL=egl (Debian: libegl1) or MUJOCO_GL=osmesa"


def draw(
    model: Any,
    data: Any,
    size: tuple[int, int],
    markers: Sequence[tuple[Any, float, Any]] = (),
    *,
    eye: Sequence[float],
    target: Sequence[float],
    field_of_view: float,
) -> NDArray[np.uint8]:
    """Return an RGB image of shape (height, width, 3), seen from `eye` [m] to `target` [m]; z is up.

    `size` is width and height, `field_of_view` is vertical [degrees]. `markers` are spheres: position [m], radius
    [m] and colour.
    """
    mujoco = import_mujoco()
    # It chose how to draw at import. Without a display GLFW fails, and ends the process when it is asked again.
    if "glfw" in mujoco.GLContext.__module__ and sys.platform == "linux" and not _DISPLAYS & os.environ.keys():
        raise UsageError(f"MuJoCo cannot draw: there is no display\n{_HINT}")
    camera, way = mujoco.MjvCamera(), np.subtract(target, eye)
    camera.type, camera.lookat[:] = mujoco.mjtCamera.mjCAMERA_FREE, target
    camera.distance = float(np.linalg.norm(way))
    camera.azimuth = float(np.degrees(np.arctan2(way[1], way[0])))
    camera.elevation = float(np.degrees(np.arctan2(way[2], np.hypot(way[0], way[1]))))
    model.vis.global_.fovy = field_of_view
    model.vis.global_.offwidth, model.vis.global_.offheight = (
        max(wanted, present)
        for wanted, present in zip(size, (model.vis.global_.offwidth, model.vis.global_.offheight), strict=True)
    )
    try:
        with mujoco.Renderer(model, size[1], size[0]) as renderer:
            renderer.update_scene(data, camera)
            for position, radius, color in markers:
                geom = renderer.scene.geoms[renderer.scene.ngeom]
                sphere = mujoco.mjtGeom.mjGEOM_SPHERE
                mujoco.mjv_initGeom(
                    geom, sphere, np.full(3, radius), position, np.eye(3).ravel(), color.astype(np.float32)
                )
                renderer.scene.ngeom += 1
            picture: NDArray[np.uint8] = renderer.render()
    except Exception as error:  # OpenGL raises many kinds
        raise UsageError(f"MuJoCo cannot draw: {describe_exception(error)}\n{_HINT}") from None
    return picture
