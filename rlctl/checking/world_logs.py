"""The worlds of an instance, logged through a few short episodes."""

import contextlib
import dataclasses
import functools
import math
from collections.abc import Collection
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from rlctl.checking.bullet_worlds import BulletStateReader, read_world
from rlctl.checking.episode import EpisodePlayer, Moment
from rlctl.checking.instance import EnvironmentRaised, Instance
from rlctl.checking.mujoco_calls import MujocoCalls
from rlctl.checking.mujoco_worlds import MujocoStateReader
from rlctl.checking.records import FIRST_SEED
from rlctl.checking.values import find_numbers, flatten, flatten_action, list_parts
from rlctl.checking.worlds import (
    ANGULAR,
    JOINTS,
    VELOCITY,
    Array,
    JointKey,
    Jump,
    MotorTarget,
    Pair,
    Poses,
    StateReader,
    World,
    WorldBody,
)
from rlctl.environments.bullet_calls import BulletCalls
from rlctl.environments.bullet_clients import find_clients
from rlctl.environments.simulations import find_mujoco

DEEPEST_FINE = 0.02  # [m]; Bullet pushes links apart over several steps, heavy robots leave up to 2 cm
LEAST_LIMIT = 0.005  # The same for the smallest things [m]: collision margins alone are 1 to 4 mm
PART_OF_LINK = 0.25  # Between those two it is this part of the thinner link
LASTING_STEPS = 3  # shorter events are impacts that the solver has not resolved yet
THROWN_STEPS = 4  # until a body gets another velocity
THROWN = np.array([[-0.5, -0.5, 0.5, -3.0, -3.0, -3.0], [0.5, 0.5, 1.5, 3.0, 3.0, 3.0]])
"""Lowest and highest velocities of a body that is thrown, upwards so that nothing holds it [m/s], [rad/s]."""
Place = dict[str, Any]
"""`seed`, `episode`, `actions` and `step` of a look at a world, as a finding's evidence; step 0 is the reset."""


@dataclasses.dataclass
class WorldLog:
    """One world in one episode: an entry per look."""

    reader: StateReader
    world: World
    actions: str  # The kind of the episode's actions
    places: list[Place] = dataclasses.field(default_factory=list)
    times: list[float] = dataclasses.field(default_factory=list)  # simulated [s]
    states: list[list[Array]] = dataclasses.field(default_factory=list)  # by look and body
    deep: list[dict[Pair, tuple[float, float]]] = dataclasses.field(default_factory=list)  # depth and limit [m]
    overlaps: dict[Pair, tuple[float, float]] = dataclasses.field(default_factory=dict)
    """Depth and limit [m] of free bodies that a reset puts into others."""
    touching: list[set[Pair]] = dataclasses.field(default_factory=list)  # Links that touch
    poses: list[Poses] = dataclasses.field(default_factory=list)
    points: list[Array] = dataclasses.field(default_factory=list)  # see `StateReader.read_points`
    observed: list[Array] = dataclasses.field(default_factory=list)  # flat observations
    parts: list[tuple[str, int]] = dataclasses.field(default_factory=list)  # name and size of each of their arrays
    given: list[Array] = dataclasses.field(default_factory=list)  # flat actions; of reset empty
    told: list[dict[str, float]] = dataclasses.field(default_factory=list)  # numbers of info by name; of reset empty
    rewards: list[float] = dataclasses.field(default_factory=list)  # NaN at a reset, and where it is no number
    before: list[tuple[list[Array], Poses] | None] = dataclasses.field(default_factory=list)
    """What the reader has of the moment before the last call that advanced the physics."""
    targets: list[dict[JointKey, MotorTarget]] = dataclasses.field(default_factory=list)
    commands: list[Array | None] = dataclasses.field(default_factory=list)
    weights: dict[JointKey, float] = dataclasses.field(default_factory=dict)  # at reset
    failure: str = ""  # What the engine itself reported

    def look(self, place: Place, moment: Moment, action: Array) -> bool:
        """Add the present state; return False if the world is gone or has other bodies."""
        reader = self.reader
        try:
            reader.update()
            states, contacts = reader.read_states(), reader.read_contacts()
            poses, targets = reader.read_poses(), reader.read_targets()
            points = reader.read_points()
            deep = self._find_deep(contacts)
            if not self.places:
                self.weights = reader.read_weights()
                self.parts = list(list_parts(moment.observation))
                self.overlaps = self._find_deep(reader.read_overlaps())
        except reader.errors:
            return False
        self.places.append(place)
        self.times.append(reader.read_time())
        self.states.append(states)
        self.touching.append(set(contacts))
        self.poses.append(poses)
        self.points.append(points)
        self.observed.append(flatten(moment.observation))
        self.given.append(action)
        has_told = moment.step and isinstance(moment.info, dict)
        self.told.append(dict(find_numbers(moment.info)) if has_told else {})
        self.rewards.append(moment.reward_number if moment.step else math.nan)
        self.before.append(reader.read_before())
        self.targets.append(targets)
        self.commands.append(reader.read_command())
        self.deep.append(deep)
        self.failure = self.failure or reader.read_failure()
        return True

    def _find_deep(self, distances: dict[Pair, float]) -> dict[Pair, tuple[float, float]]:
        """Return depth and limit of the pairs that are too deep inside each other [m]."""
        inside = {pair: (-d, self._limit(pair)) for pair, d in distances.items() if d < -LEAST_LIMIT}
        return {pair: depth for pair, depth in inside.items() if depth[0] > depth[1]}

    def _limit(self, pair: Pair) -> float:
        return min(DEEPEST_FINE, max(LEAST_LIMIT, PART_OF_LINK * self.reader.find_thickness(pair)))

    @property
    def bodies(self) -> list[tuple[WorldBody, Array]]:
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


