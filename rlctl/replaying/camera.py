"""Where a film's camera is: it holds all that moves, and follows a robot that travels."""

import dataclasses
import itertools
import math

import numpy as np
from numpy.typing import NDArray

from rlctl.errors import UsageError
from rlctl.task.rotations import look_along

Array = NDArray[np.float64]

FIELD_OF_VIEW = 45.0  # [degrees], vertical
_MARGIN = 1.1  # how much farther the camera is than what is to be seen needs
_CLOSEST = 0.2  # [m]
_FARTHEST = 3.0  # times the first distance: what falls off a table is not followed for ever
_QUIET = 0.1  # share of the robot's height by which it may go up and down before the camera does
_NEAR = 1.0  # times the first distance: other bodies farther from a travelling robot are left behind


@dataclasses.dataclass(frozen=True)
class Viewpoint:
    """From where the camera looks."""

    azimuth: float = -42.0  # [degrees] of the camera from the x axis, counterclockwise: at the right of a robot, ahead
    elevation: float = 22.0  # [degrees] above the horizontal
    zoom: float = 1.0  # 2: from half the distance
    headroom: float = dataclasses.field(default=0.0, kw_only=True)
    """Share of the picture's height, at its top, that is left free for text."""

    @property
    def direction(self) -> Array:
        """Direction from what is seen to the camera, of length 1."""
        azimuth, elevation = math.radians(self.azimuth), math.radians(self.elevation)
        across = math.cos(elevation)
        return np.array([across * math.cos(azimuth), across * math.sin(azimuth), math.sin(elevation)])


def read_viewpoint(text: str | None) -> Viewpoint:
    """Read AZIMUTH[,ELEVATION[,ZOOM]]; raises `UsageError` for anything else."""
    if text is None:
        return Viewpoint()
    try:
        viewpoint = Viewpoint(*(float(part) for part in text.split(",")))
    except (TypeError, ValueError):
        viewpoint = Viewpoint(math.nan)
    is_possible = math.isfinite(viewpoint.azimuth) and -5.0 <= viewpoint.elevation <= 89.0
    if not is_possible or not 0.05 <= viewpoint.zoom <= 20.0:
        raise UsageError(
            f"--camera {text}: give AZIMUTH[,ELEVATION[,ZOOM]], degrees from the x axis, degrees up from -5 to 89, and "
            "times nearer from 0.05 to 20; for example 90 (from the left), or -42,60,1.5"
        )
    return viewpoint


def find_distance(
    low: Array, high: Array, size: tuple[int, int], *, target: Array | None = None, view: Viewpoint | None = None
) -> float:
    """Return the distance [m] to `target` from which a box fills the picture below its headroom.

    `low` and `high` are its corners [m]; `target` is by default its centre. `size` is width and height of the picture.
    """
    view = view or Viewpoint()
    axes = look_along(-view.direction)
    middle = (low + high) / 2 if target is None else target
    corners = np.array(list(itertools.product(*np.stack([low, high], axis=1)))) - middle
    across, up, depth = axes @ corners.T
    slope = math.tan(math.radians(FIELD_OF_VIEW) / 2)
    needed = (
        _MARGIN * np.maximum(abs(up) / (slope * (1 - view.headroom)), abs(across) / (slope * size[0] / size[1])) - depth
    )
    return max(_CLOSEST, float(needed.max()))


class FilmCamera:
    """A camera of an episode. It goes back, at once, where what moves would leave the picture, and not nearer again.

    `low` and `high` are corners of a box [m] around what is seen at first; `size` is width and height of the picture.
    """

    def __init__(self, low: Array, high: Array, size: tuple[int, int], view: Viewpoint) -> None:
        self._size, self._view = size, view
        self._target = (low + high) / 2
        self._height = float(high[2] - low[2])
        self._distance = find_distance(low, high, size, view=view)
        self._farthest = _FARTHEST * self._distance
        self.near = _NEAR * self._distance
        """Distance [m] from a travelling robot up to which other bodies are held in the picture."""

    def aim(self, low: Array, high: Array, followed: Array | None = None) -> tuple[list[float], list[float]]:
        """Return where the camera is and where it looks [m], for what moves in a box now; `followed` travels."""
        if followed is not None:
            self._target[:2] = followed[:2]
            # Small changes of the height are a gait's, which would shake the film; larger ones are stairs.
            middle, room = float(low[2] + high[2]) / 2, _QUIET * self._height
            self._target[2] = min(max(self._target[2], middle - room), middle + room)
        needed = find_distance(low, high, self._size, target=self._target, view=self._view)
        self._distance = max(self._distance, min(needed, self._farthest))
        distance = self._distance / self._view.zoom
        # Looking higher by half of the headroom, what is seen is in the middle of the rest.
        _, up, _ = look_along(-self._view.direction)
        slope = math.tan(math.radians(FIELD_OF_VIEW) / 2)
        middle = self._target + self._view.headroom * slope * distance * up
        return (middle + distance * self._view.direction).tolist(), middle.tolist()
