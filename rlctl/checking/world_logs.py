"""The worlds of an instance, logged through a few short episodes."""

import contextlib
import dataclasses
import functools
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from rlctl.checking import bullet_worlds
from rlctl.checking.bullet_worlds import ANGULAR, JOINTS, VELOCITY, Jump, Link, Pair, World, WorldBody
from rlctl.checking.episode import EpisodePlayer
from rlctl.checking.instance import Instance
from rlctl.checking.records import FIRST_SEED
from rlctl.checking.values import flatten
from rlctl.environments.bullet_calls import BulletCalls, Target

DEEPEST_FINE = 0.02  # [m]; Bullet pushes links apart over several steps, heavy robots leave up to 2 cm
LEAST_LIMIT = 0.005  # The same for the smallest things [m]: collision margins alone are 1 to 4 mm
PART_OF_LINK = 0.25  # Between those two it is this part of the thinner link
Place = dict[str, Any]
"""`seed`, `episode`, `actions` and `step` of a look at a world, as a finding's evidence; step 0 is the reset."""


@dataclasses.dataclass
class WorldLog:
    """One world in one episode: an entry per look."""

    world: World
    actions: str  # The kind of the episode's actions
    places: list[Place] = dataclasses.field(default_factory=list)
    states: list[list[NDArray[np.float64]]] = dataclasses.field(default_factory=list)  # by look and body
    deep: list[dict[Pair, tuple[float, float]]] = dataclasses.field(default_factory=list)  # depth and limit [m]
    touching: list[set[Pair]] = dataclasses.field(default_factory=list)  # Links that touch
    orientations: list[dict[Link, list[float]]] = dataclasses.field(default_factory=list)  # quaternions, x y z w
    observed: list[NDArray[np.float64]] = dataclasses.field(default_factory=list)  # flat observations
    first_targets: dict[tuple[int, int, int], Target] = dataclasses.field(default_factory=dict)
    """Motor targets that the first step sets, with the zero action only."""

    def look(self, place: Place, observation: Any) -> bool:
        """Add the present state; return False if the world is gone or has other bodies."""
        client = self.world.client
        try:
            states, contacts = bullet_worlds.read_states(self.world), bullet_worlds.read_contacts(client)
            orientations = bullet_worlds.read_orientations(self.world)
            deep = {pair: (-d, _limit(client, pair)) for pair, d in contacts.items() if d < -LEAST_LIMIT}
        except bullet_worlds.bullet().error:
            return False
        self.places.append(place)
        self.states.append(states)
        self.touching.append(set(contacts))
        self.orientations.append(orientations)
        self.observed.append(flatten(observation))
        self.deep.append({pair: depth for pair, depth in deep.items() if depth[0] > depth[1]})
        return True

    @property
    def bodies(self) -> list[tuple[WorldBody, NDArray[np.float64]]]:
        """The bodies, and the state of each at every look. Shape (looks, 9 + 2 * joints) each."""
        series = zip(*self.states, strict=True)
        return [(body, np.array(states)) for body, states in zip(self.world.bodies, series, strict=False)]

    @property
    def moves(self) -> bool:
        """Whether anything ever had a speed."""
        return any(
            states[:, VELOCITY].any() or states[:, ANGULAR].any() or states[:, JOINTS + len(body.joints) :].any()
            for body, states in self.bodies
        )


def _limit(client: int, pair: Pair) -> float:
    boxes = [bullet_worlds.ClientCalls(client).getAABB(*link) for link in pair]
    thinner = min(float(b - a) for low, high in boxes for a, b in zip(low, high, strict=True))  # smallest extent [m]
    return min(DEEPEST_FINE, max(LEAST_LIMIT, PART_OF_LINK * thinner))


@dataclasses.dataclass
class LoggedWorld:
    """Everything about one world."""

    world: World
    gravity: list[float]  # The strongest [m/s^2]
    time_step: float  # At the last reset [s]
    logs: list[WorldLog] = dataclasses.field(default_factory=list)
    jumps: list[Jump] = dataclasses.field(default_factory=list)
    weight_matters: bool | None = None  # tested if gravity is zero


