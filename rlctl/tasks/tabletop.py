"""Where on a table an arm gets with its fingers down, a start above it, and how high it can bring a block."""

from __future__ import annotations

import dataclasses

import numpy as np

from rlctl.errors import UsageError
from rlctl.tasks.grippers import Gripper
from rlctl.tasks.linkage import Linkage
from rlctl.tasks.shapes import Array, Shapes

_TILTS = (0.0, 0.35, 0.7)  # [rad], of the fingers from straight down, outwards
_TILTED = 0.12  # [rad], by which the fingers may point elsewhere
_MISSED = 3e-3  # [m]
_STEPS = 80
_DAMPING, _CLOSE = 0.02, 1e-4
_PROGRESS = 0.85  # what is left after ten steps of a search that goes on
_LONGEST = 0.3  # [rad or m], of a step of one joint
_SEEDS = 6
_RADII = 10  # distances from the base that are tried
_LENGTH, _WIDTH = 0.3, 0.45  # of the reach: the area's size away from the base, and across
_SMALLEST = 0.08  # of the reach: an area shorter than this is none
_SHRINK, _TRIES = 0.85, 12
_STEP = 0.08  # of the reach, between poses on the way to a corner
_LOWEST = -3e-3  # [m], of shapes: those of fingers may be a little long
_START, _GOAL = 0.15, (0.1, 0.35)  # of the reach: heights of the start and of goals above the block


@dataclasses.dataclass(frozen=True)
class TableArea:
    """Where an arm works on the floor, z = 0."""

    low: Array  # [m], x and y of the area's corner
    high: Array
    goal_low: float  # [m], height of the block's middle
    goal_high: float
    start: Array  # positions of all joints, with the gripper open above the area's middle
    tilt: float  # [rad], of the fingers from straight down
    reach: float  # [m], from the base to the point between the fingers, at most
    outwards: Array  # direction from the base to the area, shape (2,)


