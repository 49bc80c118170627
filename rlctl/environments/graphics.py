"""What to say where an environment needs a window or OpenGL, and there is no display."""

import contextlib
import os
import re
import sys
from collections.abc import Iterator
from typing import Any

from rlctl.environments.places import describe_caller
from rlctl.errors import NoDisplayError

_OPENGL = re.compile(r"OpenGL|\bEGL\b|OSMesa|GLFW|gladLoadGL", re.IGNORECASE)
_WINDOW_FIX = 'write p.connect(p.GUI if render_mode == "human" else p.DIRECT), with render_mode None by default'


def opengl_fix(error: str) -> str:
    """Return what to do if an error says that OpenGL is missing; empty for other errors."""
    hint = "Where there is no display, set MUJOCO_GL=egl (or osmesa). Use OpenGL only to render or to observe images."
    return hint if _OPENGL.search(error) else ""


@contextlib.contextmanager
def refuse_windows(task: str) -> Iterator[None]:
    """Let PyBullet raise `NoDisplayError` in the `with` block where it would end the process: without a display."""
    pybullet: Any = sys.modules.get("pybullet")
    if pybullet is None or not sys.platform.startswith("linux") or os.environ.get("DISPLAY"):
        yield
        return
    connect = pybullet.connect
    windows = {getattr(pybullet, name) for name in ("GUI", "GUI_SERVER", "GUI_MAIN_THREAD") if hasattr(pybullet, name)}

    def connect_without_window(*arguments: Any, **keywords: Any) -> Any:
        if (arguments[0] if arguments else keywords.get("method")) in windows:
            what = f"PyBullet opens a window (p.GUI{describe_caller()}), and there is no display"
            raise NoDisplayError(f"task {task!r}: {what}\n{_WINDOW_FIX}")
        return connect(*arguments, **keywords)

    pybullet.connect = connect_without_window
    try:
        yield
    finally:
        pybullet.connect = connect
