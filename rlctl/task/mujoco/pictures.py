"""Pictures of a world in MuJoCo, drawn by OpenGL without a display."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlctl.task.mujoco.opengl import draw_without_display, explain_failure
from rlctl.task.mujoco.world import import_mujoco

_NEAREST = 0.05  # of the distance from the eye to the target
_SUN = (-0.45, -0.55, -0.7)  # the direction of its light
_LARGE = 600  # [pixels]; higher pictures are drawn finer, which takes a third longer without a graphics card
_QUALITY = {"shadowsize": 2048}
_FINE = {"shadowsize": 4096, "numslices": 40, "numstacks": 24}  # corners of MuJoCo's round shapes would be seen
_FLOOR_SIDE, _FLOOR_DEPTH = 40.0, 0.02  # [m], where a world has no ground
_MISSING_FLOOR = "floor of pictures"  # its material
_OF_CAMERA = 0.5  # how much of the light from the camera is left


@dataclass
class Marker:
    """A sphere that is drawn, and is no part of the world."""

    position: Sequence[float] | NDArray[np.float64]  # [m]
    radius: float  # [m]
    color: Sequence[float]  # red, green, blue, opacity


def draw(
    model: Any,
    data: Any,
    size: tuple[int, int],
    markers: Iterable[Marker] = (),
    *,
    eye: Sequence[float],
    target: Sequence[float],
    field_of_view: float,
    sun: bool = False,
    floor: float | None = None,
) -> NDArray[np.uint8]:
    """Return an RGB image of shape (height, width, 3), seen from `eye` [m] to `target` [m]; z is up.

    `size` is width and height, `field_of_view` is vertical [degrees]. `markers` are spheres: position [m], radius
    [m] and colour. With `sun` there is light and shadow from the side, too, and a floor at the height `floor` [m]
    where the world has none.
    """
    mujoco = import_mujoco()
    camera, way = mujoco.MjvCamera(), np.subtract(target, eye)
    camera.type, camera.lookat[:] = mujoco.mjtCamera.mjCAMERA_FREE, target
    camera.distance = float(np.linalg.norm(way))
    camera.azimuth = float(np.degrees(np.arctan2(way[1], way[0])))
    camera.elevation = float(np.degrees(np.arctan2(way[2], np.hypot(way[0], way[1]))))
    model.vis.global_.fovy = field_of_view
    # Nothing nearer is drawn. By default it is a hundredth of the world, on wide ground half of a robot.
    model.vis.map.znear = min(model.vis.map.znear, _NEAREST * camera.distance / model.stat.extent)
    if sun:
        # Shadows have so many pixels across the part of the world that the camera sees.
        for name, count in (_FINE if size[1] > _LARGE else _QUALITY).items():
            setattr(model.vis.quality, name, count)
        model.vis.map.shadowclip = 2.0 * camera.distance / model.stat.extent
    model.vis.global_.offwidth, model.vis.global_.offheight = (
        max(wanted, present)
        for wanted, present in zip(size, (model.vis.global_.offwidth, model.vis.global_.offheight), strict=True)
    )
    with explain_failure():
        renderer = _find_renderer(model, size)
        renderer.update_scene(data, camera)
        if sun:
            _add_sun(renderer.scene, target)
        if floor is not None:
            _add_floor(renderer.scene, model, floor, target)
        for marker in markers:
            _add_marker(renderer.scene, marker)
        picture: NDArray[np.uint8] = renderer.render()
    return picture


def light_scene(spec: Any) -> None:
    """Give a world a bright sky and light from the camera."""
    mujoco = import_mujoco()
    spec.visual.headlight.ambient, spec.visual.headlight.diffuse = [0.4] * 3, [0.6] * 3
    sky, gradient = mujoco.mjtTexture.mjTEXTURE_SKYBOX, mujoco.mjtBuiltin.mjBUILTIN_GRADIENT
    spec.add_texture(
        name="sky", type=sky, builtin=gradient, rgb1=[0.75, 0.83, 0.92], rgb2=[0.95] * 3, width=64, height=384
    )
    add_checker(spec, _MISSING_FLOOR)


def add_checker(spec: Any, name: str = "checker") -> str:
    """Add a pattern of squares of 0.5 m to a model, on which motion is seen; return the name of the material."""
    mujoco = import_mujoco()
    flat, checker = mujoco.mjtTexture.mjTEXTURE_2D, mujoco.mjtBuiltin.mjBUILTIN_CHECKER
    colors = {"rgb1": [0.86, 0.88, 0.9], "rgb2": [0.74, 0.77, 0.8]}
    spec.add_texture(name=name, type=flat, builtin=checker, width=64, height=64, **colors)
    material = spec.add_material(name=name, texuniform=True, texrepeat=[1.0, 1.0])
    textures = list(material.textures)
    textures[int(mujoco.mjtTextureRole.mjTEXROLE_RGB)] = name
    material.textures = textures
    return name


_kept: list[Any] = []
"""The model, the size and the renderer of the last picture: a new renderer takes half a second."""


def _find_renderer(model: Any, size: tuple[int, int]) -> Any:
    if _kept and _kept[0] is model and _kept[1] == size:
        return _kept[2]
    if _kept:
        _kept[2].close()
        _kept.clear()
    mujoco = import_mujoco()
    draw_without_display()
    renderer = mujoco.Renderer(model, size[1], size[0])
    _kept[:] = model, size, renderer
    return renderer


def _add_sun(scene: Any, target: Any) -> None:
    """Light a picture from the side too: from the camera alone, stairs are stripes."""
    mujoco = import_mujoco()
    for light in scene.lights[: scene.nlight]:  # the camera's
        light.diffuse[:] = [_OF_CAMERA * part for part in light.diffuse]
    sun = scene.lights[scene.nlight]
    sun.type, sun.castshadow, sun.headlight = int(mujoco.mjtLightType.mjLIGHT_DIRECTIONAL), 1, 0
    sun.dir[:] = _SUN
    sun.pos[:] = np.asarray(target, float) - 4.0 * np.array(_SUN)
    sun.ambient[:], sun.diffuse[:], sun.specular[:] = [0.0] * 3, [0.65] * 3, [0.1] * 3
    scene.nlight += 1


def _add_floor(scene: Any, model: Any, height: float, target: Any) -> None:
    """Add a wide, thin box of squares: OpenGL's lists have no plane that is not in the model.

    Its middle is on a multiple of the squares, which then stand still while the camera follows a robot.
    """
    mujoco = import_mujoco()
    size, turn = [_FLOOR_SIDE / 2, _FLOOR_SIDE / 2, _FLOOR_DEPTH / 2], np.eye(3).ravel()
    middle = np.array([*np.round(target[:2]), height - _FLOOR_DEPTH / 2])
    geom, color = scene.geoms[scene.ngeom], np.ones(4, np.float32)
    mujoco.mjv_initGeom(geom, mujoco.mjtGeom.mjGEOM_BOX, size, middle, turn, color)
    geom.matid = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_MATERIAL, _MISSING_FLOOR)
    scene.ngeom += 1


def _add_marker(scene: Any, marker: Marker) -> None:
    mujoco = import_mujoco()
    size, position, turn = [marker.radius] * 3, np.array(marker.position, float), np.eye(3).ravel()
    geom, color = scene.geoms[scene.ngeom], np.array(marker.color, np.float32)
    mujoco.mjv_initGeom(geom, mujoco.mjtGeom.mjGEOM_SPHERE, size, position, turn, color)
    scene.ngeom += 1
