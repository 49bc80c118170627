"""Plays of arms: what the task calls success is found by inverse kinematics, or by placing an object at the goal."""

import dataclasses
import math
import re
from collections.abc import Callable, Iterator

import numpy as np
from numpy.typing import NDArray

from rlctl.checking.audit.play_world import Array, PlayWorld, Script
from rlctl.checking.values import read_attributes
from rlctl.policy.actor import Actor, Rows, as_stored
from rlctl.policy.named_actors import ZeroActor
from rlctl.task.body import Body
from rlctl.task.joints import Joints

HOLD_S, FEWEST_STEPS = 1.0, 3  # how long a goal is held until it must count as a success
MOST_LINKS, MOST_TARGETS = 8, 4
CLOSE = 0.01  # [m], how near inverse kinematics has to come
SOLUTIONS = 4  # times that inverse kinematics is continued
BISECTIONS, BEYOND = 6, 1.3  # of the way between goal and start; how much farther than where success ends
SPEED = 1.0  # [rad/s, m/s], where the model has no limit
LONGEST_WAY = 0.5  # part of the episode
QUICK = 5.0  # [1/s], how fast an error is driven away at speeds
GOALS = re.compile(r"(?i)(goal|target|desired)")
AXES = ("x", "y", "z")


class Mover:
    """What is brought to a goal: a link of an arm, by its joints, or an object."""

    body: Body

    def solve(self, target: Array) -> Array | None:
        """Return the state in which it is at a target [m]; None if it does not get there. The world is changed."""
        raise NotImplementedError

    def read(self) -> Array:
        """Return the present state."""
        raise NotImplementedError

    def place(self, state: Array, speed: Array) -> None:
        """Set the state."""
        raise NotImplementedError

    @property
    def speeds(self) -> Array:
        """How fast each number of the state may change."""
        raise NotImplementedError


class LinkMover(Mover):
    """A link of an arm; the state is the positions of the joints."""

    def __init__(self, body: Body, link: str) -> None:
        self.body, self.link = body, link

    def solve(self, target: Array) -> Array | None:
        """See `Mover`."""
        for _ in range(SOLUTIONS):
            joints = self.body.solve_inverse_kinematics(self.link, target)
            joints = np.clip(joints, self.body.joint_low, self.body.joint_high)
            self.body.set_joints(joints)
            if np.linalg.norm(self.body.link_position(self.link) - target) < CLOSE:
                return joints
        return None

    def read(self) -> Array:
        """See `Mover`."""
        return self.body.joint_positions.copy()

    def place(self, state: Array, speed: Array) -> None:
        """See `Mover`."""
        self.body.set_joints(state, speed)

    @property
    def speeds(self) -> Array:
        """See `Mover`."""
        limits = self.body.joint_max_speed
        return np.where((limits > 0) & np.isfinite(limits), limits, SPEED)


class ObjectMover(Mover):
    """A body without joints; the state is its position."""

    def __init__(self, body: Body) -> None:
        self.body = body
        self._orientation = body.base_orientation.copy()

    def solve(self, target: Array) -> Array | None:
        """See `Mover`."""
        return target.copy()

    def read(self) -> Array:
        """See `Mover`."""
        return self.body.base_position.copy()

    def place(self, state: Array, speed: Array) -> None:
        """See `Mover`."""
        self.body.set_base(state, self._orientation)
        self.body.add_velocity(speed)

    @property
    def speeds(self) -> Array:
        """See `Mover`."""
        return np.full(3, SPEED)


class BaseMover(ObjectMover):
    """The base of a robot that stands on the ground, such as one with wheels, at the height at which it is."""

    def solve(self, target: Array) -> Array | None:
        """See `Mover`."""
        return np.array([*target[:2], self.body.base_position[2]])


@dataclasses.dataclass(frozen=True)
class Goal:
    """What has to be where, so that the task calls it a success."""

    target: str  # name of a place
    mover: Mover


@dataclasses.dataclass(frozen=True)
class Way:
    """From the start of an episode to its goal, in a straight line of states."""

    mover: Mover
    start: Array
    goal: Array

    def at(self, part: float) -> Array:
        """Return the state at a part of the way back from the goal (0) to the start (1)."""
        return np.asarray(self.goal + part * (self.start - self.goal))


def read_targets(world: PlayWorld) -> dict[str, Array]:
    """Return places that may be the goal of the episode that has begun [m], by name, shape (3,) each."""
    assert world.task_env is not None
    found = {name: np.asarray(place, float) for name, place in world.task_env.markers().items()}
    commands = world.read_commands()
    for name in commands:
        stem = name.removesuffix("_x")
        if name != stem and all(f"{stem}_{axis}" in commands for axis in AXES):
            found[stem] = np.array([float(commands[f"{stem}_{axis}"].value) for axis in AXES])
    for name, attribute in read_attributes(world.instance.env).items():
        if attribute.numbers.size in (2, len(AXES)) and GOALS.search(name):
            found[name] = np.array([*attribute.numbers, 0.0][:3])  # of two numbers it is a place on the ground
    distinct: dict[str, Array] = {}
    for name, place in found.items():
        is_known = any(np.allclose(place, other) for other in distinct.values())
        if place.shape == (3,) and not is_known:
            distinct[name] = place
    return dict(list(distinct.items())[:MOST_TARGETS])


