"""Readers of worlds: of a `Task`, of PyBullet clients of a plain environment, of a MuJoCo model."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Collection, Iterable, Iterator, Mapping
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from rlctl.checking import bullet_worlds
from rlctl.checking.bullet_worlds import ClientCalls, World, WorldBody, find_clients
from rlctl.environments.info import find_mujoco, joint_name
from rlctl.replaying.mujoco_scene import find_trunk_joint
from rlctl.replaying.scene import Env
from rlctl.replaying.world import BodySummary, JointSummary, Pose, Touch, WorldReader
from rlctl.task.body import Body
from rlctl.task.env import TaskEnv

if TYPE_CHECKING:
    import mujoco

    from rlctl.task.sim import Sim

_NO_LIMIT = 1e5  # [N m, N, rad/s, m/s]; some models write more where a motor has no limit


def make_world_reader(env: Env, other_clients: Collection[int] = ()) -> WorldReader | None:
    """Return a reader of an environment's world after a reset; None if it is of no simulator that rlctl knows.

    `other_clients` are PyBullet clients that existed before the environment.
    """
    if (simulation := find_mujoco(env)) is not None:
        return MujocoWorldReader(*simulation)
    inner = env.unwrapped
    if isinstance(inner, TaskEnv):
        return TaskWorldReader(inner.sim)
    clients = [client for client in find_clients() if client not in other_clients]
    return ClientWorldReader(clients) if clients else None


class TaskWorldReader:
    """Reads the world of a `Task` by the methods of its bodies."""

    def __init__(self, sim: Sim) -> None:
        self._bodies = list(sim.bodies.values())
        trunks = {body.name: body.find_trunk() for body in self._bodies if body.total_mass() > 0}
        self._trunks = {name: trunk for name, trunk in trunks.items() if trunk is not None}

    def read_bodies(self) -> list[BodySummary]:
        """Return the bodies, and where their joints are."""
        return [
            BodySummary(
                body.name, body.total_mass(), len(body.link_names) + 1, self._find_base(body), _list_joints(body)
            )
            for body in self._bodies
        ]

    def _find_base(self, body: Body) -> Literal["fixed", "free", "rail"]:
        if body.name not in self._trunks:
            return "fixed"
        return "rail" if body.fixed else "free"

    def read_poses(self) -> Mapping[str, Pose]:
        """Return the poses of the bodies that are not fixed, by name."""
        moving = [body for body in self._bodies if body.name in self._trunks]
        states = {body.name: body.mass_state(self._trunks[body.name]) for body in moving}
        return {name: Pose(state.position, state.orientation) for name, state in states.items()}

    def read_touches(self) -> Iterator[Touch]:
        """Yield what the links of bodies with joints, or that are not fixed, touch after the last physics step."""
        for body in self._bodies:
            if body.joint_names or body.name in self._trunks:
                for other in self._bodies:
                    yield from _find_touches(body, other)


def _list_joints(body: Body) -> list[JointSummary]:
    columns = (body.joint_low, body.joint_high, body.joint_positions, body.joint_max_force, body.joint_max_speed)
    rows = zip(body.joint_names, body.joint_units, *(column.tolist() for column in columns), strict=True)
    return [
        JointSummary(name, unit, _limit(low), _limit(high), start, _strength(force), _strength(speed))
        for name, unit, low, high, start, force, speed in rows
    ]


def _limit(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _strength(value: float) -> float | None:
    return value if 0 < value < _NO_LIMIT else None


def _find_touches(body: Body, other: Body) -> Iterator[Touch]:
    points = body.contacts_with(other)
    for link, force, distance in zip(*points, strict=True):
        if force > 0 or distance <= 0:  # PyBullet lists points up to 2 cm apart
            yield Touch(body.name, link, other.name, max(0.0, -float(distance)))


class ClientWorldReader:
    """Reads the bodies of PyBullet clients."""

    def __init__(self, clients: Iterable[int]) -> None:
        self._worlds = [bullet_worlds.read_world(client) for client in clients]

    def _name(self, world: World, body: WorldBody) -> str:
        return body.name if len(self._worlds) == 1 else f"{body.name} (client {world.client})"

    def _list_bodies(self) -> list[tuple[World, WorldBody]]:
        return [(world, body) for world in self._worlds for body in world.bodies]

    def read_bodies(self) -> list[BodySummary]:
        """Return the bodies, and where their joints are."""
        return [self._describe(world, body) for world, body in self._list_bodies()]

    def _describe(self, world: World, body: WorldBody) -> BodySummary:
        p = ClientCalls(world.client)
        mass = sum(p.getDynamicsInfo(body.id, link)[0] for link in range(-1, len(body.links) - 1))
        joints = []
        for joint in body.joints:
            low, high = (joint.low, joint.high) if joint.has_limits else (None, None)
            force, speed = p.getJointInfo(body.id, joint.index)[10:12]
            start = p.getJointState(body.id, joint.index)[0]
            unit: Literal["rad", "m"] = "rad" if joint.is_angle else "m"
            joints.append(JointSummary(joint.name, unit, low, high, start, _strength(force), _strength(speed)))
        base: Literal["fixed", "free"] = "free" if body.is_free else "fixed"
        return BodySummary(self._name(world, body), mass, len(body.links), base, joints)

    def read_poses(self) -> Mapping[str, Pose]:
        """Return the poses of the bodies that are not fixed, by name."""
        poses = {}
        for world, body in self._list_bodies():
            p = ClientCalls(world.client)
            with contextlib.suppress(p.error):  # the environment has removed it, or left its client
                if body.is_free:
                    poses[self._name(world, body)] = Pose(*p.getBasePositionAndOrientation(body.id))
        return poses

    def read_touches(self) -> Iterator[Touch]:
        """Yield what the links of bodies with joints, or that are not fixed, touch after the last physics step."""
        for world in self._worlds:
            bodies = {body.id: body for body in world.bodies}
            for _, one, two, link, other, _, _, _, distance, force, *_ in _read_points(world):
                if one in bodies and two in bodies and (force > 0 or distance <= 0):
                    for body, part, touched in ((bodies[one], link, bodies[two]), (bodies[two], other, bodies[one])):
                        if body.joints or body.is_free:
                            name = body.links[part + 1] or ("base" if part < 0 else f"link {part}")
                            names = self._name(world, body), name, self._name(world, touched)
                            yield Touch(*names, max(0.0, -float(distance)))


def _read_points(world: World) -> Any:
    p = ClientCalls(world.client)
    with contextlib.suppress(p.error):  # the environment has left its client
        return p.getContactPoints()
    return ()


class MujocoWorldReader:
    """Reads a MuJoCo model: a body is a tree of MuJoCo's bodies that begins at the world."""

    def __init__(self, model: mujoco.MjModel, data: mujoco.MjData) -> None:
        self._model, self._data = model, data
        self._roots = [body for body in range(1, model.nbody) if model.body_parentid[body] == 0]
        named = {root: (model.body(root).name or f"body {root}").partition("/")[0] for root in self._roots}
        repeated = {root: name for root, name in named.items() if list(named.values()).count(name) > 1}
        self._names = {0: "world"} | named | {root: f"{name} {root}" for root, name in repeated.items()}
        self._trunks = self._find_trunks()
        self._moving = {int(root) for root in model.body_rootid[model.jnt_bodyid]}

    def _find_trunks(self) -> dict[int, tuple[int, Literal["free", "rail"]]]:
        """Return the body that travels, of each tree that has one."""
        model = self._model
        trunks: dict[int, tuple[int, Literal["free", "rail"]]] = {}
        for joint in range(model.njnt):
            body = int(model.jnt_bodyid[joint])
            if (kind := find_trunk_joint(model, joint)) is not None:
                trunks.setdefault(int(model.body_rootid[body]), (body, kind))
        return trunks

    def read_bodies(self) -> list[BodySummary]:
        """Return the bodies, and where their joints are."""
        model = self._model
        ground = [BodySummary("world", 0.0, 1, "fixed", [])] if (model.geom_bodyid == 0).any() else []
        counts = np.bincount(model.body_rootid, minlength=model.nbody)
        return ground + [
            BodySummary(
                self._names[root],
                float(model.body_subtreemass[root]),
                int(counts[root]),
                self._trunks[root][1] if root in self._trunks else "fixed",
                self._list_joints(root),
            )
            for root in self._roots
        ]

    def _list_joints(self, root: int) -> list[JointSummary]:
        import mujoco

        model, joints = self._model, []
        for joint in np.flatnonzero(model.body_rootid[model.jnt_bodyid] == root).tolist():
            kind = int(model.jnt_type[joint])
            if kind < int(mujoco.mjtJoint.mjJNT_SLIDE):  # free, or a ball
                continue
            low, high = model.jnt_range[joint].tolist() if model.jnt_limited[joint] else (None, None)
            force = float(model.jnt_actfrcrange[joint, 1]) if model.jnt_actfrclimited[joint] else None
            unit: Literal["rad", "m"] = "m" if kind == int(mujoco.mjtJoint.mjJNT_SLIDE) else "rad"
            start = float(self._data.qpos[model.jnt_qposadr[joint]])
            joints.append(JointSummary(joint_name(model, joint), unit, low, high, start, force))
        return joints

    def read_poses(self) -> Mapping[str, Pose]:
        """Return the poses of the bodies that are not fixed, by name."""
        data = self._data
        poses = {self._names[root]: (data.xpos[body], data.xquat[body]) for root, (body, _) in self._trunks.items()}
        return {name: Pose(position.copy(), turn[[1, 2, 3, 0]]) for name, (position, turn) in poses.items()}

    def read_touches(self) -> Iterator[Touch]:
        """Yield what the links of bodies with joints, or that are not fixed, touch after the last physics step."""
        model, contacts = self._model, self._data.contact
        for geoms, distance in zip(contacts.geom.tolist(), contacts.dist.tolist(), strict=True):
            if distance > 0 or min(geoms) < 0:  # a flexible body has no geom
                continue
            one, two = (int(model.geom_bodyid[geom]) for geom in geoms)
            for body, other in ((one, two), (two, one)):
                root = int(model.body_rootid[body])
                if root in self._moving:
                    link = model.body(body).name.rpartition("/")[2] or f"body {body}"
                    yield Touch(self._names[root], link, self._names[int(model.body_rootid[other])], -distance)
