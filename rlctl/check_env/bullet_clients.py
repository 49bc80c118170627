"""The PyBullet clients of this process, whoever connected them."""

from __future__ import annotations

import sys

MOST_CLIENTS = 1024
"""So many physics clients a process may have, in the wheels of PyBullet 3.2."""


def connected() -> list[int]:
    """Return the ids of the clients that are connected; empty where PyBullet is not loaded."""
    pybullet = sys.modules.get("pybullet")
    if pybullet is None:
        return []
    ids = range(MOST_CLIENTS)
    return [each for each in ids if pybullet.getConnectionInfo(physicsClientId=each)["isConnected"]]
