"""The scene of an episode: the bodies of a PyBullet world, or camera pictures of any other environment.

It is read after every step and drawn when the episode has ended.
"""

import dataclasses
import io
import itertools
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from rlctl.errors import describe_exception
from rlctl.replaying.mjcf import Shape, ShapeKind, read_shapes
from rlctl.task.body import Body
from rlctl.task.env import TaskEnv
from rlctl.task.pybullet.library import pybullet

Env = gymnasium.Env[Any, Any]
Array = NDArray[np.float64]
Warn = Callable[[str], None]  # receives a message for the user, about something that cannot be drawn correctly

_GROUND_SIZE = 8.0  # [m]; a body without joints that is longer and wider is the ground
_INERTIAL_POSE = slice(3, 5)  # of getDynamicsInfo: the centre of mass in the link frame
_LINK_POSE = slice(4, 6)  # of getLinkState: the link frame in the world
_MOST_PICTURES = 100  # of an episode: drawing one takes up to 40 ms
_LARGEST_PICTURE = 480  # [pixels]
_JPEG_QUALITY = 80


def _no_rows() -> Array:
    return np.zeros((0, 0, 3))


@dataclasses.dataclass(frozen=True, kw_only=True)
class BodyMotion:
    """A body over T steps. Positions [m] and quaternions (x, y, z, w) are of link frames in the world frame."""

    name: str
    file: Path
    ground_height: float | None = None  # height of the upper face [m] if the body is the flat ground
    terrain: Array | None = None  # points of rough ground [m], world frame, shape (along x, along y, 3)
    joint_names: list[str] = dataclasses.field(default_factory=list)
    joint_positions: Array = dataclasses.field(default_factory=_no_rows)  # [rad or m], shape (T + 1, joints)
    joint_velocities: Array = dataclasses.field(default_factory=_no_rows)  # [rad/s or m/s], shape (T + 1, joints)
    links: list[str] = dataclasses.field(default_factory=list)  # the base first
    positions: Array = dataclasses.field(default_factory=_no_rows)  # shape (T + 1, links, 3)
    orientations: Array = dataclasses.field(default_factory=_no_rows)  # shape (T + 1, links, 4)
    shapes: list[Shape] = dataclasses.field(default_factory=list)
    trunk: int | None = None
    """Index in `links` of the link that travels: a free base, or one on a sliding joint without limits; else None."""
    box: tuple[Array, Array] = (-np.ones(3), np.ones(3))  # lowest and highest corner [m] at the reset


@dataclasses.dataclass(frozen=True)
class Scene:
    """What can be drawn of an episode of T steps."""

    bodies: list[BodyMotion] = dataclasses.field(default_factory=list)
    markers: dict[str, Array] = dataclasses.field(default_factory=dict)  # world positions [m], shape (T + 1, 3)
    pictures: list[tuple[int, bytes]] = dataclasses.field(default_factory=list)  # step and JPEG file

    def robots(self) -> list[BodyMotion]:
        """Return the bodies with joints."""
        return [body for body in self.bodies if body.joint_names]


def find_bounds(bodies: Sequence[Body], markers: Sequence[Array] = ()) -> tuple[Array, Array]:
    """Return the lowest and highest corner [m] of the present world: its markers and bodies, without the ground."""
    corners = list(markers)
    for body in bodies:
        links = range(-1, len(body.link_names))
        boxes = [np.array(pybullet.getAABB(body.id, link, physicsClientId=body.client)) for link in links]
        wide = any((box[1] - box[0])[:2].min() > _GROUND_SIZE for box in boxes)
        corners += [] if wide else list(itertools.chain(*boxes))
    return (np.min(corners, axis=0), np.max(corners, axis=0)) if corners else (-np.ones(3), np.ones(3))


