"""The gripper of an arm: joints at its end whose links close on each other, how far, and where they hold a block."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from rlctl.errors import UsageError
from rlctl.tasks.linkage import Linkage
from rlctl.tasks.shapes import Array
from rlctl.tasks.surfaces import Surfaces

_FEWEST_OF_ARM = 2  # joints that carry a gripper
_MOST_JOINTS = 8  # of a gripper
_MOST_DRIVERS = 3
_STEPS = 33  # positions between open and closed that are looked at
_WIDEST_TURN = 1.1  # [rad], of a finger from closed to open
_COARSE = 4  # every so many points and positions, for a first look
_TOUCH = 2e-3  # [m], between points of surfaces that touch
_REMAINS = 0.35  # of the opening: fingers that come no nearer do not close
_OPEN = 0.5  # of the opening: where the gripper is open
_LEAST_OPENING = 8e-3  # [m]
_APPROACHES = 0.95  # of the opening: what comes no nearer was not meant as a gripper
_OUTER = 0.5  # of a jaw's length from its hinge: where it grips
_TILT = 0.4  # [rad], of the finger's face against a block
_SNAP = 0.3  # [rad], from an axis of the palm
_PAD = 3e-3  # [m], of surfaces that are a contact when the gripper is closed
_ACROSS = 0.5  # cosine: axes of hinges are across the direction in which fingers close
_LEAST_DEPTH, _CLEARANCE = 4e-3, 2e-3  # [m], of the grip above the tips, of the tips above the table
_WIDTHS = (0.008, 0.05)  # [m], of blocks


@dataclasses.dataclass(frozen=True)
class Gripper:
    """A gripper, and the block that it holds. Its frame is fixed to the palm.

    Axis x of the frame goes from one finger to the other, z from the palm to the finger tips. Positions are of all
    joints of the model [rad or m].
    """

    palm: str
    arm: list[int]  # joints that carry the palm, from the base on
    joints: list[int]
    drivers: list[int]  # joints whose positions define those of the others
    fingers: tuple[list[str], list[str]]  # links; the second ones may be the palm and what is fixed to it
    open: Array
    closed: Array
    holding: Array  # with the block's width between the fingers
    opening: float  # [m]
    frame: Array  # rotation matrix, palm's frame
    point: Array  # [m], palm's frame
    held_point: Array  # [m], of the middle of a block that is held, palm's frame
    depth: float  # of the finger tips beyond `point` [m]
    width: float  # of the block [m]
    height: float  # of the block [m]
    others: list[str]  # names of joints of other grippers

    @property
    def driven(self) -> list[int]:
        """The joints that motors of a task move, which are all; drivers go first."""
        return [*self.drivers, *(joint for joint in self.joints if joint not in self.drivers)]

    @property
    def has_fixed_finger(self) -> bool:
        """Whether one finger does not move, as on many small arms."""
        return self.palm in self.fingers[1]


@dataclasses.dataclass(frozen=True)
class _Closing:
    """Two groups of links that approach each other while a gripper's joints move."""

    palm: int  # the joint that carries the palm
    drivers: list[int]
    path: Array  # positions of all joints from open to closed, shape (n, joints)
    fingers: tuple[list[str], list[str]]
    gaps: Array  # [m], shape (n,)
    is_pair: bool  # both move

    @property
    def opening(self) -> float:
        return float(self.gaps.max())

    @property
    def closes(self) -> bool:
        is_closed = self.gaps.min() <= max(_TOUCH, _REMAINS * self.opening)
        # A wrist that bends to both sides is no gripper.
        is_open = self.gaps[0] >= _OPEN * self.opening
        return bool(is_closed and is_open and self.opening >= _LEAST_OPENING)


