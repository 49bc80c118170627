"""Imports PyBullet on first use, reads the errors that it prints, and draws its worlds."""

import contextlib
import ctypes
import functools
import importlib
import importlib.util
import os
import re
import sys
import tempfile
from collections.abc import Callable, Sequence
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlctl.errors import UsageError
from rlctl.task.rotations import look_along

_NO_WHEELS = sys.version_info >= (3, 12)
INSTALL_PYBULLET = f"pip install {'setuptools && pip install --no-build-isolation ' if _NO_WHEELS else ''}pybullet"
"""The command that installs PyBullet on this version of Python."""


def is_installed() -> bool:
    """Return whether PyBullet is installed; it is not imported."""
    return importlib.util.find_spec("pybullet") is not None


class _LazyModule:
    """Imports its module on first use, and then shares its namespace: later calls take no extra time."""

    __slots__ = ("__dict__", "_name")

    def __init__(self, name: str) -> None:
        self._name = name

    def __getattr__(self, attribute: str) -> Any:
        if attribute.startswith("__"):  # inspection does not import the module
            raise AttributeError(attribute)
        module = _import_silently(self._name)
        self.__dict__ = vars(module)
        return getattr(module, attribute)


def _import_silently(name: str) -> ModuleType:
    """Import a module without the line that PyBullet prints to stderr; raises `UsageError` where it is missing."""
    stderr, devnull = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    os.dup2(devnull, 2)
    try:
        return importlib.import_module(name)
    except ModuleNotFoundError as error:
        if error.name != name:
            raise
        raise UsageError(
            f"PyBullet is not installed: {INSTALL_PYBULLET}\n"
            "or simulate in MuJoCo, unless the task needs models of PyBullet: --sim mujoco"
        ) from None
    finally:
        os.dup2(stderr, 2)
        os.close(stderr)
        os.close(devnull)


_SUN = {"shadow": 1, "lightDirection": (0.45, -0.2, 0.8), "lightAmbientCoeff": 0.45, "lightDiffuseCoeff": 0.5}
pybullet: Any = _LazyModule("pybullet")
pybullet_data: Any = _LazyModule("pybullet_data")


def read_complaint(call: Callable[[], object]) -> str:
    """Repeat a failed call and return the reason, which PyBullet prints to stdout and leaves out of its exception."""
    flush, stdout = ctypes.CDLL(None).fflush, os.dup(1)  # C has a buffer of its own
    with tempfile.TemporaryFile() as file:
        flush(None)
        os.dup2(file.fileno(), 1)
        try:
            with contextlib.suppress(pybullet.error):
                call()
        finally:
            flush(None)
            os.dup2(stdout, 1)
            os.close(stdout)
        file.seek(0)
        text = file.read().decode(errors="replace")
    return " ".join(re.sub(r"b3(Error|Warning)\[.*\]:", " ", text).split())


def draw_world(
    client: int,
    width: int,
    height: int,
    *,
    eye: Sequence[float],
    target: Sequence[float],
    up: Sequence[float] = (0.0, 0.0, 1.0),
    field_of_view: float,
    sun: bool = False,
    floor: float | None = None,
) -> NDArray[np.uint8]:
    """Draw a client's world as `Sim.render` does.

    With `sun` there is a sky, more light from the side, and shadow; and below it a floor at the height `floor` [m]
    where the world has none.
    """
    view = pybullet.computeViewMatrix(eye, target, up)
    projection = pybullet.computeProjectionMatrixFOV(field_of_view, width / height, 0.05, 10.0)
    light: dict[str, Any] = _SUN if sun else {"shadow": 0}
    image = pybullet.getCameraImage(
        width, height, view, projection, renderer=pybullet.ER_TINY_RENDERER, physicsClientId=client, **light
    )
    # PyBullet returns flat tuples if it was built without numpy.
    picture = np.asarray(image[2], dtype=np.uint8).reshape(height, width, 4)[:, :, :3]
    if not sun:
        return picture
    is_empty = np.asarray(image[4]).reshape(height, width) < 0
    background = _paint_background(width, height, tuple(eye), tuple(target), field_of_view, floor)
    return np.where(is_empty[..., None], background, picture)


_HORIZON, _ZENITH = ([242.0] * 3, [191.0, 212.0, 235.0])  # of the sky, as in MuJoCo
_SQUARES = ([219.0, 224.0, 230.0], [189.0, 196.0, 204.0])
_SQUARE = 0.5  # [m]
_FADES_AT = 8.0  # [m]; a floor is lost in the haze beyond a few times this


@functools.lru_cache(maxsize=1)  # the camera of an arm stands still
def _paint_background(
    width: int,
    height: int,
    eye: tuple[float, ...],
    target: tuple[float, ...],
    field_of_view: float,
    floor: float | None,
) -> NDArray[np.uint8]:
    """Return a picture of a sky, and below the horizon of a floor of squares at a height [m]."""
    right, up, forward = look_along(np.subtract(target, eye))
    pixel = 2.0 * np.tan(np.radians(field_of_view) / 2) / height
    across = (pixel * (np.arange(width) + 0.5 - width / 2)).astype(np.float32)
    above = (pixel * (height / 2 - np.arange(height) - 0.5)).astype(np.float32)[:, None]
    # Rays through the pixels, 1 m deep; `right` is level.
    x, y = (
        np.float32(forward[axis]) + across * np.float32(right[axis]) + above * np.float32(up[axis]) for axis in (0, 1)
    )
    z = np.float32(forward[2]) + above * np.float32(up[2])
    rise = np.clip(z / np.sqrt(1.0 + across**2 + above**2), 0.0, 1.0)
    colors = np.asarray(_HORIZON, np.float32) + rise[..., None] * np.subtract(_ZENITH, _HORIZON).astype(np.float32)
    below = int(np.count_nonzero(z[:, 0] > -1e-3))  # the first row below the horizon
    if floor is not None and floor < eye[2] and below < height:
        way = np.float32(floor - eye[2]) / z[below:]
        x, y = x[below:] * way, y[below:] * way
        columns, rows = np.floor((x + eye[0]) / _SQUARE), np.floor((y + eye[1]) / _SQUARE)
        squares = np.asarray(_SQUARES, np.float32)[((columns + rows) % 2).astype(np.intp)]
        haze = (1.0 - np.exp(-(x**2 + y**2) / np.float32(_FADES_AT**2)))[..., None]
        colors[below:] = squares + haze * (np.asarray(_HORIZON, np.float32) - squares)
    return colors.astype(np.uint8)


def check_display() -> None:
    """Raise `UsageError` where PyBullet's window cannot open: PyBullet itself would end the process."""
    if sys.platform == "linux" and not _x_server_answers():
        display = os.environ.get("DISPLAY")
        why = f"no X server answers at {display}" if display else "DISPLAY is not set"
        raise UsageError(f"PyBullet's window needs a display, and {why}; leave out --gui (in Python: render_mode)")


def _x_server_answers() -> bool:
    try:
        x11 = ctypes.CDLL("libX11.so.6")  # the one that PyBullet itself loads
    except OSError:
        return False
    x11.XOpenDisplay.restype = ctypes.c_void_p
    x11.XCloseDisplay.argtypes = [ctypes.c_void_p]
    connection = x11.XOpenDisplay(None)
    if connection:
        x11.XCloseDisplay(connection)
    return bool(connection)