class SceneReader:
    """Reads bodies and markers of a task's world, without changing it."""

    def __init__(self, env: TaskEnv) -> None:
        self._env = env

    def read(self, step: int) -> None:
        """Read the world after a step; 0 is the reset."""
        positions = self._env.task.markers()
        if step == 0:  # only now: a reset may load the bodies again
            self._bodies = [_BodyReader(body) for body in self._env.sim.bodies.values()]
            self._markers: dict[str, list[Array]] = {name: [] for name in positions}
        for reader in self._bodies:
            reader.read()
        for name, history in self._markers.items():
            history.append(np.array(positions[name], np.float64))

    def scene(self) -> Scene:
        """Return what was read since the last reset."""
        markers = {name: np.stack(positions) for name, positions in self._markers.items()}
        return Scene([reader.describe_motion() for reader in self._bodies], markers)


class _BodyReader:
    def __init__(self, body: Body) -> None:
        self.body = body
        self.client = body.client
        base, _ = pybullet.getBodyInfo(body.id, physicsClientId=self.client)
        self.links = [base.decode(), *body.link_names]
        inertial = pybullet.getDynamicsInfo(body.id, -1, physicsClientId=self.client)[_INERTIAL_POSE]
        # PyBullet's base pose is that of the centre of mass.
        self._base_in_inertial = pybullet.invertTransform(*inertial)
        self._box = find_bounds([body])
        self._joint_positions: list[Array] = []
        self._joint_velocities: list[Array] = []
        self._poses: list[list[tuple[tuple[float, ...], tuple[float, ...]]]] = []

    def read(self) -> None:
        body = self.body
        self._joint_positions.append(body.joint_positions.copy())
        self._joint_velocities.append(body.joint_velocities.copy())
        inertial = pybullet.getBasePositionAndOrientation(body.id, physicsClientId=self.client)
        poses = [pybullet.multiplyTransforms(*inertial, *self._base_in_inertial)]
        if links := list(range(len(self.links) - 1)):
            states = pybullet.getLinkStates(body.id, links, computeForwardKinematics=1, physicsClientId=self.client)
            poses += [state[_LINK_POSE] for state in states]
        self._poses.append(poses)

    def describe_motion(self) -> BodyMotion:
        body = self.body
        return BodyMotion(
            name=body.name,
            file=body.file,
            ground_height=self._find_ground_height(),
            terrain=body.terrain,
            joint_names=body.joint_names,
            joint_positions=np.stack(self._joint_positions),
            joint_velocities=np.stack(self._joint_velocities),
            links=self.links,
            positions=np.array([[pose[0] for pose in poses] for poses in self._poses], np.float64),
            orientations=np.array([[pose[1] for pose in poses] for poses in self._poses], np.float64),
            shapes=self._read_shapes(),
            trunk=self._find_trunk(),
            box=self._box,
        )

    def _find_ground_height(self) -> float | None:
        if len(self.links) > 1 or self.body.terrain is not None:
            return None
        low, high = pybullet.getAABB(self.body.id, -1, physicsClientId=self.client)
        if min(high[0] - low[0], high[1] - low[1]) < _GROUND_SIZE:
            return None
        endless = high[2] - low[2] > 1e6  # an infinite plane has an infinite box
        return float(self._poses[0][0][0][2] if endless else high[2])

    def _find_trunk(self) -> int | None:
        trunk = self.body.find_trunk() if self.body.joint_names else None
        if trunk is None:
            return None
        return 0 if not self.body.fixed else self.links.index(trunk, 1)

    def _read_shapes(self) -> list[Shape]:
        if self.body.file.suffix == ".xml":
            try:
                return read_shapes(self.body.file)
            except ValueError:  # PyBullet's reader accepts more files; a warning says that nothing is drawn
                return []
        kinds = {getattr(pybullet, f"GEOM_{kind.name}", -1): kind for kind in ShapeKind}
        shapes = []
        for data in pybullet.getVisualShapeData(self.body.id, physicsClientId=self.client):
            _, link, kind, size, mesh, position, orientation, color = data[:8]
            file = Path(mesh.decode()) if mesh else None
            known = kinds.get(kind, ShapeKind.OTHER)
            shapes.append(Shape(self.links[link + 1], known, tuple(size), file, position, orientation, color))
        return shapes


class Camera:
    """Takes pictures of an environment, in long episodes only every few steps; stops after the first error."""

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
