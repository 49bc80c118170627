"""Experiments on a world after its environment is done with it: whether links collide, and whether it is at rest."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
from numpy.typing import NDArray

from rlctl.check_env.bullet_worlds import Body, World, bullet, read_gravity, read_states

LONGEST_S = 0.1
"""How long a world goes on without its environment [s]: what was put inside something is thrown out by then."""
MOST_STEPS = 100
GRAVITY = -9.81  # [m/s^2]
WEIGHT_STEPS = 20
UNMOVED = 1e-3
"""Gravity changes nothing where no position or speed differs by more [m, rad, m/s, rad/s]."""
ALL_GROUPS = -1
"""A collision group and mask of all bits."""
LEAST_HALF = 0.05  # [m]
FARTHEST = 100.0
"""A body that is larger than this is not a robot, and no box is put around it [m]."""


@dataclasses.dataclass(frozen=True)
class Touch:
    """What a box around a body shows of one of its links."""

    has_shape: bool
    collides: bool


def touch_links(client: int, body: Body) -> dict[int, Touch]:
    """Put a box around a robot or a free body and return, per link index, what touches it; empty for all others."""
    p = bullet()
    if not (body.joints or body.is_free):
        return {}
    indices = range(-1, len(body.links) - 1)
    boxes = np.array([p.getAABB(body.id, i, physicsClientId=client) for i in indices])
    low, high = boxes[:, 0].min(axis=0), boxes[:, 1].max(axis=0)
    if not np.isfinite(boxes).all() or (high - low).max() > FARTHEST:
        return {}
    shape = p.createCollisionShape(
        p.GEOM_BOX, halfExtents=np.maximum(high - low, LEAST_HALF).tolist(), physicsClientId=client
    )
    # With a mass: what is fixed to the world does not collide with what is fixed, too.
    box = p.createMultiBody(1.0, shape, basePosition=((low + high) / 2).tolist(), physicsClientId=client)
    try:
        p.setCollisionFilterGroupMask(box, -1, ALL_GROUPS, ALL_GROUPS, physicsClientId=client)
        p.performCollisionDetection(physicsClientId=client)
        contacts = p.getContactPoints(body.id, box, physicsClientId=client) or ()
        near = p.getClosestPoints(body.id, box, 0.0, physicsClientId=client) or ()
    finally:
        p.removeBody(box, physicsClientId=client)
    colliding, shaped = {each[3] for each in contacts}, {each[3] for each in near}
    return {i: Touch(i in shaped or i in colliding, i in colliding) for i in indices}


def weight_matters(world: World) -> bool:
    """Say whether gravity would change how a world without it goes on: not where all that moves moves level."""
    p, client = bullet(), world.client
    state = p.saveState(physicsClientId=client)
    ends = []
    for gravity in (0.0, GRAVITY):
        p.restoreState(state, physicsClientId=client)
        p.setGravity(0.0, 0.0, gravity, physicsClientId=client)
        for _ in range(WEIGHT_STEPS):
            p.stepSimulation(physicsClientId=client)
        ends.append(np.concatenate([each.numbers for each in read_states(world)]))
    p.restoreState(state, physicsClientId=client)
    p.setGravity(0.0, 0.0, 0.0, physicsClientId=client)
    p.removeState(state, physicsClientId=client)
    return bool(np.abs(ends[0] - ends[1]).max(initial=0.0) > UNMOVED)


@dataclasses.dataclass(frozen=True)
class Jump:
    """How fast a free body became right after a reset, with nothing done to it."""

    body: str
    speed: float
    """[m/s]."""
    explained: float
    """The speed that it had, and that falling adds [m/s]."""
    after_s: float
    seed: int


def find_jumps(world: World, seed: int) -> list[Jump]:
    """Let a world go on without its environment, and return how fast each free body became."""
    p, client = bullet(), world.client
    free = [body for body in world.bodies if body.is_free]
    dt = float(p.getPhysicsEngineParameters(physicsClientId=client)["fixedTimeStep"])
    steps = min(MOST_STEPS, max(1, round(LONGEST_S / dt))) if dt > 0 else 0
    start = {body.id: _velocity(client, body) for body in free}
    fastest = {body.id: (0.0, 0.0) for body in free}
    for step in range(1, steps + 1):
        p.stepSimulation(physicsClientId=client)
        for body in free:
            speed = float(np.linalg.norm(_velocity(client, body)))
            fastest[body.id] = max(fastest[body.id], (speed if math.isfinite(speed) else math.inf, step * dt))
    gravity = float(np.linalg.norm(read_gravity(client)))
    return [
        Jump(body.name, min(speed, 1e6), float(np.linalg.norm(start[body.id])) + gravity * after, after, seed)
        for body in free
        for speed, after in [fastest[body.id]]
    ]


def _velocity(client: int, body: Body) -> NDArray[np.float64]:
    return np.array(bullet().getBaseVelocity(body.id, physicsClientId=client)[0])
