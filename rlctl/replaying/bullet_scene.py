"""The scene of an episode in PyBullet: of a task's world, or of all worlds that a plain environment made."""

import dataclasses
import itertools
from collections.abc import Iterator, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from rlctl.environments.bullet_clients import MOST_CLIENTS
from rlctl.replaying.bullet_bodies import list_body_ids, name_bodies, read_body, read_visuals
from rlctl.replaying.bullet_log import BulletLog
from rlctl.replaying.bullet_track import Key, Track
from rlctl.replaying.scene import WORLD, BodyMotion, Line, Scene, Warn
from rlctl.task.env import TaskEnv
from rlctl.task.pybullet.library import pybullet
from rlctl.task.pybullet.sim import PybulletSim
from rlctl.task.rotations import normalize, rotate

Array = NDArray[np.float64]

_CONSTRAINT_COLOR = (0.95, 0.6, 0.1)


@dataclasses.dataclass(frozen=True)
class _Point:
    """A point [m] in the frame of a link, or (without a track) of the world."""

    track: Track | None
    link: int
    position: Sequence[float]
    is_inertial: bool = False  # whether it is in the inertial frame of the link

    def place(self, motions: Mapping[Track, BodyMotion], step: int) -> Array:
        """Return the position in the world [m]."""
        position = np.array(self.position, np.float64)
        if self.track is None:
            return position
        motion, body, index = motions[self.track], self.track.body, self.link + 1
        if not np.isfinite(motion.positions[step, index]).all():  # the simulation diverged
            return motion.positions[step, index]
        if self.is_inertial:
            center, turn = body.inertial if self.link < 0 else body.joints[self.link].inertial
            position = center + rotate(normalize(turn), position)
        return motion.positions[step, index] + rotate(motion.orientations[step, index], position)


@dataclasses.dataclass(frozen=True)
class _Chain:
    """Points that are connected by lines."""

    client: int
    points: Sequence[_Point]
    color: tuple[float, ...]

    def place(self, motions: Mapping[Track, BodyMotion], step: int) -> list[Line]:
        """Return the lines in the world, without those of no length or without a place."""
        pairs = itertools.pairwise(point.place(motions, step) for point in self.points)
        return [Line(start, end, self.color) for start, end in pairs if np.linalg.norm(end - start) > 0]


class TaskReader:
    """Reads bodies and markers of a task's world, without changing it."""

    def __init__(self, env: TaskEnv) -> None:
        self._env = env

    def read(self, step: int) -> None:
        """Read the world after a step; 0 is the reset."""
        positions, sim = self._env.markers(), self._env.sim
        if step == 0:  # only now: a reset may load the bodies again
            assert isinstance(sim, PybulletSim)  # MuJoCo's worlds have a reader of their own
            self._bodies = list(sim.bodies.values())
            self._tracks = [Track(read_body(sim.client, body.id), body.file) for body in self._bodies]
            self._markers: dict[str, list[Array]] = {name: [] for name in positions}
        for track in self._tracks:
            track.read(step, read_visuals(track.body.client, track.body.id))
        for name, history in self._markers.items():
            history.append(np.array(positions[name], np.float64))
        self._steps = step + 1

    def scene(self) -> Scene:
        """Return what was read since the last reset."""
        markers = {name: np.stack(positions) for name, positions in self._markers.items()}
        bodies = []
        for body, track in zip(self._bodies, self._tracks, strict=True):
            motion = track.describe_motion(body.name, WORLD, self._steps)
            ground = None if body.terrain is not None else motion.ground_height
            bodies.append(dataclasses.replace(motion, terrain=body.terrain, ground_height=ground))
        return Scene(bodies, markers)


