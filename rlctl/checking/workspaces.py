"""How far a robot gets: from the joints of its model, set at random in either engine, or from where it came."""

import dataclasses
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlctl.checking import mujoco_worlds
from rlctl.checking.bullet_worlds import read_world
from rlctl.checking.records import FIRST_SEED
from rlctl.checking.rule import NotApplicable
from rlctl.checking.worlds import WorldBody
from rlctl.environments.bullet_clients import ClientCalls
from rlctl.environments.simulations import find_mujoco
from rlctl.task.env import TaskEnv
from rlctl.task.mujoco.sim import MujocoSim

FEWEST_JOINTS, MOST_JOINTS = 2, 12
SAMPLES, SWEEPS, VALUES = 200, 3, 9  # random joint positions; then each joint in turn at so many positions
FEWEST_DIRECTIONS, FEWEST_EPISODES = 6, 6  # in which the robot came as far
SHARP = 0.005  # part of the reach: what is as far
FEWEST_STOPS = 3  # episodes that come to the same bits
FAR = 1e3  # how far a slide without limits gets [m]
EDGE = 1e-5  # part of the range: what is at a stop
Numbers = NDArray[np.float64]


@dataclasses.dataclass(frozen=True)
class Chain:
    """A robot whose base is fixed: its joints can be set and its links be read, without a step of the simulation."""

    ranges: Sequence[tuple[float, float]]  # of its joints [rad], [m]
    base: Numbers  # Position of the base [m]. Shape (3,)
    set_joints: Callable[[Numbers], None]
    read: Callable[[], Numbers]  # Positions of its links [m]. Shape (links, 3)
    names: Sequence[str]  # of the links


@dataclasses.dataclass(frozen=True)
class Reach:
    """Places that are within a distance of a centre."""

    centre: Sequence[float]  # [m]
    distance: float  # [m]
    how: str  # this was found out, as a sentence
    unit: str = ""


def find_chains(env: Any, clients: Iterable[int]) -> Iterator[Chain]:
    """Yield the robots of an environment that are fixed to the world, in its clients of PyBullet or in MuJoCo."""
    for client in clients:
        for body in read_world(client).bodies:
            if not body.is_free and FEWEST_JOINTS <= len(body.joints) <= MOST_JOINTS:
                yield _bullet_chain(ClientCalls(client), body)
    inner, mujoco = getattr(env, "unwrapped", env), sys.modules.get("mujoco")
    if isinstance(inner, TaskEnv) and isinstance(inner.sim, MujocoSim):
        for robot in inner.sim.bodies.values():
            if robot.fixed and FEWEST_JOINTS <= len(robot.joint_names) <= MOST_JOINTS:
                yield _mujoco_chain(mujoco, inner.sim.model, inner.sim.data, robot.parts.joints)
        return
    model, data = (getattr(inner, name, None) for name in ("model", "data"))
    if mujoco is not None and isinstance(model, mujoco.MjModel) and isinstance(data, mujoco.MjData):
        single = [int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE)]
        joints = [j for j in range(model.njnt) if model.jnt_type[j] in single]
        if len(joints) == model.njnt and FEWEST_JOINTS <= len(joints) <= MOST_JOINTS:  # else the robot may be free
            yield _mujoco_chain(mujoco, model, data, joints)


@dataclasses.dataclass(frozen=True)
class FreeObject:
    """A body without joints that nothing holds."""

    read: Callable[[], Numbers]  # its position [m]. Shape (3,)
    shift: Callable[[Numbers], None]  # moves it at once by some axes of the world [m]. Shape (up to 3,)


def find_objects(env: Any, clients: Iterable[int]) -> dict[str, FreeObject]:
    """Return the free bodies without joints of an environment, by name, in its clients of PyBullet or in MuJoCo."""
    objects: dict[str, FreeObject] = {}
    for client in clients:
        for body in read_world(client).bodies:
            if body.is_free and not body.joints:
                objects[body.name] = _bullet_object(ClientCalls(client), body.id)
    if (simulation := find_mujoco(env)) is not None:
        model, data = simulation
        for body in mujoco_worlds.read_world(model).bodies:
            if body.is_free and not body.joints:
                objects[body.name] = _mujoco_object(data, int(model.jnt_qposadr[model.body_jntadr[body.id]]))
    return objects


