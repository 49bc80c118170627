"""The worlds of an instance, logged through a few short episodes."""

from __future__ import annotations

import contextlib
import dataclasses
import sys
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlctl.check_env.bullet_clients import connected
from rlctl.check_env.bullet_worlds import (
    Dynamics,
    Pair,
    State,
    World,
    bullet,
    read_contacts,
    read_dynamics,
    read_gravity,
    read_states,
    read_world,
    thickness,
)
from rlctl.check_env.episode import Episode
from rlctl.check_env.finding import NotApplicable
from rlctl.check_env.instance import Instance
from rlctl.check_env.messages import FIRST_SEED
from rlctl.check_env.world_tests import Jump, Touch, find_jumps, touch_links, weight_matters

MOST_WORLDS = 4
DEEPEST_FINE = 0.02
"""Links of ordinary size may be so far inside each other [m]: Bullet pushes them apart over several steps, and 2 cm
are more than a stiff contact leaves even for a heavy robot that falls."""
LEAST_LIMIT = 0.005
"""The same for the smallest things [m]: collision margins alone are 1 to 4 mm."""
PART_OF_LINK = 0.25
"""Between those two it is this part of the thinner link."""
TOUCHING = 0.005
"""Links that are closer than this touch [m]; Bullet reports contacts a little ahead."""

Place = dict[str, Any]
"""`seed`, `episode`, `actions` and `step` of a look at a world, as a finding's evidence; step 0 is the reset."""


@dataclasses.dataclass
class Log:
    """One world in one episode: an entry per look."""

    world: World
    places: list[Place] = dataclasses.field(default_factory=list)
    states: list[list[State]] = dataclasses.field(default_factory=list)
    """Per look, per body."""
    deep: list[dict[Pair, tuple[float, float]]] = dataclasses.field(default_factory=list)
    """Depth and limit of what is too far inside each other [m]."""
    touching: list[set[int]] = dataclasses.field(default_factory=list)
    """The ids of bodies that touch another one."""

    def look(self, place: Place) -> bool:
        """Add what is there now; False where the world has gone, or has other bodies."""
        client = self.world.client
        try:
            states, contacts = read_states(self.world), read_contacts(client)
            deep = {pair: (-d, _limit(client, pair)) for pair, d in contacts.items() if d < -LEAST_LIMIT}
        except bullet().error:
            return False
        self.places.append(place)
        self.states.append(states)
        self.deep.append({pair: each for pair, each in deep.items() if each[0] > each[1]})
        self.touching.append(
            {body for pair, d in contacts.items() if d < TOUCHING for body, _ in pair if pair[0][0] != pair[1][0]}
        )
        return True

    @property
    def actions(self) -> str:
        """The kind of the episode's actions."""
        return str(self.places[0]["actions"]) if self.places else ""

    def series(self, body: int, name: str) -> NDArray[np.float64]:
        """Return one field of a body's `State` at every look."""
        return np.array([getattr(states[body], name) for states in self.states])


def _limit(client: int, pair: Pair) -> float:
    thinner = min(thickness(client, link) for link in pair)
    return min(DEEPEST_FINE, max(LEAST_LIMIT, PART_OF_LINK * thinner))


@dataclasses.dataclass
class LoggedWorld:
    """Everything about one world."""

    world: World
    gravity: list[float]
    """The strongest [m/s^2]."""
    built: list[Dynamics] | None
    """Per body, before the first reset; None where the world was not the same then."""
    dynamics: list[list[Dynamics]] = dataclasses.field(default_factory=list)
    """Per reset, per body."""
    logs: list[Log] = dataclasses.field(default_factory=list)
    jumps: list[Jump] = dataclasses.field(default_factory=list)
    weight_matters: bool | None = None
    """Whether anything would move otherwise with gravity; tested only where there is none."""
    touches: list[dict[int, Touch]] = dataclasses.field(default_factory=list)
    """Per body and link index; empty for a body that was not tested."""

    @property
    def moves(self) -> bool:
        """Whether anything ever had a speed."""
        states = [state for log in self.logs for states in log.states for state in states]
        return any(each.velocity.any() or each.angular.any() or each.joints[1].any() for each in states)


class WorldLogger:
    """Logs the worlds of one instance. `older`: the clients that were connected before it was built."""

    def __init__(self, instance: Instance, older: set[int]) -> None:
        if "pybullet" not in sys.modules:
            raise NotApplicable("no PyBullet world")
        self.instance = instance
        self.resets = 0
        self.worlds: dict[int, LoggedWorld] = {}
        """By their place in the list of worlds: an environment that connects anew may get another client."""
        self._older = older
        self._built = {(i, world.key): _dynamics(world) for i, world in enumerate(self._read())}

    def _read(self) -> list[World]:
        """Return the worlds of the clients that came with the instance, or of all where it shares older ones."""
        ids = connected()
        own = [read_world(each) for each in ids if each not in self._older]
        if not any(world.bodies for world in own):
            own = [read_world(each) for each in ids]
        return [world for world in own if world.bodies][:MOST_WORLDS]

    def play(self, number: int, kind: str, steps: int, deadline: float) -> None:
        """Log an episode; where it raises, what was logged before stays."""
        seed = FIRST_SEED + number
        logs: list[Log] = []
        for moment in Episode(self.instance, seed, kind, number=number, max_steps=steps, deadline=deadline):
            place = {"seed": seed, "episode": number, "actions": kind, "step": moment.step}
            logs = [log for log in logs if log.look(place)] if moment.step else self._begin(place)
            if not logs:
                return

    def _begin(self, place: Place) -> list[Log]:
        self.resets += 1
        logs = []
        for i, world in enumerate(self._read()):
            gravity = read_gravity(world.client)
            logged = self.worlds.setdefault(i, LoggedWorld(world, gravity, self._built.get((i, world.key))))
            logged.gravity = max(logged.gravity, gravity, key=np.linalg.norm)
            if world.key == logged.world.key:
                logged.world = world
                logged.dynamics.append(_dynamics(world))
            logs.append(Log(world))
            logged.logs.append(logs[-1])
        return [log for log in logs if log.look(place)]

    def let_go(self, number: int, deadline: float) -> None:
        """Reset, and let every world go on without the environment."""
        self.play(number, "none", 0, deadline)
        for logged in self.worlds.values():
            with contextlib.suppress(bullet().error):
                if not any(logged.gravity):
                    logged.weight_matters = weight_matters(logged.world)
                logged.jumps += find_jumps(logged.world, FIRST_SEED + number)

    def finish(self) -> list[LoggedWorld]:
        """Return the worlds; boxes are put into them now, which leaves them unusable."""
        # What never moves is not simulated: a copy of the robot that kinematics are solved with.
        worlds = [each for each in self.worlds.values() if each.moves] or list(self.worlds.values())
        for logged in worlds:
            for body in logged.world.bodies:
                try:
                    logged.touches.append(touch_links(logged.world.client, body))
                except bullet().error:  # the environment has closed its client
                    logged.touches.append({})
        return worlds


def _dynamics(world: World) -> list[Dynamics]:
    return [read_dynamics(world.client, body) for body in world.bodies]
