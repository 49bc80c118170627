"""Reads PyBullet clients that an environment made: their bodies, how these move, and which links touch.

It does not call `getCollisionShapeData`, which crashes on some models.
"""

import contextlib
import dataclasses
import itertools
import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from rlctl.checking.worlds import (
    LONGEST_S,
    MOST_BODIES,
    MOST_JOINTS,
    MOST_LINKS,
    MOST_STEPS,
    VELOCITY,
    Array,
    Joint,
    JointKey,
    Jump,
    Link,
    MotorStrength,
    MotorTarget,
    Pair,
    Poses,
    World,
    WorldBody,
)
from rlctl.environments.bullet_calls import BulletCalls
from rlctl.environments.bullet_clients import ClientCalls, bullet

GRAVITY, WEIGHT_STEPS = -9.81, 20  # [m/s^2]
CREATED = "link0"  # PyBullet's name for the base of each body that createMultiBody makes
UNMOVED = 1e-6  # smaller differences are no effect of gravity [m, rad, m/s, rad/s]; stiff motors leave little


def read_world(client: int) -> World:
    """Return what a client holds now."""
    p, bodies = ClientCalls(client), []
    for i in range(p.getNumBodies()):
        with contextlib.suppress(p.error):  # a soft body, which has neither links nor a mass
            bodies.append(_body(client, p.getBodyUniqueId(i)))
    bodies = sorted(bodies, key=lambda body: (not body.joints, not body.is_free))[:MOST_BODIES]
    names = [body.name for body in bodies]
    for i, name in enumerate(names):
        if count := names[:i].count(name):  # not their ids, which are others at every reset of some environments
            bodies[i] = dataclasses.replace(bodies[i], name=f"{name} ({count + 1})")
    return World(client, tuple(bodies))


def _body(client: int, body: int) -> WorldBody:
    p = ClientCalls(client)
    base, name = (text.decode(errors="replace") for text in p.getBodyInfo(body))
    if not name and base == CREATED:
        base = ""
    infos = [p.getJointInfo(body, i) for i in range(p.getNumJoints(body))]
    moving = [info for info in infos if info[2] in (p.JOINT_REVOLUTE, p.JOINT_PRISMATIC)]
    joints = [_joint(info, info[2] == p.JOINT_REVOLUTE) for info in moving]
    links = [base, *(info[12].decode(errors="replace") for info in infos)]
    base_mass, *masses = (p.getDynamicsInfo(body, i)[0] for i in range(-1, len(infos)))
    name, has_heavy_links = name or base or "a body", bool(joints) and any(mass > 0 for mass in masses)
    return WorldBody(body, name, tuple(links), tuple(joints[:MOST_JOINTS]), base_mass > 0, has_heavy_links)


def _joint(info: Sequence[Any], is_angle: bool) -> Joint:
    return Joint(info[0], info[1].decode(errors="replace"), is_angle, info[8], info[9], effort=info[10])


def read_states(world: World) -> list[Array]:
    """Return the state of each body. Shape (9 + 2 * joints,) each."""
    p = ClientCalls(world.client)
    states = []
    for body in world.bodies:
        position, _ = p.getBasePositionAndOrientation(body.id)
        joints = p.getJointStates(body.id, [j.index for j in body.joints]) or ()
        numbers = np.ravel([joint[:2] for joint in joints], "F")  # all positions, then all speeds
        states.append(np.concatenate([position, *p.getBaseVelocity(body.id), numbers]))
    return states


def read_poses(world: World) -> Poses:
    """Return the pose of each base that is free, and of each link of a robot, as `Poses` has them."""
    p = ClientCalls(world.client)
    poses: dict[Link, Array] = {}
    for body in world.bodies:
        if body.is_free:
            position, quaternion = p.getBasePositionAndOrientation(body.id)
            poses[body.id, -1] = np.array([*position, *quaternion, *position])
        links = range(min(MOST_LINKS, len(body.links) - 1)) if body.joints else ()
        for link, state in zip(links, p.getLinkStates(body.id, links, computeForwardKinematics=1) or (), strict=False):
            poses[body.id, link] = np.array([*state[4], *state[5], *state[0]])
    return poses