def _bullet_object(p: ClientCalls, body: int) -> FreeObject:
    def read() -> Numbers:
        return np.array(p.getBasePositionAndOrientation(body)[0])

    def shift(by: Numbers) -> None:
        position, orientation = p.getBasePositionAndOrientation(body)
        velocity = p.getBaseVelocity(body)
        moved = np.array(position)
        moved[: by.size] += by
        p.resetBasePositionAndOrientation(body, moved.tolist(), orientation)
        p.resetBaseVelocity(body, *velocity)  # the call before has stopped it

    return FreeObject(read, shift)


def _mujoco_object(data: Any, first: int) -> FreeObject:
    def shift(by: Numbers) -> None:
        data.qpos[first : first + by.size] += by

    return FreeObject(lambda: np.array(data.qpos[first : first + 3]), shift)


def _bullet_chain(p: ClientCalls, body: WorldBody) -> Chain:
    links = list(range(len(body.links) - 1))

    def set_joints(values: Numbers) -> None:
        for joint, value in zip(body.joints, values.tolist(), strict=True):
            p.resetJointState(body.id, joint.index, value)

    def read() -> Numbers:
        states = p.getLinkStates(body.id, links, computeForwardKinematics=1)
        return np.array([place for state in states for place in (state[0], state[4])])

    names = [f"{name}{of}" for name in body.links[1:] for of in (" (centre of mass)", "")]
    ranges = [(joint.low, joint.high) if joint.has_limits else _endless(joint.is_angle) for joint in body.joints]
    return Chain(ranges, np.array(p.getBasePositionAndOrientation(body.id)[0]), set_joints, read, names)


def _mujoco_chain(mujoco: Any, model: Any, data: Any, joints: Sequence[int]) -> Chain:
    copy = mujoco.MjData(model)
    copy.qpos[:] = data.qpos
    mujoco.mj_kinematics(model, copy)

    def set_joints(values: Numbers) -> None:
        copy.qpos[model.jnt_qposadr[joints]] = values

    # Only what these joints move: other bodies, such as an object to push, also get elsewhere.
    moving = set(model.jnt_bodyid[joints].tolist())
    for body in range(model.nbody):  # parents come first
        if int(model.body_parentid[body]) in moving:
            moving.add(body)
    bodies = sorted(moving)
    sites = [i for i in range(model.nsite) if model.site_bodyid[i] in moving]

    def read() -> Numbers:
        mujoco.mj_kinematics(model, copy)
        return np.vstack([copy.xpos[bodies], copy.site_xpos[sites]])

    is_angle = [int(model.jnt_type[j]) == int(mujoco.mjtJoint.mjJNT_HINGE) for j in joints]
    limits = [
        tuple(model.jnt_range[j].tolist()) if model.jnt_limited[j] else _endless(turns)
        for j, turns in zip(joints, is_angle, strict=True)
    ]
    bodies_named = [model.body(i).name or f"body {i}" for i in bodies]
    names = bodies_named + [model.site(i).name or f"site {i}" for i in sites]
    return Chain(limits, copy.xpos[model.jnt_bodyid[joints[0]]].copy(), set_joints, read, names)


def _endless(is_angle: bool) -> tuple[float, float]:
    """Return where a joint without limits gets [rad], [m]."""
    return (-np.pi, np.pi) if is_angle else (-FAR, FAR)


def measure_reach(chain: Chain, link: int, axes: Sequence[int]) -> Reach:
    """Return how far from the base a link gets, along some axes of the world: at random, and then joint by joint."""
    reach = _maximise(chain, lambda: float(np.linalg.norm((chain.read()[link] - chain.base)[list(axes)])))
    how = (
        f"with all joints anywhere within their limits, {chain.names[link]} gets {reach:.4g} m away from there at most"
    )
    return Reach(chain.base[list(axes)].tolist(), reach, how, " m")


