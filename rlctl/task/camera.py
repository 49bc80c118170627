"""`Camera`: what a task declares about a camera, whose pictures a policy may observe by name."""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from rlctl.errors import TaskError, check_name
from rlctl.task.body import Array, Body
from rlctl.task.rotations import normalize, rotate

Point = tuple[float, float, float]
Pictures = NDArray[np.uint8]

ShapeName = Literal["box", "ball", "cylinder"]

SHAPES: tuple[ShapeName, ...] = ("box", "ball", "cylinder")
LARGEST_SIDE = 1024  # [pixels]
_PARALLEL = 1e-6


@dataclasses.dataclass(frozen=True)
class Camera:
    """A camera at `eye` that looks at `target`: points of the world, or of the frame of the link that carries it."""

    eye: Point  # [m]
    target: Point  # [m]
    up: Point = (0.0, 0.0, 1.0)
    """A direction that is up in the picture, as far as the view allows."""
    body: str = ""
    """The body that carries it, by its name in `build`; without one it stands still in the world."""
    link: str = ""
    field_of_view: float = 45.0  # [degrees], vertical
    size: tuple[int, int] = (64, 64)  # [pixels], width and height

    @property
    def shape(self) -> tuple[int, int, int]:
        """The shape of a picture: height, width, 3."""
        return self.size[1], self.size[0], 3

    def look(self) -> Array:
        """Return the directions right, up and forward of the picture, as rows of shape (3, 3)."""
        forward = normalize(np.subtract(self.target, self.eye))
        right = normalize(np.cross(forward, self.up))
        return np.stack([right, np.cross(right, forward), forward])


@dataclasses.dataclass(frozen=True)
class Distractor:
    """A thing that cameras see and nothing touches: a box, a ball or a cylinder, upright."""

    shape: ShapeName
    position: Sequence[float]  # [m], of its middle
    size: Sequence[float]  # [m], half of its sides; all of a ball are its radius, the first of a cylinder too
    yaw: float  # [rad]
    color: Sequence[float]  # red, green, blue


def check_cameras(task: str, cameras: Mapping[str, Camera]) -> None:
    """Raise `TaskError` for a declared camera that cannot take a picture."""
    for name, camera in cameras.items():
        where = f"{task}: cameras[{name!r}]"
        if not isinstance(camera, Camera):
            raise TaskError(f"{where} is {camera!r}: write Camera(eye=..., target=...)")
        if any(not isinstance(side, int) or not 1 <= side <= LARGEST_SIDE for side in camera.size):
            raise TaskError(f"{where}: size is {camera.size}; width and height are from 1 to {LARGEST_SIDE} pixels")
        if not 0.0 < camera.field_of_view < 180.0:
            raise TaskError(f"{where}: field_of_view is {camera.field_of_view}; it is between 0 and 180 degrees")
        view = np.subtract(camera.target, camera.eye)
        turned = np.linalg.norm(np.cross(view, camera.up))
        if not turned > _PARALLEL * max(1.0, math.hypot(*view)):
            raise TaskError(f"{where}: it looks from {camera.eye} to {camera.target}, along `up`; give another `up`")
        if camera.link and not camera.body:
            raise TaskError(f"{where}: link {camera.link!r} without its body; give `body` too")


def locate(camera: Camera, bodies: Mapping[str, Body]) -> tuple[Array, Array]:
    """Return where a camera is [m] and its directions right, up and forward, shape (3, 3), in the world's frame.

    Raises `TaskError` for a body or a link that the world does not have.
    """
    eye, axes = np.array(camera.eye, float), camera.look()
    if not camera.body:
        return eye, axes
    check_name(camera.body, bodies, "cameras: no body", TaskError, listed="Loaded")
    body = bodies[camera.body]
    link = camera.link or body.base_name
    orientation = body.link_orientation(link)
    return body.link_position(link) + rotate(orientation, eye), rotate(orientation, axes)