class GripperSearch:
    """Looks for the gripper of a model."""

    def __init__(self, linkage: Linkage, surfaces: Surfaces) -> None:
        self._linkage, self._surfaces = linkage, surfaces
        self._names: list[str] = linkage.body.joint_names
        self._rest = np.array([self._choose_rest(joint) for joint in range(linkage.count)])

    def _choose_rest(self, joint: int) -> float:
        low, high = self._linkage.find_ends(joint)
        return float(np.clip(0.0, low, high))

    def find(self, joint: str | None) -> Gripper:
        """Return the gripper, or the one to which a joint belongs; raises `UsageError` if there is none."""
        file = self._linkage.body.file.name
        closings = self._list_closings(joint)
        closing = [candidate for candidate in closings if candidate.closes]
        if closing:
            pairs = [candidate for candidate in closing if candidate.is_pair]
            chosen = min(pairs or closing, key=lambda one: len(self._linkage.list_beyond(one.palm)))
            others = [one for one in pairs or closing if not self._overlap(one, chosen)]
            return self._describe(chosen, sorted({self._names[one.drivers[0]] for one in others}))
        near = max(closings, key=lambda one: one.opening - float(one.gaps.min()), default=None)
        if near is None or near.opening < _LEAST_OPENING or near.gaps.min() > _APPROACHES * near.opening:
            which = "" if joint is None else f" with joint {joint!r}"
            raise UsageError(
                f"--model: {file}: no gripper{which}: no joint at its end moves a link towards another one; "
                "name one with --gripper JOINT, or without --pick make a task in which the arm reaches"
            )
        first, second = (fingers[-1] for fingers in near.fingers)
        raise UsageError(
            f"--model: {file}: the gripper never closes: between {first!r} and {second!r} remain "
            f"{1e3 * near.gaps.min():.0f} of {1e3 * near.opening:.0f} mm; correct the limits of "
            f"{self._list_names(near.drivers)}, or name another joint with --gripper JOINT"
        )

    def _overlap(self, one: _Closing, other: _Closing) -> bool:
        chains = [{candidate.palm, *self._linkage.list_beyond(candidate.palm)} for candidate in (one, other)]
        return bool(chains[0] & chains[1])

    def _list_names(self, joints: Sequence[int]) -> str:
        return ", ".join(repr(self._names[joint]) for joint in joints)

    def _list_closings(self, joint: str | None) -> list[_Closing]:
        """Return what moves towards each other at the end of an arm, one for each palm."""
        linkage, closings = self._linkage, []
        for palm in range(linkage.count):
            beyond = linkage.list_beyond(palm)
            is_arm = len(linkage.list_chain(palm)) >= _FEWEST_OF_ARM
            is_asked = joint is None or self._names.index(joint) in beyond
            if is_arm and is_asked and 0 < len(beyond) <= _MOST_JOINTS:
                closing = self._find_closing(palm, beyond)
                closings += [] if closing is None else [closing]
        return closings

    def _find_closing(self, palm: int, beyond: list[int]) -> _Closing | None:
        linkage = self._linkage
        drivers = linkage.choose_drivers(beyond)
        if not 0 < len(drivers) <= _MOST_DRIVERS:  # without any, joints nearer to the base move all of them
            return None
        groups = linkage.join_loops([self._list_finger(joint) for joint in beyond if linkage.parents[joint] == palm])
        fixed = linkage.list_links(palm)
        sets = [(one, other) for index, one in enumerate(groups) for other in groups[index + 1 :]]
        is_pair = bool(sets)
        if not is_pair and len(drivers) > 1:  # an arm's own joints, which bend it
            return None
        best: _Closing | None = None
        for ends in self._list_ends(drivers):
            path = self._make_path(beyond, drivers, ends)
            for one, other in sets or [(groups[0], fixed)]:
                found = _Closing(palm, drivers, path, (one, other), np.zeros(0), is_pair)
                gaps = self.measure_gaps(found, coarse=True)
                if gaps is None or gaps[0] < gaps[-1]:
                    continue
                found = dataclasses.replace(found, gaps=gaps)
                if best is None or _rank(found) > _rank(best):
                    best = found
        return best

    def _list_finger(self, joint: int) -> list[str]:
        joints = [joint, *self._linkage.list_beyond(joint)]
        return [link for each in joints for link in self._linkage.list_links(each)]

    def _list_ends(self, drivers: Sequence[int]) -> list[list[tuple[float, float]]]:
        """Return all choices of which end of each driver's range is open, and which closed."""
        choices: list[list[tuple[float, float]]] = [[]]
        for driver in drivers:
            low, high = self._linkage.find_ends(driver)
            choices = [[*before, ends] for before in choices for ends in ((low, high), (high, low))]
        return choices

    def _make_path(self, joints: Sequence[int], drivers: Sequence[int], ends: list[tuple[float, float]]) -> Array:
        """Return positions of all joints while the drivers go from one end to the other."""
        dependent = [joint for joint in joints if joint not in drivers]
        positions, path = self._rest.copy(), []
        for share in np.linspace(0.0, 1.0, _STEPS):
            positions[list(drivers)] = [start + share * (end - start) for start, end in ends]
            positions = self._linkage.close_loops(positions, dependent)
            path.append(positions.copy())
        return np.array(path)

    def measure_gaps(self, closing: _Closing, *, coarse: bool) -> Array | None:
        """Return the distances between the outer parts of two fingers along the path [m], None if one has no shapes.

        `coarse` is faster, and a few millimetres off.
        """
        every = _COARSE if coarse else 1
        first, second = (self.choose_outer(closing, finger) for finger in (0, 1))
        trees = {link: cKDTree(points) for link, points in second.items()}
        if not first or not second:
            return None
        gaps = []
        for positions in closing.path[::every]:
            self._linkage.place(positions)
            gap = np.inf
            for link, points in first.items():
                turn, origin = self._linkage.frame(link)
                world = points[::every] @ turn.T + origin
                for other, tree in trees.items():
                    turn, origin = self._linkage.frame(other)
                    distances = tree.query((world - origin) @ turn, distance_upper_bound=gap)[0]
                    gap = min(gap, float(np.min(distances)))
            gaps.append(gap)
        return np.array(gaps)

    def choose_outer(self, closing: _Closing, finger: int) -> dict[str, Array]:
        """Return the points with which a finger may grip, by link, in the links' frames.

        Fingers may touch at their roots. Those points of a finger that moves count that are in the outer half of its
        length from the wrist, or from the hinge of a finger that turns alone.
        """
        links = [link for link in closing.fingers[finger] if len(self._surfaces.list_points(link))]
        clouds = {link: self._surfaces.list_points(link) for link in links}
        if not clouds or (finger == 1 and not closing.is_pair):
            return clouds
        self._linkage.place(closing.path[len(closing.path) // 2])
        frames = {link: self._linkage.frame(link) for link in links}
        turns_alone = not closing.is_pair and not self._linkage.slides(closing.drivers[0])
        anchor, axis = self._linkage.axis(closing.drivers[0] if turns_alone else closing.palm)
        levers = {}
        for link, (turn, origin) in frames.items():
            way = clouds[link] @ turn.T + origin - anchor
            levers[link] = np.linalg.norm(np.cross(way, axis) if turns_alone else way, axis=1)
        every = np.concatenate(list(levers.values()))
        least = every.min() + _OUTER * np.ptp(every)
        return {link: clouds[link][lever > least] for link, lever in levers.items() if (lever > least).any()}

    def _describe(self, closing: _Closing, others: list[str]) -> Gripper:
        gaps = self.measure_gaps(closing, coarse=False)
        assert gaps is not None
        return _Description(self._linkage, self, dataclasses.replace(closing, gaps=gaps)).describe(others)


def _rank(closing: _Closing) -> tuple[bool, float]:
    return closing.closes, closing.opening - float(closing.gaps.min())


class _Description:
    """Finds the frame, the opening and the block of a gripper."""

    def __init__(self, linkage: Linkage, search: GripperSearch, closing: _Closing) -> None:
        self._linkage, self._closing = linkage, closing
        self._palm = linkage.list_links(closing.palm)[0]
        self._outer = search.choose_outer(closing, 0), search.choose_outer(closing, 1)
        touching = np.flatnonzero(closing.gaps <= max(_TOUCH, 1.2 * float(closing.gaps.min())))
        self._last = int(touching[0])
        self._first = self._find_first()
        self._pads = self._find_pads()

    def _find_first(self) -> int:
        """Return where the path begins: no finger turns further than `_WIDEST_TURN`."""
        path, closed = self._closing.path, self._closing.path[self._last]
        turning = [joint for joint in self._closing.drivers if not self._linkage.slides(joint)]
        turns = np.abs(path[:, turning] - closed[turning]).max(axis=1, initial=0.0)
        return int(np.flatnonzero(turns <= _WIDEST_TURN)[0])

    def _find_pads(self) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Return the indices of points of the fingers that are next to the other finger when the gripper is closed."""
        self._linkage.place(self._closing.path[self._last])
        first, second = (self._list_points(finger) for finger in (0, 1))
        distances = np.asarray(cKDTree(second).query(first)[0])
        near = float(distances.min()) + _PAD
        pad = np.flatnonzero(distances <= near)
        others = np.asarray(cKDTree(first[pad]).query(second)[0])
        return pad, np.flatnonzero(others <= near)

    def describe(self, others: list[str]) -> Gripper:
        path, linkage = self._closing.path, self._linkage
        at, width, depth, opening = self._last - 0.4 * (self._last - self._first), np.inf, 0.0, 0.0
        for _ in range(3):  # the frame depends on the width, and the width on the frame
            frame, middle = self._find_frame(at)
            linkage.place(self._interpolate(at))
            depth = self._choose_depth(self._find_tip(frame, middle), width)
            gaps = self._measure_faces(frame, middle, depth)
            opening = float(gaps[self._first])
            width = float(np.clip(self._limit_width(0.5 * opening, gaps), *_WIDTHS))
            at = self._find_index(gaps, width)
        wide = self._find_index(gaps, min(1.4 * width, 0.8 * opening))
        return Gripper(
            palm=self._palm,
            arm=linkage.list_chain(self._closing.palm),
            joints=linkage.list_beyond(self._closing.palm),
            drivers=self._closing.drivers,
            fingers=self._closing.fingers,
            open=path[self._first],
            closed=path[self._last],
            holding=self._interpolate(at),
            opening=opening,
            frame=frame,
            point=self._find_point(frame, middle, depth, wide),
            held_point=self._find_point(frame, middle, depth, at),
            depth=depth,
            width=width,
            height=2 * (depth + 0.15 * width + _CLEARANCE),
            others=others,
        )

    def _interpolate(self, at: float) -> Array:
        """Return positions of the path; its index may have a fraction."""
        path, start = self._closing.path, int(at)
        end = min(start + 1, len(path) - 1)
        result: Array = path[start] + (at - start) * (path[end] - path[start])
        return result

    def _find_index(self, gaps: Array, width: float) -> float:
        """Return where along the path, as an index with a fraction, the gap is `width`."""
        for index in range(self._first, self._last):
            if gaps[index] >= width > gaps[index + 1]:
                return index + float((gaps[index] - width) / (gaps[index] - gaps[index + 1]))
        return float(self._first)

    def _list_points(self, finger: int) -> Array:
        """Return points of a finger where it is now, in the palm's frame [m], shape (n, 3)."""
        palm, origin = self._linkage.frame(self._palm)
        clouds = []
        for link, points in self._outer[finger].items():
            turn, place = self._linkage.frame(link)
            clouds.append((points @ turn.T + place - origin) @ palm)
        return np.concatenate(clouds)

    def _find_frame(self, at: float) -> tuple[Array, Array]:
        """Return the frame as a rotation matrix, and the middle between the pads, in the palm's frame."""
        self._linkage.place(self._closing.path[self._last])
        closed, _ = self._locate_pads()
        self._linkage.place(self._interpolate(at))
        apart, middle = self._locate_pads()
        across = _snap((apart - closed) / np.linalg.norm(apart - closed))
        turn, origin = self._linkage.frame(self._palm)
        axes = [self._linkage.axis(joint) for joint in self._linkage.list_beyond(self._closing.palm)]
        # From the wrist: where the file puts the axis of a joint that slides means nothing.
        outwards = middle - (self._linkage.axis(self._closing.palm)[0] - origin) @ turn
        hinges = [axis @ turn for _, axis in axes if abs(axis @ turn @ across) < _ACROSS]
        if hinges and not all(map(self._linkage.slides, self._closing.drivers)):
            normal = np.cross(across, hinges[0])
            outwards = normal * np.sign(normal @ outwards)
        outwards = outwards - (outwards @ across) * across
        approach = _snap(outwards / np.linalg.norm(outwards))
        approach = approach - (approach @ across) * across
        approach /= np.linalg.norm(approach)
        return np.stack([across, np.cross(approach, across), approach], axis=1), middle

    def _locate_pads(self) -> tuple[Array, Array]:
        """Return the way from the middle of one pad to that of the other, and the middle of that way."""
        one, other = (self._list_points(finger)[self._pads[finger]].mean(axis=0) for finger in (0, 1))
        return one - other, (one + other) / 2

    def _list_in_frame(self, frame: Array, middle: Array) -> tuple[Array, Array]:
        """Return the points of both fingers in the gripper's frame, from `middle`."""
        first, second = ((self._list_points(finger) - middle) @ frame for finger in (0, 1))
        return first, second

    def _find_tip(self, frame: Array, middle: Array) -> float:
        """Return how far the shorter finger goes beyond `middle` [m]."""
        first, second = self._list_in_frame(frame, middle)
        return min(float(first[:, 2].max()), float(second[:, 2].max()))

    def _choose_depth(self, tip: float, width: float) -> float:
        """Return how far above the tips a block of `width` is held [m]; the pads' middle is `tip` above them."""
        if np.isinf(width):
            return max(tip, _LEAST_DEPTH)
        return float(np.clip(tip, max(_LEAST_DEPTH, 0.25 * width), 0.45 * width))

    def _find_inner(self, frame: Array, middle: Array, depth: float) -> tuple[float, float]:
        """Return where the inner faces of both fingers are along x [m], near the tips."""
        first, second = self._list_in_frame(frame, middle)
        tip = min(float(first[:, 2].max()), float(second[:, 2].max()))
        if not self._closing.is_pair:  # what of the palm is on the moving finger's side is no finger
            second = second[second[:, 0] < second[self._pads[1], 0].mean() + _PAD]
        sides = []
        for points in (first, second):
            near = (points[:, 2] > tip - 2 * depth) & (points[:, 2] < tip) & (np.abs(points[:, 1]) < depth)
            sides.append(points[near, 0] if near.any() else points[:, 0])
        return float(sides[0].min()), float(sides[1].max())

    def _measure_faces(self, frame: Array, middle: Array, depth: float) -> Array:
        """Return the distances between the inner faces along the path [m]."""
        faces = np.zeros(len(self._closing.path))
        for index in range(self._first, self._last + 1):
            self._linkage.place(self._closing.path[index])
            one, other = self._find_inner(frame, middle, depth)
            faces[index] = one - other
        return faces

    def _limit_width(self, width: float, faces: Array) -> float:
        """Return a width at which the fingers have turned against each other by `_TILT` at most since they touched."""
        self._linkage.place(self._closing.path[self._last])
        closed = self._find_turn()
        for index in range(self._last, self._first - 1, -1):
            self._linkage.place(self._closing.path[index])
            cosine = (np.trace(closed.T @ self._find_turn()) - 1) / 2
            if np.arccos(np.clip(cosine, -1, 1)) > _TILT:
                return min(width, float(faces[index]))
        return width

    def _find_turn(self) -> Array:
        """Return the orientation of the first finger's outermost link, seen from the other finger's."""
        frames = [self._linkage.frame(list(self._outer[finger])[-1])[0] for finger in (0, 1)]
        turn: Array = frames[1].T @ frames[0]
        return turn

    def _find_point(self, frame: Array, middle: Array, depth: float, at: float) -> Array:
        """Return the point between the fingers, `depth` above their tips, in the palm's frame."""
        self._linkage.place(self._interpolate(at))
        one, other = self._find_inner(frame, middle, depth)
        point: Array = middle + frame @ np.array([(one + other) / 2, 0.0, self._find_tip(frame, middle) - depth])
        return point


def _snap(direction: Array) -> Array:
    """Return the nearest axis of the palm's frame if it is near, else the direction."""
    axis = int(np.abs(direction).argmax())
    if abs(direction[axis]) < np.cos(_SNAP):
        return direction
    snapped = np.zeros(3)
    snapped[axis] = np.sign(direction[axis])
    return snapped