class TableSearch:
    """Looks for the part of the table that an arm reaches; `height` [m] is added to where the model's file has it."""

    def __init__(self, linkage: Linkage, gripper: Gripper, *, height: float = 0.0) -> None:
        self._linkage, self._gripper, self._height = linkage, gripper, height
        body = linkage.body
        low, high = np.array([linkage.find_ends(joint) for joint in range(linkage.count)]).T
        margin = 0.03 * (high - low)
        self._low, self._high = low + margin, high - margin
        self._rest = gripper.open.copy()
        self._rest[gripper.arm] = np.clip(0.0, self._low, self._high)[gripper.arm]
        self._dofs = linkage.dofs[gripper.arm]
        moved = {body.find_link(link) for joint in range(linkage.count) for link in linkage.list_links(joint)}
        geoms = [geom for geom in body.parts.geoms if int(linkage.model.geom_bodyid[geom]) in moved]
        self._shapes = Shapes(linkage.model, geoms)
        self.reach = self._measure_reach()
        linkage.place(self._rest)
        self._base = linkage.axis(gripper.arm[0])[0][:2]

    def _measure_reach(self) -> float:
        """Return the distances between neighbouring joints, which no joint changes, and to the fingers, added [m]."""
        linkage, gripper = self._linkage, self._gripper
        linkage.place(self._rest)
        places = [linkage.axis(joint)[0] for joint in gripper.arm]
        turn, origin = linkage.frame(gripper.palm)
        places.append(origin + turn @ gripper.point)
        slides = sum(float(np.ptp(linkage.find_ends(joint))) for joint in gripper.arm if linkage.slides(joint))
        return float(np.linalg.norm(np.diff(places, axis=0), axis=1).sum()) + slides

    def find(self) -> TableArea | None:
        """Return the area, with the fingers as far down as possible; None if the arm does not reach the table."""
        height = self._gripper.height / 2
        for tilt in _TILTS:
            found = []
            for outwards in ([1.0, 0.0], [0.0, 1.0], [0.0, -1.0], [-1.0, 0.0]):
                direction = np.array(outwards)
                reached = self._try_radii(direction, tilt, height)
                if reached and reached[-1][0] - reached[0][0] > _SMALLEST * self.reach:
                    found.append((self._judge(reached[len(reached) // 2][1]), direction, reached))
            # It faces where its joints are near the middles of their ranges.
            for _, direction, reached in sorted(found, key=lambda one: one[0]):
                table = self._find_area(direction, tilt, height, reached)
                if table is not None:
                    return table
        return None

    def _try_radii(self, outwards: Array, tilt: float, height: float) -> list[tuple[float, Array]]:
        """Return the longest row of neighbouring distances from the base that are reached, and the poses there."""
        rng = np.random.default_rng(0)
        row: list[tuple[float, Array]] = []
        longest: list[tuple[float, Array]] = []
        for radius in np.linspace(0.2, 0.95, _RADII) * self.reach:
            point = np.array([*(self._base + radius * outwards), height])
            pose = self._search(point, outwards, tilt, rng, row[-1][1] if row else None)
            if pose is None:
                row = []
                continue
            row = [*row, (float(radius), pose)]
            if len(row) > len(longest):
                longest = row
        return longest

    def _search(
        self, point: Array, outwards: Array, tilt: float, rng: np.random.Generator, near: Array | None
    ) -> Array | None:
        arm = self._gripper.arm
        middle, seeds = (self._low + self._high) / 2, []
        for start in [self._rest, middle, *(rng.uniform(self._low, self._high) for _ in range(_SEEDS))]:
            seed = self._rest.copy()
            seed[arm] = start[arm]
            seeds.append(seed)
        if near is None and not any(self._approach(point, outwards, None, seed)[1] < _MISSED for seed in seeds[:3]):
            return None  # too far away
        if near is not None:
            seeds = [near, *seeds[:3]]
        found = [pose for seed in seeds if (pose := self._solve(point, outwards, tilt, seed)) is not None]
        if near is not None:
            return found[0] if found else None
        return min(found, key=self._judge, default=None)

    def _judge(self, pose: Array) -> float:
        """Return how far the joints are from the middles of their ranges."""
        arm = self._gripper.arm
        ranges = (self._high - self._low)[arm]
        shares = (pose - (self._low + self._high) / 2)[arm] / np.maximum(ranges, 1e-9)
        return float(np.sum(shares**4) + 0.02 * np.sum(np.abs(pose - self._rest)[arm]))

    def _solve(self, point: Array, outwards: Array, tilt: float | None, seed: Array) -> Array | None:
        """Return joint positions near `seed` with the fingers at a point, `tilt` from straight down; None if none."""
        pose, missed, turned = self._approach(point, outwards, tilt, seed)
        if missed > _MISSED or (tilt is not None and turned > _TILTED):
            return None
        self._linkage.place(pose)
        lowest = self._shapes.find_lowest(self._linkage.data) + self._height
        return pose if lowest > _LOWEST else None

    def _approach(self, point: Array, outwards: Array, tilt: float | None, seed: Array) -> tuple[Array, float, float]:
        """Move joints by damped least squares; return them, the distance left [m] and the angle left [rad]."""
        import mujoco

        linkage, gripper, pose = self._linkage, self._gripper, seed.copy()
        number = linkage.body.find_link(gripper.palm)
        lean = 0.0 if tilt is None else tilt
        wanted = np.array([*(np.sin(lean) * outwards), -np.cos(lean)])
        linear, angular = np.zeros((2, 3, linkage.model.nv))
        scale = 0.4 * self.reach  # [m/rad], of the angle's weight
        missed = turned = before = np.inf
        for step_number in range(_STEPS):
            linkage.place(pose)
            mujoco.mj_comPos(linkage.model, linkage.data)
            turn, origin = linkage.frame(gripper.palm)
            tip, axis = origin + turn @ gripper.point, turn @ gripper.frame[:, 2]
            way = point - tip - [0.0, 0.0, self._height]
            normal = np.cross(axis, wanted)
            sine = float(np.linalg.norm(normal))
            angle = float(np.arctan2(sine, axis @ wanted))
            missed, turned = float(np.linalg.norm(way)), angle
            if missed < _CLOSE and (tilt is None or angle < 0.01):
                break
            if step_number % 10 == 0:
                left = missed + (scale * turned if tilt is not None else 0.0)
                if left > _PROGRESS * before:
                    break
                before = left
            mujoco.mj_jac(linkage.model, linkage.data, linear, angular, tip, number)
            error, matrix = way, linear[:, self._dofs]
            if tilt is not None:
                # About the fingers' axis the gripper may turn as it likes.
                across = np.eye(3) - np.outer(axis, axis)
                error = np.concatenate([way, scale * normal * angle / max(sine, 1e-6)])
                matrix = np.concatenate([matrix, scale * across @ angular[:, self._dofs]])
            inverse = np.linalg.solve(matrix @ matrix.T + (_DAMPING * scale) ** 2 * np.eye(len(error)), error)
            step = matrix.T @ inverse
            step *= min(1.0, _LONGEST / max(float(np.abs(step).max()), 1e-9))
            arm = gripper.arm
            pose[arm] = np.clip(pose[arm] + step, self._low[arm], self._high[arm])
        return pose, missed, turned

    def _find_area(
        self, outwards: Array, tilt: float, height: float, reached: list[tuple[float, Array]]
    ) -> TableArea | None:
        radii = [radius for radius, _ in reached]
        middle = (radii[0] + radii[-1]) / 2
        centre_pose = min(reached, key=lambda pair: abs(pair[0] - middle))[1]
        centre = self._base + middle * outwards
        sideways = np.array([-outwards[1], outwards[0]])
        length, width = min(_LENGTH * self.reach, 0.9 * (radii[-1] - radii[0])), _WIDTH * self.reach
        for _ in range(_TRIES):
            corners = [
                centre + along * length / 2 * outwards + across * width / 2 * sideways
                for along in (-1, 1)
                for across in (-1, 1)
            ]
            if all(self._walk(centre, corner, height, outwards, tilt, centre_pose) is not None for corner in corners):
                return self._describe(centre, corners, height, outwards, tilt, centre_pose)
            length, width = _SHRINK * length, _SHRINK * width
        return None

    def _walk(
        self, start: Array, end: Array, height: float, outwards: Array, tilt: float | None, pose: Array
    ) -> Array | None:
        """Return the pose at the end of a way over the table; None if the arm cannot follow it."""
        count = max(2, int(np.ceil(np.linalg.norm(end - start) / (_STEP * self.reach))))
        for share in np.linspace(0.0, 1.0, count + 1):
            place = start + share * (end - start)
            away = place - self._base
            away = away / max(float(np.linalg.norm(away)), 1e-9)
            found = self._solve(np.array([*place, height]), away, tilt, pose)
            if found is None:
                return None
            pose = found
        return pose

    def _describe(
        self, centre: Array, corners: list[Array], height: float, outwards: Array, tilt: float, pose: Array
    ) -> TableArea:
        start = self._raise(centre, height, height + _START * self.reach, outwards, tilt, pose)
        highest = self._find_highest(centre, corners, height, outwards, start)
        low, high = np.min(corners, axis=0), np.max(corners, axis=0)
        goal_low = min(height + _GOAL[0] * self.reach, (height + highest) / 2)
        return TableArea(low, high, goal_low, highest, start, tilt, self.reach, outwards)

    def _raise(self, place: Array, height: float, to: float, outwards: Array, tilt: float | None, pose: Array) -> Array:
        """Return the pose as high above a place as it gets, at most at `to`."""
        for level in np.linspace(height, to, 6)[1:]:
            found = self._solve(np.array([*place, level]), outwards, tilt, pose)
            if found is None:
                break
            pose = found
        return pose

    def _find_highest(self, centre: Array, corners: list[Array], height: float, outwards: Array, start: Array) -> float:
        """Return a height that the arm reaches above the whole area, the fingers pointing anywhere."""
        highest = height + _GOAL[1] * self.reach
        for _ in range(_TRIES):
            if all(self._walk(centre, corner, highest, outwards, None, start) is not None for corner in corners):
                return highest
            highest = height + _SHRINK * (highest - height)
        return highest


def find_table(linkage: Linkage, gripper: Gripper, height: float, hanging: float) -> tuple[TableArea, float]:
    """Return the area on the table, and by how much the base is raised [m].

    `height` brings what is below the table onto it; `hanging` is how far the base is above the table otherwise, from
    which it is lowered if the arm does not get down. Raises `UsageError` if it does not reach the table then.
    """
    choices = [height]
    if hanging > 0.01:
        choices.append(-hanging)
    search = TableSearch(linkage, gripper, height=height)
    for choice in choices:
        search = TableSearch(linkage, gripper, height=choice)
        table = search.find()
        if table is not None:
            return table, choice
    raise UsageError(
        f"--model: {linkage.body.file.name}: the arm cannot reach the table, z = 0, with its fingers down: it reaches "
        f"{search.reach:.2g} m, from a base {max(hanging, 0.0):.2g} m above; correct the joints' limits or the base's "
        "height, or give another point between the fingers with --tip FRAME"
    )
