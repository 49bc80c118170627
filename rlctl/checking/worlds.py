"""A simulated world as the rules see it: bodies, joints, contacts, motors, and what a reader of an engine provides.

There are two readers: `bullet_worlds.BulletStateReader` and `mujoco_worlds.MujocoStateReader`.
"""

import dataclasses
from collections.abc import Sequence
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from rlctl.task.joints import WIDEST_RANGE

MOST_BODIES, MOST_JOINTS = 20, 60  # So many of a world, and of a body, are read; robots and free bodies first
MOST_LINKS = 30  # So many links of a robot are read for their orientation
LONGEST_S, MOST_STEPS = 0.1, 100  # simulated without the environment: overlapping bodies are thrown out by then

Array = NDArray[np.float64]
Link = tuple[int, int]  # Body id and link index; the base is link -1
Pair = tuple[Link, Link]
JointKey = tuple[int, int]  # Body id and joint index
Poses = dict[Link, Array]
"""By link: the position of its frame [m], its quaternion x, y, z, w, and the position of its centre of mass [m]. Shape
(10,) each."""
ORIENTATION = slice(3, 7)
FRAME, CENTRE, TURN, LINEAR, TURNING = slice(0, 3), slice(3, 6), slice(6, 10), slice(10, 13), slice(13, 16)
"""Where in a row of `StateReader.read_points` the position of its frame [m], that of its centre of mass [m], its
quaternion x, y, z, w, and the velocity of its centre [m/s] and its angular velocity [rad/s] are, all in the world."""
VELOCITY, ANGULAR, JOINTS = slice(3, 6), slice(6, 9), 9
"""Where in a body's state its base's velocity [m/s] and angular velocity [rad/s] are, after its position, and where its
joints' begin: all positions, then all speeds [rad, rad/s; m, m/s]."""


@dataclasses.dataclass(frozen=True)
class Joint:
    """A joint that moves, of one degree of freedom."""

    index: int
    name: str
    is_angle: bool
    low: float
    high: float
    link: str = ""  # The name of the part that it moves, where a body is a tree of named ones
    effort: float = 0.0  # The most that its model allows its motor [N m], [N]; 0 where it does not say

    @property
    def has_limits(self) -> bool:
        """Whether its model declares limits."""
        return self.low < self.high and self.high - self.low < WIDEST_RANGE


@dataclasses.dataclass(frozen=True)
class WorldBody:
    """A body of a world, as it was loaded; in MuJoCo a tree of bodies."""

    id: int
    name: str
    links: tuple[str, ...]  # The base first: link `i` is `links[i + 1]`
    joints: tuple[Joint, ...]
    is_free: bool  # Whether its base is not fixed to the world
    has_heavy_links: bool  # Whether it has joints, and anything beside its base has a mass

    def name_joint(self, joint: Joint) -> str:
        """Return `elbow of lower`: a joint with the part that it moves, or with the whole body."""
        return f"{joint.name} of {joint.link or self.name}"


@dataclasses.dataclass(frozen=True)
class JointActuator:
    """An actuator of MuJoCo that moves a joint."""

    number: int  # Its place in ctrl
    name: str
    joint: Joint
    body: int
    holds_position: bool  # Whether its input is a position, and not a force
    gear: float  # Input per position of the joint
    low: float  # Of its input; infinite where it has no range
    high: float


@dataclasses.dataclass(frozen=True)
class World:
    """The bodies of one simulation."""

    client: int  # Of PyBullet; 0 in MuJoCo
    bodies: tuple[WorldBody, ...]
    engine: str = "PyBullet"
    motors: tuple[
        JointActuator, ...
    ] = ()  # In MuJoCo, the actuators in the order of `ctrl`; all move a joint, or it is empty

    @property
    def key(self) -> tuple[Any, ...]:
        """Equal for worlds that are built alike."""
        return tuple((body.name, body.links) for body in self.bodies)

    def link_name(self, link: Link) -> str:
        """Return how to write a link: `tip of arm`."""
        for body in self.bodies:
            if body.id == link[0]:
                name = body.links[link[1] + 1] or "base"
                return f"{name} of {body.name}" if len(body.links) > 1 and name != body.name else body.name
        return f"link {link[1]} of body {link[0]}"


@dataclasses.dataclass(frozen=True)
class Jump:
    """How fast a free body became right after a reset, without any action."""

    body: str
    speed: float  # [m/s]
    explained: float  # The speed that it had, and that falling adds [m/s]
    after_s: float
    seed: int


class MotorTarget(NamedTuple):
    """The position that a joint's motor is told to reach [rad], [m]."""

    value: float
    force: float  # The most that its motor has [N m], [N]
    giver: str  # What gives it: a function of PyBullet, or an actuator of MuJoCo
    where: tuple[str, int] | None = None  # File and line of the call, where they are known


class MotorStrength(NamedTuple):
    """The most that a joint's motor can do, in whatever way it is driven."""

    force: float  # [N m], [N]
    is_driven: bool  # Whether it is told other speeds than 0, or a force
    where: tuple[str, int] | None = None  # File and line of the call, where they are known


class StateReader(Protocol):
    """What the rules need from an engine: the values of one world at the last `update`."""

    world: World

    @property
    def errors(self) -> tuple[type[Exception], ...]:
        """What the methods raise where the world is gone."""

    def update(self) -> None:
        """Take the present values."""

    def read_states(self) -> list[Array]:
        """Return the state of each body. Shape (9 + 2 * joints,) each."""

    def read_poses(self) -> Poses:
        """Return the pose of each base that is free, and of each link of a robot."""

    def name_points(self) -> list[str]:
        """Name the rows of `read_points`."""

    def read_points(self) -> Array:
        """Return place and velocity of each link of a robot, each base that is free, and each site. Shape (n, 16)."""

    def throw(self, bodies: Sequence[WorldBody], velocities: Array) -> None:
        """Give free bodies velocities and angular velocities, shape (n, 6), in the environment's own simulation."""

    def read_before(self) -> tuple[list[Array], Poses] | None:
        """Return states and poses before the last call that advanced the physics; None where they are not known, or the
        environment could not read them."""

    def read_contacts(self) -> dict[Pair, float]:
        """Return the deepest distance per pair of links that touch [m]; below zero they are inside each other."""

    def read_overlaps(self) -> dict[Pair, float]:
        """Return the deepest distance per pair of links that are inside each other [m], of a free body and another one,
        also right after they were placed."""

    def find_thickness(self, pair: Pair) -> float:
        """Return the smallest extent of the thinner of two links [m]."""

    def read_targets(self) -> dict[JointKey, MotorTarget]:
        """Return the present target of each motor that has one."""

    def read_strengths(self) -> dict[JointKey, MotorStrength]:
        """Return the strength of each motor whose force is limited; the largest since the environment was built."""

    def read_command(self) -> Array | None:
        """Return what was last written for all motors of `World.motors`; None where that is not known."""

    def read_weights(self) -> dict[JointKey, float]:
        """Return the force that holds each joint of the robots with a fixed base still [N m], [N]."""

    def read_physics(self) -> tuple[list[float], float]:
        """Return the gravity [m/s^2], and how long one step of the physics is [s]."""

    def read_time(self) -> float:
        """Return how long was simulated [s]."""

    def read_failure(self) -> str:
        """Return what the engine itself says is wrong with the simulation; empty for nothing."""

    def weight_matters(self) -> bool:
        """Say whether gravity would change the motion of a world without it; the world is restored."""

    def find_jumps(self, seed: int) -> list[Jump]:
        """Return how fast each free body becomes without the environment; the world may be changed by it."""
