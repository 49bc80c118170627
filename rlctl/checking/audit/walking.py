"""Plays of robots with a free base: the engine holds them, moves them as commanded, or lays them down."""

import dataclasses
from collections.abc import Callable

import numpy as np

from rlctl.checking.audit.play_world import Array, PlayWorld
from rlctl.task.body import Body
from rlctl.task.rotations import from_axis, multiply, roll_pitch_yaw, rotate

SETTLE_S = 0.4  # [s], in which a robot comes to stand after a reset
TILT, HEIGHT = 0.35, 0.7  # [rad], part of the height at the start: what is lower or more askew has fallen
LYING = 0.4  # part of the height at which a base stands: the least height at which it is laid down
UP = (0.0, 0.0, 1.0)
SIDES = {
    "on its back": from_axis((1, 0, 0), np.pi),
    "on its left side": from_axis((1, 0, 0), -np.pi / 2),
    "on its right side": from_axis((1, 0, 0), np.pi / 2),
}
"""Rotations of a robot that stands."""


def find_walker(world: PlayWorld) -> Body | None:
    """Return the robot with a free base: the one of most joints; None if there is none."""
    bodies = [] if world.sim is None else [body for body in world.sim.bodies.values() if not body.fixed]
    walkers = [body for body in bodies if body.joint_names]
    return max(walkers, key=lambda body: len(body.joint_names), default=None)


@dataclasses.dataclass(frozen=True)
class SettledPose:
    """How a robot stands once it has settled after a reset."""

    position: Array  # [m], of the base's centre of mass
    orientation: Array  # quaternion (x, y, z, w)
    joints: Array  # [rad] or [m]
    ground: float  # [m], where its lowest link is

    @property
    def yaw(self) -> float:
        """The direction in which it looks [rad]."""
        return roll_pitch_yaw(self.orientation.tolist())[2]


def find_stance(world: PlayWorld, body: Body, settle: Callable[[int], None]) -> SettledPose:
    """Return how a robot stands in the episode that has begun, after some steps of `settle` unless it falls."""
    start = _read_stance(body)
    settle(max(1, round(SETTLE_S / world.control_dt)))
    settled = _read_stance(body)
    tilt = np.arccos(np.clip(rotate(settled.orientation, UP) @ rotate(start.orientation, UP), -1.0, 1.0))
    has_fallen = tilt > TILT or settled.position[2] < HEIGHT * start.position[2]
    return start if has_fallen else settled


def _read_stance(body: Body) -> SettledPose:
    heights = [body.link_position(link)[2] for link in body.link_names]
    place = body.base_position.copy(), body.base_orientation.copy()
    return SettledPose(*place, body.joint_positions.copy(), float(min(heights, default=place[0][2])))


class Glide:
    """Moves a robot at a velocity as if it followed perfectly; at 0 it holds it."""

    def __init__(
        self,
        body: Body,
        stance: SettledPose,
        dt: float,
        read_velocity: Callable[[], Array],
        *,
        holds_joints: bool = True,
    ) -> None:
        """`read_velocity` returns forwards, to the left [m/s] and turning [rad/s], shape (3,)."""
        self._body, self._stance, self._dt = body, stance, dt
        self._read_velocity, self._holds_joints = read_velocity, holds_joints
        self._position, self._turned = stance.position.copy(), 0.0

    def start(self) -> None:
        """Put the robot where it begins."""
        self._place(np.zeros(3), 0.0)
        self._body.set_joints(self._stance.joints)

    def move(self, step: int) -> None:
        """Put the robot where it is after a step."""
        forwards, left, turning = self._read_velocity().tolist()
        self._turned += turning * self._dt
        velocity = rotate(from_axis(UP, self._stance.yaw + self._turned), (forwards, left, 0.0))
        self._position = self._position + velocity * self._dt
        self._place(velocity, turning)
        if self._holds_joints:
            self._body.set_joints(self._stance.joints)

    def _place(self, velocity: Array, turning: float) -> None:
        orientation = multiply(from_axis(UP, self._turned), self._stance.orientation)
        self._body.set_base(self._position, orientation)
        self._body.add_velocity(velocity, (0.0, 0.0, turning))


def lay_down(body: Body, stance: SettledPose, rotation: Array, lowest: float = LYING) -> None:
    """Turn a robot that stands by a rotation about its base, just above the ground."""
    height = stance.position[2] - stance.ground
    place = np.array([*stance.position[:2], stance.position[2]])
    orientation = multiply(rotation, stance.orientation)
    body.set_base(place, orientation)
    links = [body.link_position(link)[2] - place[2] for link in body.link_names]
    above = max(-min(links, default=0.0), lowest * height)
    place[2] = stance.ground + above
    body.set_base(place, orientation)
