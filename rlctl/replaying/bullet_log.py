"""Logs calls of PyBullet for what PyBullet does not return later: MJCF files, meshes from arrays, debug lines."""

import contextlib
import dataclasses
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from rlctl.environments.bullet_calls import Replacement, replace_functions
from rlctl.environments.bullet_clients import MOST_CLIENTS, find_clients
from rlctl.errors import UsageError
from rlctl.replaying.mjcf import Mesh, connect_grid
from rlctl.task.pybullet.library import pybullet, pybullet_data

Key = tuple[int, int]  # a client, and a body of it
Given = Mapping[str, Any]  # arguments by name
Site = tuple[str, int]  # file and line of a call

_MOST_LINES = 2_000  # of a client; later ones replace the first
_ARGUMENTS: dict[str, tuple[str, ...]] = {
    "setAdditionalSearchPath": ("path",),
    "loadMJCF": ("mjcfFileName",),
    "loadURDF": (),
    "loadSDF": (),
    "createCollisionShape": (),
    "createVisualShape": (),
    "createMultiBody": ("baseMass", "baseCollisionShapeIndex", "baseVisualShapeIndex"),
    "addUserDebugLine": (
        "lineFromXYZ", "lineToXYZ", "lineColorRGB", "lineWidth", "lifeTime", "parentObjectUniqueId", "parentLinkIndex",
        "replaceItemUniqueId",
    ),
    "removeUserDebugItem": ("itemUniqueId",),
    "removeAllUserDebugItems": ("physicsClientId",),
    "removeBody": ("bodyUniqueId",),
    "resetSimulation": ("flags",),
    "disconnect": ("physicsClientId",),
}  # fmt: skip
"""The logged functions, and the names of arguments that may be given by position."""


@dataclasses.dataclass
class DebugLine:
    """A line of addUserDebugLine."""

    start: Sequence[float]  # [m], in the frame of `link`, or else of the world
    end: Sequence[float]
    color: Sequence[float]  # RGB in [0, 1]
    link: tuple[int, int] | None  # body and link that it moves with
    is_short: bool  # whether it disappears by itself
    item: int  # the id that PyBullet returned: -1 without a window
    site: Site
    is_old: bool = False  # whether it was added before the present step


