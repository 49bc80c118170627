"""Recognises a process that ended for want of a display."""

from __future__ import annotations

import re

from rlctl.check_env.messages import Failure

NO_DISPLAY = re.compile(
    r"cannot connect to x server|could ?n.t connect to display|could not connect to display|no \$DISPLAY|"
    r"DISPLAY environment variable is missing|no available video device|cannot open display|"
    r"could not load the qt platform plugin|NoSuchDisplayException|failed to open display",
    re.IGNORECASE,
)
"""What X11, PyBullet, GLFW, pygame, Qt, Tk and pyglet print where there is no display."""


def lost_display(failure: Failure) -> bool:
    """Say whether a process ended for want of a display."""
    return failure.kind == "died" and NO_DISPLAY.search(failure.details or "") is not None