def read_points(world: World) -> Array:
    """Return place and velocity of each link of a robot and each base that is free, as `StateReader` has them."""
    p = ClientCalls(world.client)
    rows = []
    for body in world.bodies:
        if body.is_free:
            position, quaternion = p.getBasePositionAndOrientation(body.id)
            rows.append([*position, *position, *quaternion, *np.ravel(p.getBaseVelocity(body.id))])
        links = range(min(MOST_LINKS, len(body.links) - 1)) if body.joints else ()
        states = p.getLinkStates(body.id, links, computeLinkVelocity=1, computeForwardKinematics=1) if links else ()
        rows += [[*state[4], *state[0], *state[5], *state[6], *state[7]] for state in states or ()]
    return np.array(rows, np.float64).reshape(-1, 16)


def name_points(world: World) -> list[str]:
    """Name the rows of `read_points`."""
    names = []
    for body in world.bodies:
        names += [world.link_name((body.id, -1))] if body.is_free else []
        links = range(min(MOST_LINKS, len(body.links) - 1)) if body.joints else ()
        names += [world.link_name((body.id, link)) for link in links]
    return names


def read_physics(client: int) -> tuple[list[float], float]:
    """Return the gravity of a client [m/s^2], and how long one step of its physics is [s]."""
    parameters = ClientCalls(client).getPhysicsEngineParameters()
    gravity = [float(parameters[f"gravityAcceleration{axis}"]) for axis in "XYZ"]
    return gravity, float(parameters["fixedTimeStep"]) / max(1, int(parameters["numSubSteps"]))


def read_contacts(client: int) -> dict[Pair, float]:
    """Return the deepest distance per pair of links that touch [m]; below zero they are inside each other."""
    deepest: dict[Pair, float] = {}
    for contact in ClientCalls(client).getContactPoints() or ():
        pair = (contact[1], contact[3]), (contact[2], contact[4])
        deepest[pair] = min(deepest.get(pair, math.inf), contact[8])
    return deepest


def read_overlaps(world: World) -> dict[Pair, float]:
    """Return the deepest distance per pair of links that are inside each other, of each free body and any other; the
    engine may not have looked for contacts since the bodies were placed."""
    p = ClientCalls(world.client)
    deepest: dict[Pair, float] = {}
    for one, two in itertools.combinations(world.bodies, 2):
        for point in p.getClosestPoints(one.id, two.id, 0.0) if one.is_free or two.is_free else ():
            pair = (one.id, point[3]), (two.id, point[4])
            deepest[pair] = min(deepest.get(pair, 0.0), point[8])
    return deepest


def weight_matters(world: World) -> bool:
    """Say whether gravity would change the motion of a world without it: not where all that moves moves level."""
    p = ClientCalls(world.client)
    state = p.saveState()
    ends = []
    for gravity in (0.0, GRAVITY):
        p.restoreState(state)
        p.setGravity(0.0, 0.0, gravity)
        for _ in range(WEIGHT_STEPS):
            p.stepSimulation()
        ends.append(np.concatenate(read_states(world)))
    p.restoreState(state)
    p.setGravity(0.0, 0.0, 0.0)
    p.removeState(state)
    return bool(np.abs(ends[0] - ends[1]).max(initial=0.0) > UNMOVED)


def find_jumps(world: World, seed: int) -> list[Jump]:
    """Simulate a world without its environment, and return how fast each free body became."""
    p = ClientCalls(world.client)
    dt = float(p.getPhysicsEngineParameters()["fixedTimeStep"])
    gravity = float(np.linalg.norm(read_physics(world.client)[0]))
    speeds = [_free_speeds(world)]
    for _ in range(min(MOST_STEPS, max(1, round(LONGEST_S / dt))) if dt > 0 else 0):
        p.stepSimulation()
        speeds.append(_free_speeds(world))
    jumps = []
    for name, before in speeds[0].items():
        step = max(range(len(speeds)), key=lambda i: speeds[i][name])
        jumps.append(Jump(name, speeds[step][name], before + gravity * step * dt, step * dt, seed))
    return jumps


def _free_speeds(world: World) -> dict[str, float]:
    states = zip(world.bodies, read_states(world), strict=True)
    speeds = {body.name: float(np.linalg.norm(state[VELOCITY])) for body, state in states if body.is_free}
    return {name: min(speed, 1e6) if math.isfinite(speed) else 1e6 for name, speed in speeds.items()}


