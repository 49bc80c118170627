"""What is read of a PyBullet body at each step, and what it becomes in a scene."""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlctl.replaying.bullet_bodies import (
    BodyState,
    BulletBody,
    Visuals,
    find_bounds,
    place_links,
    read_signature,
    read_state,
)
from rlctl.replaying.mjcf import Mesh, Shape, ShapeKind, read_shapes
from rlctl.replaying.scene import BodyMotion
from rlctl.task.pybullet.library import pybullet

Array = NDArray[np.float64]
Key = tuple[int, int]  # a client, and a body of it

_SHAPE, _COLOR = slice(1, 7), 7  # of getVisualShapeData: everything but the body's id and the colour
_PLANE = (8.0, 8.0, 0.002)  # [m], of a plane that is not the level ground
_HEIGHT_FIELD = 9  # the kind of a shape; PyBullet has no name for it


class Track:
    """A body in the steps in which it existed."""

    def __init__(self, body: BulletBody, file: Path | None = None, mesh: Mesh | None = None) -> None:
        self.body = body
        self.steps: list[int] = []
        self._file = file
        self._mesh = mesh
        self._states: list[BodyState] = []
        self._painted: dict[int, Visuals] = {}  # the shapes, by the step in which their colours changed
        self._visuals: Visuals | None = None
        self._box = find_bounds([body])
        self._ground_height = body.find_ground_height()

    def is_of(self, key: Key, visuals: Visuals) -> bool:
        """Say whether the body that has an id now is the one of this track."""
        last = self._visuals or ()
        same = visuals == last or _without_colors(visuals) == _without_colors(last)
        return same and read_signature(*key) == self.body.signature

    def equals(self, body: BulletBody) -> bool:
        """Say whether a body of the same client is built as the one of this track."""
        mine = self.body
        same = (mine.client, mine.signature, mine.joints) == (body.client, body.signature, body.joints)
        return same and _without_colors(mine.visuals) == _without_colors(body.visuals)

    def read(self, step: int, visuals: Visuals) -> None:
        """Read the body after a step."""
        self.steps.append(step)
        self._states.append(read_state(self.body))
        if visuals != self._visuals:
            self._painted[step] = self._visuals = visuals

    def describe_motion(self, name: str, world: str, steps: int) -> BodyMotion:
        """Return the motion over a number of steps, the reset included."""
        body, moving = self.body, self.body.moving
        positions, orientations = place_links(body, self._states)
        joints = np.array([[state.joints[index] for index in moving] for state in self._states], np.float64)
        joints = joints.reshape(len(self._states), len(moving), 2)
        shapes, colors = self._describe_shapes()

        def fill(rows: Array) -> Array:
            complete = np.full((steps, *rows.shape[1:]), np.nan)
            complete[self.steps] = rows
            return complete

        return BodyMotion(
            name=name,
            file=self._file or Path(name),
            world=world,
            ground_height=self._ground_height,
            joint_names=[body.joints[index].name for index in moving],
            joint_positions=fill(joints[:, :, 0]),
            joint_velocities=fill(joints[:, :, 1]),
            links=body.links,
            positions=fill(positions),
            orientations=fill(orientations),
            shapes=shapes,
            colors=colors,
            trunk=body.find_trunk(),
            box=self._box,
        )

    def _describe_shapes(self) -> tuple[list[Shape], dict[int, list[tuple[float, ...]]]]:
        if self._file is not None and self._file.suffix == ".xml":
            try:
                geoms = [shape for shape in read_shapes(self._file) if shape.link in self.body.links]
            except ValueError:  # PyBullet's reader accepts more files; a warning says that nothing is drawn
                return [], {}
            if geoms:
                return geoms, {}
        painted = list(self._painted.values())
        first = painted[0]
        # A shape without opacity is hidden.
        shown = [index for index in range(len(first)) if any(visuals[index][_COLOR][3] > 0 for visuals in painted)]
        colors = {step: [tuple(visuals[index][_COLOR]) for index in shown] for step, visuals in self._painted.items()}
        return [self._describe_shape(first[index]) for index in shown], colors if len(colors) > 1 else {}

    def _describe_shape(self, data: tuple[Any, ...]) -> Shape:
        _, link, number, size, mesh, position, orientation, color = data[:8]
        kinds = {getattr(pybullet, f"GEOM_{kind.name}", -1): kind for kind in ShapeKind}
        kind, file = kinds.get(number, ShapeKind.OTHER), Path(mesh.decode()) if mesh else None
        if kind is ShapeKind.PLANE:
            kind, size = ShapeKind.BOX, _PLANE
        if kind is ShapeKind.SPHERE:
            size = size[:1]  # PyBullet adds zeros
        if self._mesh is not None and (number == _HEIGHT_FIELD or (kind is ShapeKind.MESH and file is None)):
            return Shape(self.body.links[0], ShapeKind.MESH, (1.0, 1.0, 1.0), self._mesh, position, orientation, color)
        return Shape(self.body.links[link + 1], kind, tuple(size), file, position, orientation, color)


def _without_colors(visuals: Visuals) -> list[tuple[Any, ...]]:
    return [shape[_SHAPE] for shape in visuals]
