"""RL823: position advanced twice."""

import contextlib
import dataclasses
from collections.abc import Iterator
from typing import Any

import numpy as np

from rlctl.checking.episode import EpisodePlayer
from rlctl.checking.experiments.worlds import WatchedWorlds, judges_worlds
from rlctl.checking.instance import EnvironmentRaised
from rlctl.checking.mujoco_calls import MujocoCalls
from rlctl.checking.records import FIRST_SEED
from rlctl.checking.rule import Rule, RuleFinding, Severity
from rlctl.checking.world_logs import LoggedWorld
from rlctl.checking.worlds import JOINTS, VELOCITY, Array, StateReader

RULE = Rule(
    "RL823",
    "position advanced twice",
    Severity.WARNING,
    meaning="""
        Between two steps of the physics the environment moves a joint or a body by its own velocity times a time.
        The physics has done that already: the robot moves faster than its velocity says, and through what it
        touches. Velocities in the observation, and every force, then belong to another motion.
    """,
    fix="""
        Leave the integration to the engine. Set velocities or forces, or, for a body that should follow a path,
        set its position and a velocity of 0.
    """,
)

STEPS = 15  # of the environment
FEWEST = 8  # moves of one number that are compared
MOVING = 1e-3  # velocities that count [rad/s], [m/s]
SAME = 1e-3  # relative; by which the times of the moves may differ
SHORTEST = 1e-5  # [s]
INTEGRATED = 0.5  # part of its way by its velocity that the physics moves it at least
NEARLY_ALL = 0.9  # of the moves: some may end at a limit


@dataclasses.dataclass
class _Moves:
    """By how much an environment moves what is in a world, between the steps of its physics."""

    reader: StateReader
    time_step: float  # of the physics [s]
    before: Array | None = None  # Positions and velocities before the last step of the physics. Shape (2, numbers)
    after: Array | None = None  # and what it left
    rows: list[Array] = dataclasses.field(default_factory=list)
    """How far the physics moved all positions in its last step, the velocities after it, and how far the environment
    has moved the positions since. Shape (3, numbers) each."""

    def begin(self) -> None:
        """Forget what was, as a reset moves everything."""
        self.before = self.after = None
        self.rows.clear()

    def note_before(self, client: int) -> None:
        """Note what was moved since the last step of the physics."""
        if client != self.reader.world.client:
            return
        with contextlib.suppress(*self.reader.errors):
            now, before, after = _read(self.reader), self.before, self.after
            if before is not None and after is not None and before.shape == after.shape == now.shape:
                self.rows.append(np.stack([after[0] - before[0], after[1], now[0] - after[0]]))
            self.before = now

    def note_after(self, client: int) -> None:
        """Keep what a step of the physics left."""
        if client == self.reader.world.client:
            with contextlib.suppress(*self.reader.errors):
                self.after = _read(self.reader)

    def find_times(self) -> Iterator[tuple[int, float]]:
        """Yield the numbers that are always moved by their velocity times the same time, and this time [s]; not what
        the physics leaves where it is, whatever velocity it was given."""
        if len({row.shape for row in self.rows}) != 1:
            return
        by_physics, speeds, by_environment = np.stack(self.rows, axis=1)
        is_integrated = by_physics * np.sign(speeds) > INTEGRATED * self.time_step * np.abs(speeds)
        counts = (np.abs(speeds) > MOVING) & (by_environment != 0)
        for number in np.flatnonzero((counts & is_integrated).sum(axis=0) >= FEWEST).tolist():
            rows = counts[:, number]
            times = by_environment[rows, number] / speeds[rows, number]
            usual = float(np.median(times))
            if usual > SHORTEST and (np.abs(times / usual - 1) < SAME).mean() >= NEARLY_ALL:
                yield number, usual


@judges_worlds(RULE, place=92)
def _find_second_integration(watched: WatchedWorlds) -> Iterator[RuleFinding]:
    """Play an episode, and compare what the environment moves by itself with the velocities."""
    moves = [_Moves(world.reader, world.time_step) for world in watched.worlds]
    try:
        _play(watched, moves)
    except EnvironmentRaised:  # an episode that was logged raised it too
        return
    for world, own in zip(watched.worlds, moves, strict=True):
        for number, seconds in own.find_times():
            yield _describe(world, number, seconds)
            return


def _play(watched: WatchedWorlds, moves: list[_Moves]) -> None:
    calls, mujoco_calls = watched.calls, watched.mujoco_calls

    def before(client: int) -> None:
        for one in moves:
            one.note_before(client)

    def after(client: int) -> None:
        for one in moves:
            one.note_after(client)

    def before_mujoco(*_: Any) -> None:
        before(0)

    def after_mujoco(*_: Any) -> None:
        after(0)

    calls.before_step, calls.after_step = before, after
    mujoco_calls.before_step, mujoco_calls.after_step = before_mujoco, after_mujoco
    try:
        for moment in EpisodePlayer(watched.instance, FIRST_SEED, max_steps=STEPS):
            if moment.step == 0:  # a reset moves everything
                for one in moves:
                    one.begin()
    finally:
        calls.before_step = calls.after_step = None
        mujoco_calls.before_step, mujoco_calls.after_step = MujocoCalls.before_step, MujocoCalls.after_step


def _read(reader: StateReader) -> Array:
    """Return positions and velocities of all bases and joints. Shape (2, numbers)."""
    reader.update()
    rows = []
    for body, state in zip(reader.world.bodies, reader.read_states(), strict=True):
        joints = len(body.joints)
        positions = np.concatenate([state[: VELOCITY.start], state[JOINTS : JOINTS + joints]])
        speeds = np.concatenate([state[VELOCITY], state[JOINTS + joints :]])
        rows.append(np.stack([positions, speeds]))
    return np.concatenate(rows, axis=1)


def _describe(world: LoggedWorld, number: int, seconds: float) -> RuleFinding:
    names = []
    for body in world.reader.world.bodies:
        names += [f"{axis} of {body.name}" for axis in "xyz"] + [f"joint {joint.name}" for joint in body.joints]
    what = f"between two steps of the physics the environment moves {names[number]} by its velocity"
    message = f"{what} times {seconds:.4g} s; the physics, with steps of {world.time_step:.4g} s, has moved it already"
    return RuleFinding(RULE, message, {"element": names[number], "seed": FIRST_SEED, "value": seconds, "expected": 0.0})