class BulletStateReader:
    """Reads one client: a `StateReader`."""

    def __init__(self, world: World, calls: BulletCalls) -> None:
        self.world = world
        self._calls = calls
        self._before: tuple[list[Array], Poses] | None = None

    @property
    def errors(self) -> tuple[type[Exception], ...]:
        """See `StateReader`."""
        return (bullet().error,)

    def update(self) -> None:
        """See `StateReader`; every value is read when it is asked for."""

    def read_command(self) -> Array | None:
        """See `StateReader`; not known for PyBullet."""
        return None

    def remember(self) -> None:
        """Keep the present values as those before the next step of the physics."""
        self._before = read_states(self.world), read_poses(self.world)

    def read_before(self) -> tuple[list[Array], Poses] | None:
        """See `StateReader`; only what `remember` kept."""
        return self._before

    def read_states(self) -> list[Array]:
        """See `StateReader`."""
        return read_states(self.world)

    def read_poses(self) -> Poses:
        """See `StateReader`."""
        return read_poses(self.world)

    def name_points(self) -> list[str]:
        """See `StateReader`."""
        return name_points(self.world)

    def read_points(self) -> Array:
        """See `StateReader`."""
        return read_points(self.world)

    def throw(self, bodies: Sequence[WorldBody], velocities: Array) -> None:
        """See `StateReader`."""
        p = ClientCalls(self.world.client)
        for body, velocity in zip(bodies, velocities.tolist(), strict=True):
            p.resetBaseVelocity(body.id, velocity[:3], velocity[3:])

    def read_contacts(self) -> dict[Pair, float]:
        """See `StateReader`."""
        return read_contacts(self.world.client)

    def read_overlaps(self) -> dict[Pair, float]:
        """See `StateReader`."""
        return read_overlaps(self.world)

    def find_thickness(self, pair: Pair) -> float:
        """See `StateReader`."""
        boxes = [ClientCalls(self.world.client).getAABB(*link) for link in pair]
        return min(float(b - a) for low, high in boxes for a, b in zip(low, high, strict=True))

    def read_targets(self) -> dict[JointKey, MotorTarget]:
        """See `StateReader`; only what was set by a position."""
        targets = self._calls.targets.values()
        own = [target for target in targets if target.client == self.world.client]
        factor = self._read_motor_factor() if own else 1
        return {
            (t.body, t.joint): MotorTarget(t.value, factor * t.force, t.call.name, (t.call.file, t.call.line))
            for t in own
        }

    def _read_motor_factor(self) -> int:
        """Return how many times stronger motors are than they are told: PyBullet computes a motor's impulse for the
        time of a whole step, and applies it in every substep."""
        return max(1, int(ClientCalls(self.world.client).getPhysicsEngineParameters()["numSubSteps"]))

    def read_strengths(self) -> dict[JointKey, MotorStrength]:
        """See `StateReader`."""
        found: dict[JointKey, MotorStrength] = {}
        for (client, body, joint), torque in self._calls.torques.items():
            if client == self.world.client:
                found[body, joint] = MotorStrength(torque.value, True, (torque.call.file, torque.call.line))
        factor = self._read_motor_factor()
        for (client, body, joint), given in self._calls.strengths.items():
            if client == self.world.client:
                where = (given.call.file, given.call.line)
                found[body, joint] = MotorStrength(factor * given.value, given.speed > 0, where)
        return found

    def read_weights(self) -> dict[JointKey, float]:
        """See `StateReader`; empty where a constraint may carry a robot."""
        p = ClientCalls(self.world.client)
        weights: dict[JointKey, float] = {}
        for body, state in zip(self.world.bodies, read_states(self.world), strict=True):
            still = [0.0] * len(body.joints)
            if body.is_free or not still or p.getNumConstraints():
                continue
            with contextlib.suppress(p.error):  # it has joints of several degrees of freedom
                torques = p.calculateInverseDynamics(body.id, state[9 : 9 + len(still)].tolist(), still, still)
                weights |= {(body.id, joint.index): abs(t) for joint, t in zip(body.joints, torques, strict=True)}
        return weights

    def read_physics(self) -> tuple[list[float], float]:
        """See `StateReader`."""
        return read_physics(self.world.client)

    def read_time(self) -> float:
        """See `StateReader`; from the calls of stepSimulation that were recorded."""
        step_s = float(ClientCalls(self.world.client).getPhysicsEngineParameters()["fixedTimeStep"])
        return self._calls.steps[self.world.client] * step_s

    def read_failure(self) -> str:
        """See `StateReader`; PyBullet reports nothing."""
        return ""

    def weight_matters(self) -> bool:
        """See `StateReader`."""
        return weight_matters(self.world)

    def find_jumps(self, seed: int) -> list[Jump]:
        """See `StateReader`; the world is changed."""
        return find_jumps(self.world, seed)
