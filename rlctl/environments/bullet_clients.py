"""The physics clients of PyBullet that are connected in this process, whoever connected them."""

import functools
import inspect
import sys
from typing import Any

MOST_CLIENTS = 1024  # So many physics clients a process may have, in the wheels of PyBullet 3.2


def bullet() -> Any:
    """Return PyBullet, which the environment has loaded."""
    return sys.modules["pybullet"]


class ClientCalls:
    """PyBullet's functions, bound to one client; its constants too."""

    def __init__(self, client: int) -> None:
        self._client = client

    def __getattr__(self, name: str) -> Any:
        value = getattr(bullet(), name)
        return functools.partial(value, physicsClientId=self._client) if inspect.isbuiltin(value) else value


def find_clients(most: int = MOST_CLIENTS) -> list[int]:
    """Return the ids below `most` of the clients that are connected, whoever did it; empty without PyBullet."""
    ids = range(min(most, MOST_CLIENTS) if "pybullet" in sys.modules else 0)
    return [client for client in ids if ClientCalls(client).getConnectionInfo()["isConnected"]]
