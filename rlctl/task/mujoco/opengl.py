"""Chooses how MuJoCo draws where there is no display."""

import contextlib
import ctypes
import importlib
import os
import sys
from collections.abc import Iterator
from typing import Any

from rlctl.errors import UsageError, describe_exception

_HINT = "without a display set MUJOCO_GL=egl (Debian: libegl1) or MUJOCO_GL=osmesa"
_EGL = "libEGL.so.1"


def draw_without_display(*, only_where_possible: bool = False) -> None:
    """Let MuJoCo draw by EGL on a Linux machine without a display, unless MUJOCO_GL is set.

    MuJoCo chooses when it is imported. Its choice without a display, GLFW, would end the process; elsewhere than on
    Linux it needs no display, and refuses EGL. Where EGL is missing the import of MuJoCo or the drawing raises an
    exception then; with `only_where_possible`, for code that may draw or not, nothing is changed there.
    """
    if sys.platform != "linux" or os.environ.get("DISPLAY"):
        return
    if only_where_possible and not _has_egl():
        return
    os.environ.setdefault("MUJOCO_GL", "egl")
    mujoco = sys.modules.get("mujoco")
    renderer = getattr(mujoco, "Renderer", None)
    if mujoco is None or renderer is None:
        return
    chosen: Any = sys.modules[renderer.__module__].gl_context
    context = getattr(chosen, "GLContext", None)  # MUJOCO_GL=disable leaves it out
    if context is not None and "glfw" in context.__module__:
        importlib.reload(chosen)
        for module in (mujoco, sys.modules.get("mujoco.gl_context")):  # which have the name too
            if hasattr(module, "GLContext"):
                module.GLContext = chosen.GLContext  # type: ignore[union-attr]


@contextlib.contextmanager
def explain_failure() -> Iterator[None]:
    """Raise `UsageError` for what OpenGL raises in the block of a `with`: exceptions of many kinds."""
    try:
        yield
    except Exception as error:
        raise UsageError(f"MuJoCo cannot draw: {describe_exception(error)}\n{_HINT}") from None


def _has_egl() -> bool:
    try:
        ctypes.CDLL(_EGL)
    except OSError:
        return False
    return True
