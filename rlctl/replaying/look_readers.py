"""Readers of worlds: of bodies in PyBullet, of a MuJoCo model."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Collection, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from rlctl.environments.bullet_clients import find_clients
from rlctl.environments.driven_joints import joint_name
from rlctl.environments.simulations import find_mujoco
from rlctl.replaying.bullet_bodies import BulletBody, name_bodies, read_bodies, read_body, read_pose, read_state
from rlctl.replaying.look import BodySummary, JointSummary, Pose, Touch, WorldReader
from rlctl.replaying.mujoco_scene import find_trunk_joint
from rlctl.replaying.scene import Env
from rlctl.task.body import Body
from rlctl.task.env import TaskEnv
from rlctl.task.joints import WIDEST_RANGE
from rlctl.task.pybullet.body import PybulletBody
from rlctl.task.pybullet.library import pybullet

if TYPE_CHECKING:
    import mujoco

_MOST_BODIES = 20  # of a world that are named
_NO_LIMIT = 1e5  # [N m, N, rad/s, m/s]; some models write more where a motor has no limit


def make_world_reader(env: Env, other_clients: Collection[int] = ()) -> WorldReader | None:
    """Return a reader of an environment's world after a reset; None if it is of no simulator that rlctl knows.

    `other_clients` are PyBullet clients that existed before the environment.
    """
    inner = env.unwrapped
    if (simulation := find_mujoco(env)) is not None:
        bodies = inner.sim.bodies if isinstance(inner, TaskEnv) else {}
        return MujocoWorldReader(*simulation, bodies)
    if isinstance(inner, TaskEnv):
        return BulletWorldReader({name: _read_task_body(body) for name, body in inner.sim.bodies.items()})
    clients = [client for client in find_clients() if client not in other_clients]
    return BulletWorldReader(_read_clients(clients)) if clients else None


def _read_task_body(body: Body) -> BulletBody:
    """Return a body with the mass that it was built with, rather than that of the episode's events."""
    assert isinstance(body, PybulletBody)  # MuJoCo's worlds have a reader of their own
    return dataclasses.replace(read_body(body.client, body.id), mass=body.total_mass())


def _read_clients(clients: Sequence[int]) -> dict[str, BulletBody]:
    """Return at most 20 bodies of each client by unique names, robots and then free bodies first."""
    named: dict[str, BulletBody] = {}
    for client in clients:
        bodies = [body for body in read_bodies([client]) if not body.is_soft]
        where = f" (client {client})" if len(clients) > 1 else ""
        pairs = sorted(zip(name_bodies(bodies), bodies, strict=True), key=lambda pair: _rank(pair[1]))
        named |= {name + where: body for name, body in pairs[:_MOST_BODIES]}
    return named


def _rank(body: BulletBody) -> tuple[bool, bool]:
    return not body.moving, body.is_fixed


class BulletWorldReader:
    """Reads bodies of PyBullet, which have names of the caller's choice."""

    def __init__(self, bodies: Mapping[str, BulletBody]) -> None:
        self._bodies = bodies
        self._names = {(body.client, body.id): name for name, body in bodies.items()}
        links = {name: body.find_trunk() if body.is_fixed else 0 for name, body in bodies.items()}
        self._trunks = {name: link for name, link in links.items() if link is not None}

    def read_bodies(self) -> list[BodySummary]:
        """Return the bodies, and where their joints are."""
        return [
            BodySummary(name, body.mass, len(body.links), self._find_base(name), _list_joints(body))
            for name, body in self._bodies.items()
        ]

    def _find_base(self, name: str) -> Literal["fixed", "free", "rail"]:
        if name not in self._trunks:
            return "fixed"
        return "rail" if self._bodies[name].is_fixed else "free"

    def read_poses(self) -> Mapping[str, Pose]:
        """Return the poses of the bodies that are not fixed, by name."""
        poses = {}
        for name, link in self._trunks.items():
            with contextlib.suppress(pybullet.error):  # the environment has removed it, or left its client
                poses[name] = Pose(*read_pose(self._bodies[name], link))
        return poses

    def read_touches(self) -> Iterator[Touch]:
        """Yield what the links of bodies with joints, or that are not fixed, touch after the last physics step."""
        for client in {body.client for body in self._bodies.values()}:
            for _, one, two, link, other, _, _, _, distance, force, *_ in _read_points(client):
                first, second = (self._names.get((client, body)) for body in (one, two))
                # PyBullet lists points up to 2 cm apart.
                if first is not None and second is not None and (force > 0 or distance <= 0):
                    overlap = max(0.0, -float(distance))
                    yield from self._list_touches(first, link, second, overlap)
                    yield from self._list_touches(second, other, first, overlap)

    def _list_touches(self, name: str, link: int, other: str, overlap: float) -> Iterator[Touch]:
        body = self._bodies[name]
        if body.moving or name in self._trunks:
            yield Touch(name, body.links[link + 1], other, overlap)


def _list_joints(body: BulletBody) -> list[JointSummary]:
    summaries, states = [], read_state(body).joints
    for index in body.moving:
        joint = body.joints[index]
        low, high = joint.limits if 0 <= joint.limits[1] - joint.limits[0] < WIDEST_RANGE else (None, None)
        unit: Literal["rad", "m"] = "rad" if joint.kind == pybullet.JOINT_REVOLUTE else "m"
        strengths = _strength(joint.max_force), _strength(joint.max_speed)
        summaries.append(JointSummary(joint.name, unit, low, high, states[index][0][0], *strengths))
    return summaries


def _strength(value: float) -> float | None:
    return value if 0 < value < _NO_LIMIT else None


def _read_points(client: int) -> Any:
    with contextlib.suppress(pybullet.error):  # the environment has left its client
        return pybullet.getContactPoints(physicsClientId=client)
    return ()


class MujocoWorldReader:
    """Reads a MuJoCo model: a body is a tree of MuJoCo's bodies that begins at the world.

    `bodies` are those of a task, which know the limits of their files.
    """

    def __init__(self, model: mujoco.MjModel, data: mujoco.MjData, bodies: Mapping[str, Body]) -> None:
        self._model, self._data, self._bodies = model, data, bodies
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
            name, force, speed = self._read_limits(root, joint)
            unit: Literal["rad", "m"] = "m" if kind == int(mujoco.mjtJoint.mjJNT_SLIDE) else "rad"
            start = float(self._data.qpos[model.jnt_qposadr[joint]])
            joints.append(JointSummary(name, unit, low, high, start, force, speed))
        return joints

    def _read_limits(self, root: int, joint: int) -> tuple[str, float | None, float | None]:
        """Return the name of a joint, of a task's body as `joint_names` has it, and its limits of force and speed."""
        model, full_name = self._model, joint_name(self._model, joint)
        body = self._bodies.get(self._names[root])
        name = full_name.partition("/")[2]
        if body is None or name not in body.joint_names:
            force = float(model.jnt_actfrcrange[joint, 1]) if model.jnt_actfrclimited[joint] else None
            return full_name, force, None
        index = body.joint_names.index(name)
        return name, _strength(float(body.joint_max_force[index])), _strength(float(body.joint_max_speed[index]))

    def read_poses(self) -> Mapping[str, Pose]:
        """Return the poses of the bodies that are not fixed, by name: of their centres of mass, as in PyBullet."""
        data = self._data
        poses = {self._names[root]: (data.xipos[body], data.xquat[body]) for root, (body, _) in self._trunks.items()}
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