@functools.cache
def find_continuous_joints(model: str, search_paths: tuple[str, ...]) -> frozenset[str]:
    """Return the joints of a URDF that turn without end; PyBullet reports a <limit> of theirs, which has no meaning."""
    for folder in ("", *search_paths):
        with contextlib.suppress(OSError, ElementTree.ParseError):
            joints = ElementTree.parse(Path(folder, model)).getroot().iter("joint")
            return frozenset(joint.get("name", "") for joint in joints if joint.get("type") == "continuous")
    return frozenset()


@dataclasses.dataclass
class WorldLogger:
    """Logs the worlds of one instance."""

    instance: Instance
    older: set[int]  # The clients that were connected before it was built
    calls: BulletCalls  # Records how it calls PyBullet
    resets: int = 0
    _worlds: dict[int, LoggedWorld] = dataclasses.field(default_factory=dict)  # by index: ids of clients may change

    @property
    def worlds(self) -> list[LoggedWorld]:
        """The worlds, without what never moves: a copy of the robot that kinematics are solved with."""
        moving = [world for world in self._worlds.values() if any(log.moves for log in world.logs)]
        return moving or list(self._worlds.values())

    def play(self, number: int, kind: str, steps: int) -> None:
        """Log an episode. If the environment raises, the log keeps what came before."""
        seed = FIRST_SEED + number
        logs: list[WorldLog] = []
        for moment in EpisodePlayer(self.instance, seed, kind, number=number, max_steps=steps):
            place = {"seed": seed, "episode": number, "actions": kind, "step": moment.step}
            logs = logs if moment.step else self._begin(kind)
            logs = [log for log in logs if log.look(place, moment.observation)]
            if moment.step == 0:
                self.calls.targets.clear()
            elif moment.step == 1 and kind == "zero":
                for log in logs:
                    log.first_targets = dict(self.calls.targets)
            if not logs:
                return

    def _begin(self, kind: str) -> list[WorldLog]:
        self.resets += 1
        logs = []
        for i, world in enumerate(self._read()):
            gravity, time_step = bullet_worlds.read_physics(world.client)
            logged = self._worlds.setdefault(i, LoggedWorld(world, gravity, time_step))
            logged.time_step = time_step
            logged.gravity = max(logged.gravity, gravity, key=np.linalg.norm)
            if world.key == logged.world.key:
                logged.world = world
            logs.append(WorldLog(world, kind))
            logged.logs.append(logs[-1])
        return logs

    def _read(self) -> list[World]:
        ids = bullet_worlds.find_clients()
        own = [bullet_worlds.read_world(id) for id in ids if id not in self.older]
        if not any(world.bodies for world in own):
            own = [bullet_worlds.read_world(id) for id in ids]
        return [self._without_meaningless_limits(world) for world in own if world.bodies][:4]

    def _without_meaningless_limits(self, world: World) -> World:
        bodies = []
        for body in world.bodies:
            model = self.calls.models.get((world.client, body.id))
            turning = find_continuous_joints(model, tuple(self.calls.search_paths)) if model and body.joints else ()
            joints = [
                dataclasses.replace(joint, low=0.0, high=-1.0) if joint.name in turning else joint
                for joint in body.joints
            ]
            bodies.append(dataclasses.replace(body, joints=tuple(joints)))
        return dataclasses.replace(world, bodies=tuple(bodies))

    def simulate_alone(self, number: int) -> None:
        """Reset, and simulate every world without the environment, which leaves them unusable."""
        self.play(number, "none", 0)
        for logged in self._worlds.values():
            with contextlib.suppress(bullet_worlds.bullet().error):
                if not any(logged.gravity):
                    logged.weight_matters = bullet_worlds.weight_matters(logged.world)
                logged.jumps += bullet_worlds.find_jumps(logged.world, FIRST_SEED + number)