def measure_box(chain: Chain, link: int) -> tuple[Numbers, Numbers]:
    """Return between what coordinates of the world a link gets [m], shape (3,) each."""

    def measure(axis: int, sign: int) -> float:
        return sign * _maximise(chain, lambda: sign * float(chain.read()[link][axis]))

    return np.array([measure(axis, -1) for axis in range(3)]), np.array([measure(axis, 1) for axis in range(3)])


def _maximise(chain: Chain, measure: Callable[[], float]) -> float:
    """Return the largest of what is measured, with all joints anywhere within their limits."""
    low, high = np.array(chain.ranges).T
    rng = np.random.default_rng(FIRST_SEED)

    def measure_at(values: Numbers) -> float:
        chain.set_joints(values)
        return measure()

    best = max(rng.uniform(low, high, (SAMPLES, len(low))), key=measure_at)
    for _ in range(SWEEPS):
        for joint in range(len(low)):
            others = np.tile(best, (VALUES + 1, 1))
            others[1:, joint] = np.linspace(low[joint], high[joint], VALUES)
            best = max(others, key=measure_at)
    return measure_at(best)


def find_reach(places: Numbers, episodes: NDArray[np.int64]) -> Reach:
    """Return a centre and how far from it the robot came, if it came as far in many directions: workspaces have such an
    edge, paths have not. Shapes of places: (n, size), of episodes: (n,). Raises `NotApplicable` if there is none."""
    size = places.shape[1]
    if size == 1:
        return _find_stops(places[:, 0], episodes)
    directions = _spread_directions(size)
    for centre in (np.zeros(size), _fit_centre(places, directions)):
        from_centre = places - centre
        radii = np.linalg.norm(from_centre, axis=1)
        nearest = np.argmax(from_centre @ directions.T, axis=1)
        is_far = radii >= (1 - SHARP) * radii.max()
        if len(np.unique(nearest[is_far])) >= FEWEST_DIRECTIONS and len(np.unique(episodes[is_far])) >= FEWEST_EPISODES:
            how = f"the robot came {radii.max():.4g} away from there in many directions, and never farther"
            return Reach(centre.tolist(), float(radii.max()), how)
    raise NotApplicable("nothing limits where the robot gets")


def _find_stops(places: Numbers, episodes: NDArray[np.int64]) -> Reach:
    """Return the middle of two stops, and their distance from it: a robot on a rail comes as far in many episodes."""
    low, high = float(places.min()), float(places.max())
    starts = places[np.searchsorted(episodes, episodes)]
    for stop in (low, high):
        is_there = (np.abs(places - stop) <= EDGE * (high - low)) & (np.abs(starts - stop) > SHARP * (high - low))
        if len(np.unique(episodes[is_there])) < FEWEST_STOPS:
            raise NotApplicable("nothing limits where the robot gets")
    how = f"the robot was stopped {(high - low) / 2:.4g} away from there on both sides"
    return Reach([(low + high) / 2], (high - low) / 2, how)


def _spread_directions(size: int) -> Numbers:
    grid = np.array(np.meshgrid(*[(-1.0, -0.5, 0.0, 0.5, 1.0)] * size)).reshape(size, -1).T
    grid = grid[np.abs(grid).max(axis=1) == 1.0]
    return np.asarray(grid / np.linalg.norm(grid, axis=1, keepdims=True))


def _fit_centre(places: Numbers, directions: Numbers) -> Numbers:
    """Return the centre of the sphere that is nearest to the outermost places: |p|^2 = 2 p c + rest."""
    outermost = places[np.unique(np.argmax(places @ directions.T, axis=0))]
    columns = np.hstack([2 * outermost, np.ones((len(outermost), 1))])
    return np.asarray(np.linalg.lstsq(columns, np.square(outermost).sum(axis=1), rcond=1e-6)[0][:-1])
