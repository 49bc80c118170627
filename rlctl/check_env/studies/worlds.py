"""Watches the physics behind an environment: what is in its PyBullet clients, and how it moves.

An instance of its own is watched through a few short episodes. What changes its worlds (falling by itself, a box
that is put around each robot) comes after them.
"""

from __future__ import annotations

import contextlib
import dataclasses
import sys
from collections.abc import Iterator

import numpy as np

from rlctl.check_env.actions import actions
from rlctl.check_env.bullet_clients import connected
from rlctl.check_env.context import Context
from rlctl.check_env.evidence import FIRST_SEED
from rlctl.check_env.failures import EnvironmentRaised, failure
from rlctl.check_env.instance import Budget, Instance
from rlctl.check_env.legacy import result
from rlctl.check_env.messages import Message
from rlctl.check_env.studies import source, world_summaries
from rlctl.check_env.studies.tampering import Touch, jumps, touches, weight_matters
from rlctl.check_env.studies.world_life import Life, look
from rlctl.check_env.studies.world_reading import (
    BodyModel,
    Dynamics,
    WorldModel,
    bullet,
    read_dynamics,
    read_gravity,
    read_world,
)
from rlctl.check_env.world_results import Jump, Moment, World, WorldBody, WorldLink, Worlds

EPISODES = (("zero", 50), ("random", 60), ("random", 60), ("extreme", 50), ("random", 60))
"""The actions of each episode, and how many of its steps are watched."""
MOST_WORLDS = 4


@dataclasses.dataclass
class Notes:
    """What was seen of one world so far."""

    world: WorldModel
    gravity: list[float]
    dynamics: list[list[Dynamics]] = dataclasses.field(default_factory=list)
    """Per reset, per body."""
    lives: list[Life] = dataclasses.field(default_factory=list)
    jumps: list[Jump] = dataclasses.field(default_factory=list)
    weight_matters: bool | None = None


def worlds(context: Context) -> Iterator[Message]:
    """Live a few short episodes, and say what went on in the worlds behind them."""
    before = set(connected())
    with source.record_functions() as ran, context.fresh() as instance:
        if "pybullet" not in sys.modules:
            yield result(Worlds())
            return
        watcher = Watcher(instance, before)
        for episode, (kind, steps) in enumerate(EPISODES):
            if episode and (context.budget.seconds_left < 0 or not watcher.notes):
                break
            try:
                watcher.episode(episode, kind, steps, context.budget)
            except EnvironmentRaised as error:
                yield failure(error, context.progress)
                if not watcher.resets:
                    return
        if watcher.notes and context.budget.seconds_left > 0:
            with contextlib.suppress(EnvironmentRaised):  # by now its resets were seen
                watcher.falls_by_itself(len(EPISODES))
        yield result(watcher.result(ran))


class Watcher:
    """Watches one instance."""

    def __init__(self, instance: Instance, before: set[int]) -> None:
        self.instance = instance
        self.steps = self.resets = 0
        self.notes: dict[int, Notes] = {}
        """Per place in the list of worlds: an environment that connects anew may get another client."""
        self._before = before
        self._built = {(world.key, place): self._dynamics(world) for place, world in enumerate(self._worlds())}

    def _worlds(self) -> list[WorldModel]:
        """Return the worlds of the clients that came with the instance, or of all where it shares older ones."""
        ids = connected()
        own = [read_world(each) for each in ids if each not in self._before]
        if not any(world.bodies for world in own):
            own = [read_world(each) for each in ids]
        return [world for world in own if world.bodies][:MOST_WORLDS]

    def episode(self, episode: int, kind: str, steps: int, budget: Budget) -> None:
        """Live an episode; what it raises is an `EnvironmentRaised`, and what was seen before stays."""
        instance, seed = self.instance, FIRST_SEED + episode
        lives = self._reset(episode, seed, kind)
        chosen = actions(instance.env.action_space, kind, seed)
        for step in range(1, steps + 1):
            if not lives or budget.seconds_left < 0:
                return
            action = instance.call("sample", next, chosen, step=step)
            answer = instance.call("step", instance.env.step, action, step=step)
            self.steps += 1
            is_whole = isinstance(answer, tuple) and len(answer) == 5
            moment = Moment(seed, episode, kind, step)
            lives = [life for life in lives if look(life, moment)]
            if not is_whole or np.any(answer[2]) or np.any(answer[3]):
                return

    def _reset(self, episode: int, seed: int, kind: str) -> list[Life]:
        instance = self.instance
        instance.progress.episode(episode, seed)
        instance.call("reset", instance.env.reset, **({"seed": seed} if instance.accepts_seed else {}))
        self.resets += 1
        lives = []
        for place, world in enumerate(self._worlds()):
            notes = self.notes.setdefault(place, Notes(world, read_gravity(world.client)))
            notes.gravity = max(notes.gravity, read_gravity(world.client), key=np.linalg.norm)
            if world.key == notes.world.key:
                notes.world = world
                notes.dynamics.append(self._dynamics(world))
            life = Life(world)
            notes.lives.append(life)
            if look(life, Moment(seed, episode, kind, 0)):
                lives.append(life)
        return lives

    def falls_by_itself(self, episode: int) -> None:
        """Reset, and let every world go on without the environment."""
        seed = FIRST_SEED + episode
        self._reset(episode, seed, "none")
        for notes in self.notes.values():
            with contextlib.suppress(bullet().error):
                if not any(notes.gravity):
                    notes.weight_matters = weight_matters(notes.world)
                notes.jumps += jumps(notes.world, seed)

    def _dynamics(self, world: WorldModel) -> list[Dynamics]:
        return [read_dynamics(world.client, body) for body in world.bodies]

    def result(self, ran: source.Functions) -> Worlds:
        """Return everything; the boxes come now, and leave the worlds unusable."""
        moving = {place: notes for place, notes in self.notes.items() if any(life.moves for life in notes.lives)}
        # What never moves is no physics: a copy of the robot that kinematics are solved with.
        chosen = moving or self.notes
        return Worlds(
            [self._world(place, notes) for place, notes in chosen.items()],
            self.steps,
            self.resets,
            source.read_source(self.instance.env, ran),
        )

    def _world(self, place: int, notes: Notes) -> World:
        world, lives = notes.world, notes.lives
        built = self._built.get((world.key, place))
        bodies = []
        for i, body in enumerate(world.bodies):
            try:
                touch = touches(world.client, body)
            except bullet().error:  # the environment has closed its client
                touch = {}
            bodies.append(_body(body, [each[i] for each in notes.dynamics], built[i] if built else None, touch))
        return World(
            gravity=notes.gravity,
            bodies=bodies,
            penetrations=world_summaries.penetrations(lives),
            excesses=world_summaries.excesses(lives),
            speeds=world_summaries.speeds(lives),
            falls=world_summaries.falls(lives),
            jumps=notes.jumps,
            weight_matters=notes.weight_matters,
        )


def _body(body: BodyModel, dynamics: list[Dynamics], built: Dynamics | None, touch: dict[int, Touch]) -> WorldBody:
    links = [
        WorldLink(
            name,
            [each.masses[i] for each in dynamics],
            [each.frictions[i] for each in dynamics],
            built.masses[i] if built else None,
            touch[i - 1].has_shape if touch else None,
            touch[i - 1].collides if touch else None,
        )
        for i, name in enumerate(body.links)
    ]
    return WorldBody(body.name, len(body.joints), body.is_free, links)