def list_movers(world: PlayWorld) -> Iterator[Mover]:
    """Yield what may be brought to a goal: links of arms, the last ones first, objects, and robots with a free base."""
    bodies = [] if world.sim is None else list(world.sim.bodies.values())
    for body in bodies:
        if body.fixed and body.joint_names and body.find_trunk() is None:
            for link in reversed(body.link_names[-MOST_LINKS:]):
                yield LinkMover(body, link)
    for body in bodies:
        if not body.fixed and not body.joint_names:
            yield ObjectMover(body)
    for body in bodies:
        if not body.fixed and body.joint_names:
            yield BaseMover(body)
            yield ObjectMover(body)


def find_goal(world: PlayWorld, seed: int, number: int) -> Goal | None:
    """Return what has to be where in the episode of a seed; None if no try is a success, or if there is no success."""
    if not world.has_success or world.sim is None:
        return None
    world.begin(seed, number)
    names = list(world.ask(lambda: read_targets(world)))
    for name in names:
        for mover in list_movers(world):
            goal = Goal(name, mover)
            way = find_way(world, goal, seed, number)
            if way is not None and is_success(world, way, 0.0, seed, number):
                return goal
    return None


def find_way(world: PlayWorld, goal: Goal, seed: int, number: int) -> Way | None:
    """Return the way to the goal of the episode of a seed; None if it is out of reach."""
    world.begin(seed, number)
    targets: dict[str, Array] = world.ask(lambda: read_targets(world))
    if goal.target not in targets:
        return None
    start = goal.mover.read()
    end: Array | None = world.ask(lambda: goal.mover.solve(targets[goal.target]))
    return None if end is None else Way(goal.mover, start, end)


def is_success(world: PlayWorld, way: Way, part: float, seed: int, number: int) -> bool:
    """Return whether holding the state at a part of the way from goal to start becomes a success."""
    state = way.at(part)
    still = np.zeros_like(state)
    steps = max(FEWEST_STEPS, round(HOLD_S / world.control_dt))
    script = Script(
        ZeroActor(world.space), lambda: way.mover.place(state, still), lambda step: way.mover.place(state, still)
    )
    return bool(world.play(script, "", seed, number, steps).success)


def find_hover(world: PlayWorld, way: Way, seed: int, number: int) -> Array | None:
    """Return a state beside the goal that is no success; None if already the start is one."""
    part = find_beside(lambda part: is_success(world, way, part, seed, number))
    return None if part is None else way.at(part)


def find_beside(succeeds: Callable[[float], bool]) -> float | None:
    """Return the part of the way from the goal (0) to the start (1) that is just no success, by bisection; None if
    already the start is one."""
    if succeeds(1.0):
        return None
    near, far = 0.0, 1.0
    for _ in range(BISECTIONS):
        middle = (near + far) / 2
        near, far = (middle, far) if succeeds(middle) else (near, middle)
    return min(1.0, BEYOND * far)


class Moved:
    """Moves from the start to a state, and stays there."""

    def __init__(self, world: PlayWorld, way: Way, end: Array) -> None:
        self._way, self._end = way, end
        change = end - way.start
        needed_s = float(np.max(np.abs(change) / way.mover.speeds))
        self._steps = min(max(1, math.ceil(needed_s / world.control_dt)), max(1, int(LONGEST_WAY * world.longest)))
        self._speed = change / (self._steps * world.control_dt)

    def move(self, step: int) -> None:
        """Set the state after a step."""
        part = min(1.0, step / self._steps)
        is_there = step >= self._steps
        state = self._way.start + part * (self._end - self._way.start)
        self._way.mover.place(state, np.zeros_like(state) if is_there else self._speed)


class Driven(Actor):
    """Drives the joints of an arm to a state by actions, as `describe_joints` says what they command."""

    def __init__(self, world: PlayWorld, body: Body, end: Array) -> None:
        """Raises `LookupError` where that is not said."""
        joints: Joints | None = world.ask(world.read_joints)
        if joints is None or joints.command[0] not in ("position", "step", "speed"):
            raise LookupError("what an action commands is not known")
        if not {*joints.names} <= {*body.joint_names}:
            raise LookupError("actions move joints of other bodies, too")
        self._body, self._space = body, world.space
        self._command, scale = joints.command
        self._scale = np.array(scale)
        self._index = [body.joint_names.index(name) for name in joints.names]
        self._end = end[self._index]
        self._default = np.array(joints.default_positions) if joints.default_positions else np.zeros(len(self._index))
        self._dt = world.control_dt
        speeds = np.where(body.joint_max_speed > 0, body.joint_max_speed, SPEED)[self._index]
        self._most = speeds * self._dt  # [rad or m] in a step

    def act(self, observations: object, rows: Rows) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Return the action that leads on to the state."""
        missing = self._end - self._body.joint_positions[self._index]
        if self._command == "position":
            ahead = np.clip(missing, -5 * self._most, 5 * self._most)
            action = (self._end - missing + ahead - self._default) / self._scale
        elif self._command == "step":
            action = missing / self._scale
        else:
            action = QUICK * missing / self._scale
        row = np.clip(action, self._space.low, self._space.high).astype(self._space.dtype)[None]
        return as_stored(row), row
