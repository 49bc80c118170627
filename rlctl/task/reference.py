"""`Reference`: the clips that a task follows, a row per control step, for n worlds at once.

The rows of all clips are one table, one clip after the other; a world's place in it is the number of a row. Nothing
here is chance except `draw`, which draws from the generators of the episodes.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from rlctl.errors import TaskError
from rlctl.task.batch import WorldRngs
from rlctl.task.motion import MotionClip, align_signs
from rlctl.task.rotations import from_axis, invert, multiply, rotate, rotate_inverse
from rlctl.task.world_index import WorldIndex

Array = NDArray[np.float64]
ClipRows = NDArray[np.int64]
"""Numbers of rows of the clips."""
_UP = (0.0, 0.0, 1.0)
_DOWN = np.array([0.0, 0.0, -1.0])


@dataclasses.dataclass(frozen=True, eq=False)
class Deviation:
    """How far robots are from their rows of the reference, each of shape (worlds,); see `Reference.compare`."""

    joints: Array  # mean of the absolute differences of the joints [rad]
    joint_velocities: Array  # root of the mean square [rad/s]
    links: Array  # root of the mean square distance of the links, relative to the root [m]
    heights: Array  # largest difference of the heights of the root and the links above the ground [m]
    root_height: Array  # [m]
    tilt: Array  # angle between the directions of gravity in the frames of the roots [rad]
    velocity: Array  # of the root, in the frame of its heading [m/s]
    turning: Array  # of the root, in its own frame [rad/s]
    heading: Array  # angle between the headings [rad]
    place: Array  # distance of the roots on the ground [m]


class Reference:
    """Clips at the rate of control: joints by `joint_order`, the root, and links once `locate` has placed them.

    Raises `TaskError` for a clip that lacks a joint, or is shorter than two control steps.
    """

    near: ClassVar[float] = 1.5
    """[s], so long before a failure starts what a training starts near it."""
    least: ClassVar[float] = 0.5
    """[s], so long before the end of a clip the last start is."""

    def __init__(self, motions: Sequence[MotionClip], joint_order: Sequence[str], control_dt: float) -> None:
        self.control_dt, self.names = control_dt, [motion.name for motion in motions]
        clips = [motion.resample(1.0 / control_dt) for motion in motions]
        for clip in clips:
            if len(clip) < 3:
                raise TaskError(f"motion {clip.name}: {clip.duration:.3g} s, less than two control steps")
        lengths = [len(clip) for clip in clips]
        self.ends: ClipRows = np.cumsum(lengths) - 1
        """The last row of each clip."""
        self.starts: ClipRows = self.ends - lengths + 1
        self.clip_of: NDArray[np.int64] = np.repeat(np.arange(len(clips)), lengths)
        self.following: ClipRows = np.minimum(np.arange(sum(lengths)) + 1, self.ends[self.clip_of])
        """The row after each row; the last row of a clip follows itself."""
        self.joint_positions = np.concatenate([clip.take_joints(joint_order) for clip in clips])
        self.joint_velocities = self._differentiate(self.joint_positions)
        self.position = np.concatenate([clip.root_position for clip in clips])
        self.orientation = np.concatenate([align_signs(clip.root_orientation) for clip in clips])
        self.heading = find_heading(self.orientation)
        self._frame_velocity = self._differentiate(self.position)  # of the root's frame, in the world
        self.velocity = self._frame_velocity
        self.angular_velocity = self._find_angular_velocity()  # in the world
        self.turning = rotate_inverse(self.orientation, self.angular_velocity)  # in the frame of the root
        self.gravity = rotate_inverse(self.orientation, _DOWN)
        self.links = np.zeros((len(self), 0, 3))
        self.link_orientations = np.zeros((len(self), 0, 4))
        self.offset = np.zeros(3)  # from the frame of the root to its centre of mass
        self.link_names: list[str] = []
        last = self.ends[self.clip_of] - max(1, round(self.least / control_dt))
        numbers = np.arange(len(self))
        self.startable = numbers[numbers <= np.maximum(last, self.starts[self.clip_of])]

    def __len__(self) -> int:
        return len(self.clip_of)

    @property
    def duration(self) -> float:
        """Time from the first row to the last of the longest clip [s]."""
        return float((self.ends - self.starts).max() * self.control_dt)

    def _differentiate(self, values: Array) -> Array:
        rows = zip(self.starts, self.ends, strict=True)
        return np.concatenate([np.gradient(values[a : b + 1], self.control_dt, axis=0) for a, b in rows])

    def _find_angular_velocity(self) -> Array:
        found = np.zeros((len(self), 3))
        for start, end in zip(self.starts, self.ends, strict=True):
            rows = np.arange(start, end + 1)
            before, after = np.maximum(rows - 1, start), np.minimum(rows + 1, end)
            turn = multiply(self.orientation[after], invert(self.orientation[before]))
            turn = turn * np.where(turn[:, 3:] < 0, -1.0, 1.0)
            half = np.arctan2(np.linalg.norm(turn[:, :3], axis=1), turn[:, 3])
            length = np.maximum(np.sin(half), 1e-12)
            time = (after - before) * self.control_dt
            found[rows] = turn[:, :3] * (2 * half / length / time)[:, None]
        return found

    def locate(self, body: Any, links: Sequence[str]) -> None:
        """Compute where and how `links` of a body are in every row, and the velocity of the root's centre of mass.

        Call it in `build` of a `BatchTask`, as long as there is one world; it leaves the body in the first row. Joints
        of the body that the clips lack stay where they are.
        """
        one = np.zeros(1, np.int64)
        body.set_base(np.zeros((1, 3)), worlds=one)
        self.offset = -body.link_position(body.base_name)[0]
        # From the frame's each time: all worlds of a process share a reference, and each of them calls this.
        self.velocity = self._frame_velocity + np.cross(self.angular_velocity, rotate(self.orientation, self.offset))
        self.link_names = list(links)
        places, turns = np.zeros((len(self), len(links), 3)), np.zeros((len(self), len(links), 4))
        for row in (*range(len(self)), 0):
            self.place(body, np.array([row]), one)
            places[row] = self._find_links(body)[0]
            turns[row] = [body.link_orientation(link)[0] for link in links]
        self.links, self.link_orientations = places, turns

    def _find_links(self, body: Any) -> Array:
        """Return the positions of the links relative to the root's frame, in its heading, shape (worlds, links, 3)."""
        root = body.link_position(body.base_name)
        heading = find_heading(body.base_orientation)
        places = np.stack([body.link_position(link) for link in self.link_names], axis=1)
        return rotate_inverse(heading[:, None], places - root[:, None])

    def place(self, body: Any, rows: ClipRows, worlds: WorldIndex, joint_noise: Any = 0.0) -> None:
        """Put the body of some worlds where the rows have it, with its velocities; joints in the clips' order."""
        turn = self.orientation[rows]
        body.set_base(
            self.position[rows] + rotate(turn, self.offset),
            turn,
            velocity=self.velocity[rows],
            angular_velocity=self.angular_velocity[rows],
            worlds=worlds,
        )
        body.set_joints(self.joint_positions[rows] + joint_noise, self.joint_velocities[rows], worlds=worlds)

    def draw(self, rng: WorldRngs, levels: Array) -> ClipRows:
        """Draw the rows in which episodes start, shape (k,): any row, but not the last `least` seconds of a clip.

        A level below 1 is where an episode of the world failed, as `find_levels` returns it: half of the starts are
        then in the `near` seconds before it, in the same clip.
        """
        where, far, close = rng.uniform(0.0, 1.0, 3).T
        rows = self.startable[(far * len(self.startable)).astype(int)]
        failed = np.minimum((levels * len(self)).astype(int), len(self) - 1)
        first = np.maximum(failed - round(self.near / self.control_dt), self.starts[self.clip_of[failed]])
        again = first + (close * (failed - first + 1)).astype(int)
        again = self.startable[np.searchsorted(self.startable, again, side="right") - 1]
        chosen: ClipRows = np.where((levels < 1.0) & (where < 0.5), again, rows)
        return chosen

    def find_levels(self, rows: ClipRows, failed: NDArray[np.bool_]) -> Array:
        """Return the levels of the episodes after those that end in `rows`; 1 for one that did not fail."""
        return np.where(failed, (rows + 0.5) / len(self), 1.0)

    def compare(self, body: Any, rows: ClipRows) -> Deviation:
        """Return how far the bodies are from rows of shape (worlds,). Heading and place are not part of the others."""
        orientation = body.base_orientation
        heading, wanted = find_heading(orientation), self.heading[rows]
        root = body.link_position(body.base_name)
        joints = body.joint_positions - self.joint_positions[rows]
        speeds = body.joint_velocities - self.joint_velocities[rows]
        links = self._find_links(body) - self.links[rows]
        height = root[:, 2] - self.position[rows, 2]
        gravity = rotate_inverse(orientation, _DOWN)
        velocity = rotate_inverse(heading, body.base_velocity) - rotate_inverse(wanted, self.velocity[rows])
        turning = rotate_inverse(orientation, body.base_angular_velocity) - self.turning[rows]
        heights = np.abs(np.column_stack([height, links[:, :, 2] + height[:, None]])).max(axis=1)
        between = multiply(heading, invert(wanted))
        return Deviation(
            joints=np.abs(joints).mean(axis=1),
            joint_velocities=_root_mean_square(speeds),
            links=np.sqrt(np.square(links).sum(axis=2).mean(axis=1)),
            heights=heights,
            root_height=np.abs(height),
            tilt=np.arccos(np.clip((gravity * self.gravity[rows]).sum(axis=1), -1.0, 1.0)),
            velocity=np.linalg.norm(velocity, axis=1),
            turning=np.linalg.norm(turning, axis=1),
            heading=2 * np.abs(np.arctan2(between[:, 2], np.abs(between[:, 3]))),
            place=np.linalg.norm((root - self.position[rows])[:, :2], axis=1),
        )

    def tabulate(self) -> Mapping[str, Array]:
        """Return what a policy may see of the row after each row: tables of shape (rows, size), by name."""
        after = self.following
        velocity = rotate_inverse(self.heading, self.velocity)
        return {
            "joints": self.joint_positions[after],
            "motion": np.column_stack(
                [
                    self.joint_velocities[after],
                    self.gravity[after],
                    velocity[after],
                    self.turning[after],
                    self.position[after, 2],
                ]
            ),
        }


def find_heading(orientation: Array) -> Array:
    """Return the rotations about the vertical axis that orientations contain, shape (..., 4)."""
    x, y, z, w = np.moveaxis(orientation, -1, 0)
    return from_axis(_UP, np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)))


def _root_mean_square(values: Array) -> Array:
    found: Array = np.sqrt(np.square(values).mean(axis=1))
    return found
