"""The arm of a robot model: which link is its tip, which joints are a gripper's, and how far it reaches."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from rlctl.errors import UsageError
from rlctl.tasks.shapes import Array, Shapes, list_points

if TYPE_CHECKING:
    from rlctl.task.mujoco.body import MujocoBody

_FINGERS = ("finger", "jaw", "claw", "knuckle", "thumb")  # in names of links and joints
_GRIPPER = "gripper"  # in names of joints; a link of that name is also the palm
_SENSORS = ("camera", "optical", "sensor", "lidar", "laser", "realsense", "depth")
_SENSOR_WORDS = {"cam", "imu", "rgb", "zed"}  # whole words of a name
_TOOLS = ("tool", "grasp", "effector")
_TOOL_WORDS = {"tcp", "ee", "eef", "tip"}
_MOST_OF_FINGER, _FEWEST_OF_ARM = 2, 3  # joints: of fingers that have no name, of the arm that carries them
_STILL = 1e-3  # [m]: a tip that moves less does not move
_ENDLESS_TRAVEL = 2.0  # [m], of a slide without limits


@dataclasses.dataclass(frozen=True)
class Tip:
    """A link, and the point of it that goes to a goal."""

    link: str
    point: Array | None  # [m], shape (3,), in the frame of the link; None for its origin
    site: str = ""  # the site of an MJCF file that the point is

    def __str__(self) -> str:
        if self.site:
            return f"{self.site!r} of {self.link!r}"
        return repr(self.link) if self.point is None else f"the end of {self.link!r}"


class ArmModel:
    """A body in MuJoCo whose joints are moved, to find out what it can do."""

    def __init__(self, body: MujocoBody) -> None:
        self.body, self._sim = body, body._sim
        self._model, self._data = body._sim.model, body._sim.data
        self._numbers = np.array(body.parts.joints, int)
        self._owners = [int(self._model.jnt_bodyid[joint]) for joint in self._numbers]

    def list_joints_to(self, link: str) -> list[int]:
        """Return the indices of the joints that move a link, from the base on."""
        chain, number = set(), self.body.find_link(link)
        while number:
            chain.add(number)
            number = int(self._model.body_parentid[number])
        return [index for index, owner in enumerate(self._owners) if owner in chain]

    def find_tip(self) -> str:
        """Return the link at the end of the longest chain that has no gripper's joint.

        Frames without shapes that are called after a tool go first, then other frames; those of sensors are left out.
        """
        chains = {link: self.list_joints_to(link) for link in self.body.link_names}
        gripper = self._find_gripper(chains)
        moved = [link for link, chain in chains.items() if chain and not gripper & set(chain)]
        moved = moved or [link for link, chain in chains.items() if chain]
        seen = [link for link in moved if not _is_sensor(link)] or moved
        parents = {self._find_parent(link) for link in seen}
        ends = [link for link in seen if link not in parents] or seen

        def judge(link: str) -> tuple[int, bool, bool]:
            is_frame = self._model.body_geomnum[self.body.find_link(link)] == 0
            return len(chains[link]), is_frame and _is_tool(link), is_frame

        return max(ends, key=judge)

    def _find_parent(self, link: str) -> str:
        names: dict[int, str] = self.body.parts.link_names
        return names.get(int(self._model.body_parentid[self.body.find_link(link)]), "")

    def _find_gripper(self, chains: dict[str, list[int]]) -> set[int]:
        """Return the joints of grippers: those called so, and short chains beside each other at the end of an arm."""
        names, links = self.body.joint_names, self.body.parts.link_names
        called = {
            index
            for index, name in enumerate(names)
            if _has(name, (*_FINGERS, _GRIPPER)) or _has(links[self._owners[index]], _FINGERS)
        }
        beyond: dict[int, set[int]] = {index: set() for index in range(len(names))}
        for chain in chains.values():
            for place, joint in enumerate(chain):
                beyond[joint] |= set(chain[place + 1 :])
        gripper = {joint for joint in called if beyond[joint] <= called}
        before = {chain[-1]: tuple(chain[:-1]) for chain in chains.values() if chain}
        for arm in set(before.values()):
            fingers = [joint for joint, chain in before.items() if chain == arm]
            is_short = all(len(beyond[joint]) < _MOST_OF_FINGER for joint in fingers)
            if len(fingers) > 1 and is_short and len(arm) >= _FEWEST_OF_ARM:
                gripper |= {other for joint in fingers for other in (joint, *beyond[joint])}
        return gripper

    def list_sites(self) -> dict[str, Tip]:
        """Return the sites of an MJCF file that joints move."""
        tips = {}
        for number in range(self._model.nsite):
            name = self._model.site(number).name.partition("/")[2]
            link = self.body.parts.link_names.get(int(self._model.site_bodyid[number]), "")
            if name and link in self.body.link_names and self.list_joints_to(link):
                tips[name] = Tip(link, np.round(self._model.site_pos[number], 6) + 0.0, name)
        return tips

    def choose_point(self, link: str) -> Tip:
        """Return a link with the last of its sites that is called after a tool, or with its origin, or with the end of
        its shapes, if the link's own joint moves that, but not the origin.

        Raises `UsageError` if no joint moves any of these.
        """
        tools = [tip for name, tip in self.list_sites().items() if tip.link == link and _is_tool_site(name)]
        if tools:
            return tools[-1]
        origin, end, own = Tip(link, None), self._find_end(link), self.list_joints_to(link)[-1:]
        turns_only = end is not None and self.moves(Tip(link, end), own) and not self.moves(origin, own)
        if turns_only:
            return Tip(link, end)
        if not self.moves(origin):
            raise UsageError(f"--link {link!r}: it only turns on the spot; choose another of: {self._list_moved()}")
        return origin

    def _list_moved(self) -> str:
        return ", ".join(link for link in self.body.link_names if self.moves(Tip(link, None))) or "none moves"

    def moves(self, tip: Tip, joints: Sequence[int] | None = None) -> bool:
        """Return whether joints, all by default, move a tip where the others are in several places."""
        rng = np.random.default_rng(0)
        low, high = self.find_range()
        moved = range(len(low)) if joints is None else joints
        for _ in range(5):
            places, pose = [], rng.uniform(low, high)
            for _ in range(2):
                pose[moved] = rng.uniform(low, high)[moved]
                self.body.set_joints(pose)
                places.append(self.locate(tip))
            if np.ptp(places, axis=0).max() > _STILL:
                return True
        return False

    def _find_end(self, link: str) -> Array | None:
        """Return the point of a link's shapes that is farthest from its origin, along the way to their middle."""
        number = self.body.find_link(link)
        geoms = [geom for geom in range(self._model.ngeom) if self._model.geom_bodyid[geom] == number]
        if not geoms:
            return None
        points = np.concatenate([list_points(self._model, geom)[0] for geom in geoms])
        middle = (points.min(axis=0) + points.max(axis=0)) / 2
        distance = float(np.linalg.norm(middle))
        if distance < _STILL:
            return None
        direction = middle / distance
        return np.round(direction * float((points @ direction).max()), 3) + 0.0  # no -0.0

    def locate(self, tip: Tip) -> Array:
        """Return where a tip is [m], shape (3,)."""
        origin = self.body.link_position(tip.link)
        if tip.point is None:
            return origin
        frame: Array = self._data.xmat[self.body.find_link(tip.link)].reshape(3, 3)
        return origin + frame @ tip.point

    def measure_reach(self, tip: Tip) -> tuple[float, float]:
        """Return how far from its base, and from the world's origin, the tip can get at most [m].

        The distances between neighbouring joints, which no joint changes, are added.
        """
        joints = self._numbers[self.list_joints_to(tip.link)]
        self.body.set_joints(np.zeros(len(self._numbers)))
        end = self.locate(tip)
        places = np.array([*self._data.xanchor[joints], end])
        length = float(np.linalg.norm(np.diff(places, axis=0), axis=1).sum())
        for joint in joints[self._model.jnt_type[joints] == 2]:
            is_limited = bool(self._model.jnt_limited[joint])
            length += float(np.abs(self._model.jnt_range[joint]).max()) if is_limited else _ENDLESS_TRAVEL
        base = self.body.link_position(self.body.base_name)
        return float(np.linalg.norm(places[0] - base)) + length, float(np.linalg.norm(places[0])) + length

    def find_range(self) -> tuple[Array, Array]:
        """Return the lower and the upper end of positions inside the limits, 1 rad or m where there are none."""
        low, high = self.body.joint_low, self.body.joint_high
        bounded = np.isfinite(low) & np.isfinite(high)
        low, high = np.where(bounded, low, -1.25), np.where(bounded, high, 1.25)
        return 0.9 * low + 0.1 * high, 0.1 * low + 0.9 * high

    def list_moving_shapes(self) -> Shapes:
        """Return the collision shapes that joints move."""
        moved = {self.body.find_link(link) for link in self.body.link_names if self.list_joints_to(link)}
        geoms = [geom for geom in self.body.parts.geoms if int(self._model.geom_bodyid[geom]) in moved]
        return Shapes(self._model, geoms)

    def find_lowest(self, shapes: Shapes) -> float:
        """Return the height of the lowest point of shapes [m]; infinite without shapes."""
        self._sim.world.refresh()
        return shapes.find_lowest(self._data)

    def has_plane(self) -> bool:
        """Return whether the model, which is all of the world, has a floor of its own."""
        plane: Any = self._sim.mujoco.mjtGeom.mjGEOM_PLANE
        return int(plane) in self._model.geom_type.tolist()


def _has(name: str, parts: Iterable[str]) -> bool:
    return any(part in name.lower() for part in parts)


def _list_words(name: str) -> set[str]:
    return set(re.findall("[a-z]+", re.sub("([a-z])([A-Z])", r"\1 \2", name).lower()))


def _is_sensor(link: str) -> bool:
    return _has(link, _SENSORS) or bool(_list_words(link) & _SENSOR_WORDS)


def _is_tool(link: str) -> bool:
    return _has(link, _TOOLS) or bool(_list_words(link) & _TOOL_WORDS)


def _is_tool_site(name: str) -> bool:
    return _is_tool(name) or _has(name, (_GRIPPER, "pinch", "attachment"))