class BulletLog:
    """What PyBullet's functions were given since the environment was built."""

    def __init__(self) -> None:
        self.clients_before = frozenset(find_clients())  # they belong to others, unless something is loaded into them
        self.files: dict[Key, Path] = {}  # MJCF files, by client and body
        self.meshes: dict[Key, Mesh] = {}  # by client and body
        self._lines: dict[int, list[DebugLine]] = {}  # by client
        self._used: set[int] = set()  # clients
        self._folders: dict[int, str] = {}  # where a client searches for files
        self._shapes: dict[tuple[str, int, int], Mesh] = {}  # by function, client and shape

    def find_own_clients(self, most: int = MOST_CLIENTS) -> list[int]:
        """Return the connected clients that the environment made, or loaded bodies into, of those below `most`."""
        others = self.clients_before - self._used
        return [client for client in find_clients(most) if client not in others]

    def read_lines(self, client: int) -> list[DebugLine]:
        """Return the debug lines of a step; called once per step."""
        lines = self._lines.get(client, [])
        self._lines[client] = [line for line in lines if not line.is_short][-_MOST_LINES:]
        for line in lines:
            line.is_old = True
        return lines

    def note(self, name: str, given: Given, result: Any, site: Site) -> None:
        """Note a call that PyBullet accepted."""
        client = int(given.get("physicsClientId", 0))
        self._used.add(client)
        if name == "setAdditionalSearchPath":
            self._folders[client] = str(given["path"])
        elif name == "loadMJCF":
            file = self._find_file(client, str(given["mjcfFileName"]))
            self.files |= {(client, body): file for body in result}
        elif name in ("createCollisionShape", "createVisualShape"):
            if (mesh := _read_mesh(given)) is not None:
                self._shapes[name, client, result] = mesh
        elif name == "createMultiBody":
            visual = self._shapes.get(("createVisualShape", client, given.get("baseVisualShapeIndex", -1)))
            collision = self._shapes.get(("createCollisionShape", client, given.get("baseCollisionShapeIndex", -1)))
            if (mesh := visual or collision) is not None:
                self.meshes[client, result] = mesh
        elif name == "addUserDebugLine":
            self._add_line(client, given, result, site)
        elif name == "removeUserDebugItem":
            self._drop_lines(client, lambda line: line.is_old and line.item == given["itemUniqueId"])
        elif name == "removeBody":
            self.files.pop((client, given["bodyUniqueId"]), None)
            self.meshes.pop((client, given["bodyUniqueId"]), None)
        elif name in ("removeAllUserDebugItems", "resetSimulation", "disconnect"):
            self._lines.pop(client, None)
            if name != "removeAllUserDebugItems":
                for known in (self.files, self.meshes):
                    for key in [key for key in known if key[0] == client]:
                        del known[key]

    def _find_file(self, client: int, name: str) -> Path:
        folders = [Path(), Path(self._folders.get(client, "")), Path(pybullet_data.getDataPath())]
        return next((folder / name for folder in folders if (folder / name).is_file()), Path(name))

    def _add_line(self, client: int, given: Given, item: int, site: Site) -> None:
        if "replaceItemUniqueId" in given:  # without a window all ids are -1
            self._drop_lines(client, lambda line: line.is_old and line.site == site)
        body = given.get("parentObjectUniqueId", -1)
        line = DebugLine(
            start=given["lineFromXYZ"],
            end=given["lineToXYZ"],
            color=given.get("lineColorRGB", (0.0, 0.0, 0.0)),
            link=(body, given.get("parentLinkIndex", -1)) if body >= 0 else None,
            is_short=given.get("lifeTime", 0.0) > 0,
            item=item,
            site=site,
        )
        self._lines.setdefault(client, []).append(line)

    def _drop_lines(self, client: int, is_gone: Callable[[DebugLine], bool]) -> None:
        self._lines[client] = [line for line in self._lines.get(client, []) if not is_gone(line)]


def _read_mesh(given: Given) -> Mesh | None:
    scale = np.array(given.get("meshScale", (1.0, 1.0, 1.0)), np.float64)
    if given.get("vertices") is not None and given.get("indices") is not None:
        return Mesh(
            scale * np.array(given["vertices"], np.float64), np.array(given["indices"], np.int64).reshape(-1, 3)
        )
    rows, columns = given.get("numHeightfieldRows", 0), given.get("numHeightfieldColumns", 0)
    if given.get("heightfieldData") is None or min(rows, columns) < 2:
        return None
    heights = np.array(given["heightfieldData"], np.float64).reshape(columns, rows).T  # x goes fastest
    # Bullet puts the middle between the lowest and the highest point at the origin.
    x, y = (np.arange(count) - (count - 1) / 2 for count in heights.shape)
    points = np.stack([*np.meshgrid(x, y, indexing="ij"), heights - (heights.min() + heights.max()) / 2], axis=-1)
    return Mesh(scale * points.reshape(-1, 3), connect_grid(rows, columns))


@contextlib.contextmanager
def log_calls() -> Iterator[BulletLog]:
    """Log the calls of PyBullet inside the `with` block; they do what they did. Imports PyBullet where it is installed.

    It has to be imported before the environment's module, which may import single functions of it.
    """
    with contextlib.suppress(UsageError, ImportError):  # it is not installed: an environment that needs it will say so
        pybullet.isNumpyEnabled()
    log = BulletLog()

    def replace(name: str, function: Any) -> Any:
        if name not in _ARGUMENTS:
            return function

        def call(self: Any, *arguments: Any, **keywords: Any) -> Any:
            result = function(*arguments, **keywords)
            frame = sys._getframe(1)
            given = {**dict(zip(_ARGUMENTS[name], arguments, strict=False)), **keywords}
            log.note(name, given, result, (frame.f_code.co_filename, frame.f_lineno))
            return result

        return type(name, (Replacement,), {"__call__": call})()

    with replace_functions(replace):
        yield log
