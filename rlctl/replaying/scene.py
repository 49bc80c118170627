"""The scene of an episode: moving bodies, or camera pictures of an environment without bodies that can be read.

It is read after every step and drawn when the episode has ended.
"""

import dataclasses
import io
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from rlctl.errors import describe_exception
from rlctl.replaying.mjcf import Shape

Env = gymnasium.Env[Any, Any]
Array = NDArray[np.float64]
Warn = Callable[[str], None]  # receives a message for the user, about something that cannot be drawn correctly

WORLD = "world"  # the name of the first world
_MOST_PICTURES = 100  # of an episode: drawing one takes up to 40 ms
_LARGEST_PICTURE = 480  # [pixels]
_JPEG_QUALITY = 80


def _no_rows() -> Array:
    return np.zeros((0, 0, 3))


@dataclasses.dataclass(frozen=True, kw_only=True)
class BodyMotion:
    """A body over T steps. Positions [m] and quaternions (x, y, z, w) are of link frames in the world frame.

    Rows of steps in which the body did not exist are NaN.
    """

    name: str
    file: Path
    world: str = WORLD  # an environment may have several
    ground_height: float | None = None  # height of the upper face [m] if the body is the flat ground
    terrain: Array | None = None  # points of rough ground [m], world frame, shape (along x, along y, 3)
    joint_names: list[str] = dataclasses.field(default_factory=list)
    joint_positions: Array = dataclasses.field(default_factory=_no_rows)  # [rad or m], shape (T + 1, joints)
    joint_velocities: Array = dataclasses.field(default_factory=_no_rows)  # [rad/s or m/s], shape (T + 1, joints)
    links: list[str] = dataclasses.field(default_factory=list)  # the base first
    positions: Array = dataclasses.field(default_factory=_no_rows)  # shape (T + 1, links, 3)
    orientations: Array = dataclasses.field(default_factory=_no_rows)  # shape (T + 1, links, 4)
    shapes: list[Shape] = dataclasses.field(default_factory=list)
    colors: dict[int, list[tuple[float, ...]]] = dataclasses.field(default_factory=dict)
    """Colours of the shapes, RGBA in [0, 1], by the step in which they changed."""
    trunk: int | None = None
    """Index in `links` of the link that travels: a free base, or one on a sliding joint without limits; else None."""
    box: tuple[Array, Array] = (-np.ones(3), np.ones(3))  # lowest and highest corner [m] when it was first there

    @property
    def has_path(self) -> bool:
        """Whether it is a robot, whose path is drawn."""
        return bool(self.joint_names) or self.trunk is not None

    @property
    def exists_always(self) -> bool:
        """Whether it existed in every step."""
        return np.isfinite(self.positions).all().item()

    def list_spans(self) -> list[range]:
        """Return the steps in which the body existed, as ranges without gaps."""
        exists = np.isfinite(self.positions[:, :1]).all(axis=(1, 2))
        edges = np.flatnonzero(np.diff(exists, prepend=False, append=False))
        return [range(first, end) for first, end in edges.reshape(-1, 2).tolist()]


@dataclasses.dataclass(frozen=True)
class Line:
    """A straight line in the world frame."""

    start: Array  # [m]
    end: Array
    color: tuple[float, ...]  # RGB in [0, 1]


@dataclasses.dataclass(frozen=True)
class Scene:
    """What can be drawn of an episode of T steps."""

    bodies: list[BodyMotion] = dataclasses.field(default_factory=list)
    markers: dict[str, Array] = dataclasses.field(default_factory=dict)  # world positions [m], shape (T + 1, 3)
    pictures: list[tuple[int, bytes]] = dataclasses.field(default_factory=list)  # step and JPEG file
    lines: dict[tuple[str, str], list[list[Line]]] = dataclasses.field(default_factory=dict)
    """Lines of each of the T + 1 steps, by world and kind."""

    def robots(self) -> list[BodyMotion]:
        """Return the bodies with joints."""
        return [body for body in self.bodies if body.joint_names]

    def worlds(self) -> list[str]:
        """Return the names of the worlds, the first one first; empty if there is nothing to draw in 3-D."""
        names = [*([WORLD] if self.markers else []), *(body.world for body in self.bodies)]
        return sorted(dict.fromkeys(names), key=lambda name: name != WORLD)


class RenderedScene:
    """What `render` of an environment returns, in long episodes only every few steps; stops at the first error."""

    def __init__(self, env: Env, warn: Warn) -> None:
        self._env = env
        self._warn = warn
        self._works = env.render_mode == "rgb_array"
        self._pictures: list[tuple[int, bytes]] = []
        self._every = 1

    def read(self, step: int) -> None:
        """Take a picture after every few steps."""
        if not self._works or step % self._every:
            return
        try:
            self._pictures.append((step, encode_jpeg(np.asarray(self._env.render()))))
        except Exception as error:  # pygame or OpenGL is missing, or it returned no picture
            self._works = False
            self._warn(f"no camera pictures: render() raised {describe_exception(error)}")
        if len(self._pictures) > _MOST_PICTURES:  # the length of an episode is not known before its end
            self._pictures, self._every = self._pictures[::2], 2 * self._every

    def scene(self) -> Scene:
        """Return the pictures."""
        return Scene(pictures=self._pictures)


def encode_jpeg(picture: NDArray[Any]) -> bytes:
    """Return a picture of shape (height, width, 1 or 3), uint8, as a JPEG file of at most 480 pixels a side."""
    from PIL import Image

    image = Image.fromarray(np.squeeze(picture, axis=-1) if picture.shape[-1] == 1 else picture)
    image.thumbnail((_LARGEST_PICTURE, _LARGEST_PICTURE))
    file = io.BytesIO()
    image.convert("RGB").save(file, "JPEG", quality=_JPEG_QUALITY)
    return file.getvalue()
