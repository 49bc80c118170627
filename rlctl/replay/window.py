"""PyBullet's window, or that of a Gymnasium environment: `--gui`."""

from __future__ import annotations

import contextlib
import ctypes
import os
import sys
import time
from collections.abc import Callable, Iterator, Sequence

from rlctl import registry
from rlctl.env_spec import EnvSpec
from rlctl.errors import TaskError, UsageError
from rlctl.replay.live import Choose, Env, Lived, frame_time, live

_INSTEAD = "leave out --gui to write a recording instead"
_DT = 1 / 30  # [s] a step, where an environment does not say


@contextlib.contextmanager
def open_window(spec: EnvSpec) -> Iterator[Env]:
    """Build an environment that shows itself, and close it; raises `UsageError` where there is no display."""
    if sys.platform == "linux":
        _check_display(bullet=registry.is_task(spec.constructor()))
    env = spec.make("human")
    try:
        yield env
    finally:
        env.close()


def show_episodes(env: Env, spec: EnvSpec, seeds: Sequence[int], begin: Callable[[], Choose]) -> list[Lived]:
    """Live an episode per seed in real time; ends early, and well, when PyBullet's window is closed."""
    pace = _RealTime(frame_time(env) or _DT)
    shown: list[Lived] = []
    for seed in seeds:
        try:
            shown.append(live(env, spec, seed, begin(), observers=[pace]))
        except TaskError as error:
            if "Not connected to physics server" not in str(error.__cause__):
                raise
            break
    return shown


def _check_display(*, bullet: bool) -> None:
    """Look for a display first: without one PyBullet ends the process."""
    display, wayland = os.environ.get("DISPLAY"), os.environ.get("WAYLAND_DISPLAY")
    if not display and (bullet or not wayland):
        raise UsageError(f"--gui: there is no display, DISPLAY is not set; {_INSTEAD}")
    if bullet and not _x_server_answers():
        raise UsageError(f"--gui: no X server answers at DISPLAY={display}; {_INSTEAD}")


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


class _RealTime:
    """Waits after every step until simulated time has passed on the clock."""

    def __init__(self, dt: float) -> None:
        self._dt = dt  # [s]
        self._start = 0.0

    def __call__(self, step: int) -> None:
        if step == 0:
            self._start = time.monotonic()
        time.sleep(max(0.0, self._start + step * self._dt - time.monotonic()))
