"""What is written into the pictures of a task: rings around its markers, the time, and commanded velocities."""

import collections
import dataclasses
import functools
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlctl.replaying.camera import FIELD_OF_VIEW
from rlctl.task.body import Body
from rlctl.task.commands import CommandTerm, name_for_people
from rlctl.task.env import TaskEnv
from rlctl.task.rotations import look_along, roll_pitch_yaw

Picture = NDArray[np.uint8]
Array = NDArray[np.float64]

_RING_RADIUS = 0.05  # [m], of the ring around a marker, whose sphere a hand may hide
_LINES = 26  # lines of text that would fill the height of a picture
_SPACING = 1.3  # between lines, relative to the size of the font
_AVERAGED_S = 0.5  # [s] over which a measured velocity is averaged: a gait swings about it
_RING_COLOR = (20, 170, 70)
_TEXT = {"fill": (255, 255, 255), "stroke_fill": (35, 40, 48)}


@dataclasses.dataclass(frozen=True)
class CameraPose:
    """Where a camera is and where it looks [m], with z up and the field of view of films."""

    eye: Sequence[float]
    target: Sequence[float]

    def project(self, point: Array, size: tuple[int, int]) -> tuple[float, float, float] | None:
        """Return column and row of a point in a picture of a size, and pixels per metre there; None behind it."""
        axes = look_along(np.subtract(self.target, self.eye))
        right, up, depth = (axes @ np.subtract(point, self.eye)).tolist()
        if depth <= 0:
            return None
        scale = size[1] / 2 / math.tan(math.radians(FIELD_OF_VIEW) / 2) / depth
        return size[0] / 2 + scale * right, size[1] / 2 - scale * up, scale


def annotate(picture: Picture, markers: Mapping[str, Any], look: CameraPose, lines: Sequence[str] = ()) -> Picture:
    """Return a picture with a ring and the name of each marker, and lines of text in its upper left corner.

    `markers` are positions by name [m], shape (3,).
    """
    height, width = picture.shape[:2]
    places = {name: look.project(np.asarray(position), (width, height)) for name, position in markers.items()}
    if not any(places.values()) and not lines:
        return picture
    from PIL import Image, ImageDraw

    image, font_size = Image.fromarray(np.ascontiguousarray(picture)), _choose_font_size(height)
    draw = ImageDraw.Draw(image)
    line_width = max(1, height // 240)
    for name, place in places.items():
        if place is None:
            continue
        column, row, scale = place
        radius = max(3.0, _RING_RADIUS * scale)
        box = (column - radius, row - radius, column + radius, row + radius)
        draw.ellipse(box, outline=_RING_COLOR, width=line_width)
        _write(draw, (column + 1.2 * radius, row - font_size), name, font_size)
    for number, line in enumerate(lines):
        _write(draw, (font_size / 2, font_size * (0.4 + _SPACING * number)), line, font_size)
    return np.asarray(image)


def _choose_font_size(height: int) -> int:
    """Return the size of text in a picture of a height; both in pixels."""
    return max(9, height // _LINES)


class Caption:
    """The lines in the corner of a task's film: the time, and each command with the velocity that it asks for."""

    def __init__(self, env: TaskEnv) -> None:
        self._env = env
        bodies = env.sim.bodies.values()
        self._robot: Body | None = next((body for body in bodies if body.link_names and not body.fixed), None)
        self._measured: collections.deque[tuple[float, dict[str, float]]] = collections.deque()

    def begin(self) -> None:
        """Forget the velocities of the episode before."""
        self._measured.clear()

    def find_headroom(self, height: int) -> float:
        """Return the share of a picture of `height` [pixels] that its lines cover; the time alone is in a corner."""
        count = len(self._list_commands())
        return 0.0 if count == 0 else (1 + count) * _SPACING * _choose_font_size(height) / height

    def list_lines(self, time_s: float) -> list[str]:
        """Return the lines at a time [s] since the reset."""
        measured = self._average(time_s)
        lines = [f"{time_s:.2f} s"]
        for name, command in self._list_commands().items():
            line = f"{name_for_people(name)}: commanded {float(command.value):+.2f}"
            if name in measured:
                line += f", measured {measured[name]:+.2f}"
            lines.append(f"{line} {command.unit}".rstrip())
        return lines

    def _list_commands(self) -> dict[str, CommandTerm]:
        """Return the commands without coordinates of markers, which are drawn."""
        shown = self._env.markers()
        return {name: command for name, command in self._env.commands().items() if name.rpartition("_")[0] not in shown}

    def _average(self, time_s: float) -> dict[str, float]:
        """Return the robot's velocities in its heading frame, averaged over the pictures of the last half second."""
        if self._robot is None:
            return {}
        self._measured.append((time_s, _read_velocities(self._robot)))
        while self._measured[0][0] < time_s - _AVERAGED_S:
            self._measured.popleft()
        rows = [velocities for _, velocities in self._measured]
        return {name: float(np.mean([row[name] for row in rows])) for name in rows[0]}


def _read_velocities(robot: Body) -> dict[str, float]:
    yaw = roll_pitch_yaw(robot.base_orientation.tolist())[2]
    x, y = robot.base_velocity[:2]
    return {
        "lin_vel_x": math.cos(yaw) * x + math.sin(yaw) * y,
        "lin_vel_y": math.cos(yaw) * y - math.sin(yaw) * x,
        "ang_vel_z": float(robot.base_angular_velocity[2]),
    }


@functools.cache
def _load_font(size: int) -> Any:
    from PIL import ImageFont

    return ImageFont.load_default(size)


def _write(draw: Any, place: tuple[float, float], text: str, font_size: int) -> None:
    draw.text(place, text, font=_load_font(font_size), stroke_width=max(1, font_size // 12), **_TEXT)