@dataclasses.dataclass
class LoggedWorld:
    """Everything about one world."""

    world: World
    reader: StateReader  # Of the last episode
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
    older: set[int]  # The clients of PyBullet that were connected before it was built
    calls: BulletCalls  # Records how it calls PyBullet
    mujoco_calls: MujocoCalls
    resets: int = 0
    _worlds: dict[int, LoggedWorld] = dataclasses.field(default_factory=dict)  # by index: ids of clients may change

    @property
    def worlds(self) -> list[LoggedWorld]:
        """The worlds, without what never moves: a copy of the robot that kinematics are solved with."""
        moving = [world for world in self._worlds.values() if any(log.moves for log in world.logs)]
        return moving or list(self._worlds.values())

    def play(self, number: int, kind: str, steps: int, thrown: Collection[str] = ()) -> None:
        """Log an episode. If the environment raises, the log keeps what came before. Free bodies of the names `thrown`
        get another velocity every few steps."""
        rng = np.random.default_rng(number)
        seed = FIRST_SEED + number
        logs: list[WorldLog] = []
        self._watch([])
        for moment in EpisodePlayer(self.instance, seed, kind, number=number, max_steps=steps):
            place = {"seed": seed, "episode": number, "actions": kind, "step": moment.step}
            logs = logs if moment.step else self._begin(kind)
            leaves = self.instance.action_leaves if moment.step else []
            action = flatten_action(leaves, moment.action)
            logs = [log for log in logs if log.look(place, moment, action)]
            if moment.step == 0:
                self.calls.targets.clear()
            self._watch(logs)
            if thrown and moment.step % THROWN_STEPS == 0:
                for log in logs:
                    _throw(log.reader, thrown, rng)
            if not logs:
                return

    def play_thrown(self, number: int, steps: int, thrown: Collection[str]) -> dict[int, WorldLog]:
        """Return the logs of an episode in which free bodies are thrown, by the places of their worlds in `worlds`;
        the worlds keep none."""
        known = [(world, len(world.logs)) for world in self.worlds]
        touched = {id(world): len(getattr(world.reader, "touched", ())) for world, _ in known}
        with contextlib.suppress(EnvironmentRaised):  # such as where it ends without what was thrown
            self.play(number, "random", steps, thrown)
        logs: dict[int, WorldLog] = {}
        for place, (world, count) in enumerate(known):
            for log in world.logs[count:]:
                logs[place] = log
            del world.logs[count:]
            if isinstance(world.reader, MujocoStateReader):
                del world.reader.touched[touched[id(world)] :]
        return logs

    def _watch(self, logs: list[WorldLog]) -> None:
        """Let readers remember the state before each step of the physics."""
        bullet = [log.reader for log in logs if isinstance(log.reader, BulletStateReader)]
        mujoco = [log.reader for log in logs if isinstance(log.reader, MujocoStateReader)]

        def before_bullet(client: int) -> None:
            for reader in bullet:
                if reader.world.client == client:
                    with contextlib.suppress(*reader.errors):
                        reader.remember()

        def before_mujoco(_: Any, data: Any, nstep: int) -> None:
            for reader in mujoco:
                if reader.data is data:
                    reader.remember(nstep)

        for reader in mujoco:
            reader.forget()
        watched = logs and logs[0].actions == "random"  # enough, and it takes time
        self.calls.before_step = before_bullet if watched and bullet else None
        self.mujoco_calls.before_step = before_mujoco

    def _begin(self, kind: str) -> list[WorldLog]:
        self.resets += 1
        logs = []
        for i, reader in enumerate(self._read()):
            world = reader.world
            gravity, time_step = reader.read_physics()
            logged = self._worlds.setdefault(i, LoggedWorld(world, reader, gravity, time_step))
            logged.time_step, logged.reader = time_step, reader
            logged.gravity = max(logged.gravity, gravity, key=np.linalg.norm)
            if world.key == logged.world.key:
                logged.world = world
            logs.append(WorldLog(reader, world, kind))
            logged.logs.append(logs[-1])
        return logs

    def _read(self) -> list[StateReader]:
        readers: list[StateReader] = []
        if (simulation := find_mujoco(self.instance.env)) is not None:
            readers.append(self._read_mujoco(*simulation))
        ids = find_clients()
        own = [read_world(id) for id in ids if id not in self.older]
        if not any(world.bodies for world in own):
            own = [read_world(id) for id in ids]
        worlds = [self._without_meaningless_limits(world) for world in own if world.bodies][:4]
        return [*readers, *(BulletStateReader(world, self.calls) for world in worlds)]

    def _read_mujoco(self, model: Any, data: Any) -> MujocoStateReader:
        for logged in self._worlds.values():
            reader = logged.reader
            if isinstance(reader, MujocoStateReader) and reader.model is model and reader.data is data:
                return reader
        return MujocoStateReader(model, data)

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
        """Reset, and simulate every world without the environment, which may leave them unusable."""
        self.play(number, "none", 0)
        for logged in self._worlds.values():
            with contextlib.suppress(*logged.reader.errors):
                if not any(logged.gravity):
                    logged.weight_matters = logged.reader.weight_matters()
                logged.jumps += logged.reader.find_jumps(FIRST_SEED + number)


def _throw(reader: StateReader, names: Collection[str], rng: np.random.Generator) -> None:
    bodies = [body for body in reader.world.bodies if body.name in names]
    velocities = rng.uniform(THROWN[0], THROWN[1], size=(len(bodies), 6))
    with contextlib.suppress(*reader.errors):
        reader.throw(bodies, velocities)


def name_place(place: Place) -> str:
    """Return when something was logged, in words."""
    return f"at step {place['step']}" if place["step"] else "at reset"
