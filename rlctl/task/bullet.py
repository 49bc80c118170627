"""Imports PyBullet without the line it prints to stderr."""

from __future__ import annotations

import os

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

__all__ = ["pybullet", "pybullet_data"]
