"""Imports PyBullet without the line it prints to stderr, and reads what it prints of an error."""

from __future__ import annotations

import contextlib
import ctypes
import os
import re
import tempfile
from collections.abc import Callable

_stderr = os.dup(2)
_devnull = os.open(os.devnull, os.O_WRONLY)
os.dup2(_devnull, 2)
try:
    import pybullet
    import pybullet_data
finally:
    os.dup2(_stderr, 2)
    os.close(_stderr)
    os.close(_devnull)

__all__ = ["pybullet", "pybullet_data", "read_complaint"]


def read_complaint(call: Callable[[], object]) -> str:
    """Call what failed once more, and return the reason: PyBullet prints it to stdout, its exception leaves it out."""
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