class WorldsReader:
    """Reads the bodies, constraints and debug lines of all clients that an environment made, without changing them."""

    def __init__(self, log: BulletLog, warn: Warn) -> None:
        self._log = log
        self._warn = warn
        self._tracks: list[Track] = []
        self._present: dict[Key, Track] = {}
        self._soft: set[str] = set()  # names of bodies that are not read
        self._constraints: list[list[_Chain]] = []  # by step
        self._lines: list[list[_Chain]] = []  # by step
        self._most = MOST_CLIENTS

    def find_bodies(self) -> bool:
        """Say whether the environment has bodies in PyBullet now."""
        return any(list_body_ids(client) for client in self._log.find_own_clients())

    def read(self, step: int) -> None:
        """Read the worlds after a step; 0 is the reset."""
        clients = self._log.find_own_clients(self._most)
        # PyBullet gives a new client the lowest id that is free.
        self._most = max([*clients, *self._log.clients_before], default=-1) + 2
        self._read_bodies(step, [(client, body) for client in clients for body in list_body_ids(client)])
        self._constraints.append([part for client in clients for part in self._read_constraints(client)])
        self._lines.append([line for client in clients for line in self._read_lines(client)])

    def _read_bodies(self, step: int, keys: Sequence[Key]) -> None:
        before, self._present = self._present, {}
        loaded = []
        for key in keys:
            visuals, track = read_visuals(*key), before.get(key)
            if track is not None and track.is_of(key, visuals):
                track.read(step, visuals)
                self._present[key] = track
            else:
                loaded.append(key)
        for key in loaded:
            body = read_body(*key)
            if body.is_soft:
                self._skip_soft(body.name)
                continue
            # Some environments load the same object at every step.
            track = next((track for track in self._tracks if track.steps[-1] < step and track.equals(body)), None)
            if track is None:
                track = Track(body, self._log.files.get(key), self._log.meshes.get(key))
                self._tracks.append(track)
            track.body = body
            track.read(step, body.visuals)
            self._present[key] = track

    def _skip_soft(self, name: str) -> None:
        if name not in self._soft:
            self._soft.add(name)
            self._warn(f"the soft body {name!r} is not drawn")

    def _read_constraints(self, client: int) -> Iterator[_Chain]:
        for index in range(pybullet.getNumConstraints(physicsClientId=client)):
            constraint = pybullet.getConstraintUniqueId(index, physicsClientId=client)
            info = pybullet.getConstraintInfo(constraint, physicsClientId=client)
            parent, parent_link, child, child_link, kind, _, parent_pivot, child_pivot = info[:8]
            first, second = self._present.get((client, parent)), self._present.get((client, child))
            if kind == pybullet.JOINT_GEAR or first is None:
                continue
            center = (0.0, 0.0, 0.0)
            points = [_Point(first, parent_link, center, True), _Point(first, parent_link, parent_pivot, True)]
            points.append(_Point(second, child_link, child_pivot, True))
            points += [] if second is None else [_Point(second, child_link, center, True)]
            yield _Chain(client, points, _CONSTRAINT_COLOR)

    def _read_lines(self, client: int) -> Iterator[_Chain]:
        for line in self._log.read_lines(client):
            body, link = line.link or (-1, -1)
            track = self._present.get((client, body))
            yield _Chain(client, [_Point(track, link, point) for point in (line.start, line.end)], tuple(line.color))

    def scene(self) -> Scene:
        """Return what was read since the reset."""
        robots = {track.body.client for track in self._tracks if track.body.joints}
        clients = sorted({track.body.client for track in self._tracks}, key=lambda key: (key not in robots, key))
        motions: dict[Track, BodyMotion] = {}
        lines: dict[tuple[str, str], list[list[Line]]] = {}
        for number, client in enumerate(clients):
            world = f"{WORLD} {number + 1}" if number else WORLD
            tracks = [track for track in self._tracks if track.body.client == client]
            for track, name in zip(tracks, name_bodies([track.body for track in tracks]), strict=True):
                motions[track] = track.describe_motion(name, world, len(self._lines))
            for kind, history in (("constraints", self._constraints), ("debug lines", self._lines)):
                chosen = [[chain for chain in chains if chain.client == client] for chains in history]
                if any(chosen):
                    lines[world, kind] = [
                        [line for chain in chains for line in chain.place(motions, step)]
                        for step, chains in enumerate(chosen)
                    ]
        return Scene(list(motions.values()), lines=lines)
