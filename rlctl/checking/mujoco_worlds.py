"""Reads the model and the data of an environment that MuJoCo simulates, without changing either.

`MjData` has what is derived from positions (poses of bodies, contacts) as of the last substep's beginning. A copy is
brought up to date at each `update`, and read.
"""

import functools
import math
import sys
from collections.abc import Sequence
from typing import Any

import numpy as np

from rlctl.checking.values import Attribute
from rlctl.checking.worlds import (
    LONGEST_S,
    MOST_BODIES,
    MOST_JOINTS,
    MOST_LINKS,
    MOST_STEPS,
    Array,
    Joint,
    JointActuator,
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
from rlctl.environments.simulations import find_mujoco

FREE, BALL, SLIDE, HINGE = range(4)  # MuJoCo's types of joints
PLANES = (0, 1)  # Types of geoms without a thickness: planes and height fields
ON_JOINT, FIXED_GAIN, NO_BIAS, AFFINE = (
    (0, 1),
    0,
    0,
    1,
)  # Types of actuators: what they move, and how they compute their force
LINEAR = (FIXED_GAIN, AFFINE)
FIELDS = ("data.", "model.")
KEPT = (
    *("data.qpos", "data.qvel", "data.time", "data.act", "data.ctrl", "data.qfrc_applied", "data.xfrc_applied"),
    *("data.mocap_pos", "data.mocap_quat", "data.userdata"),
    *("data.qacc_warmstart", "model.body_mass", "model.geom_friction", "model.dof_damping", "model.actuator_gainprm"),
)
"""What mj_resetData sets back, and what is randomised most often."""
UNSTABLE = ("mjWARN_BADQPOS", "mjWARN_BADQVEL", "mjWARN_BADQACC")


def library() -> Any:
    """Return MuJoCo, which the environment has loaded."""
    return sys.modules["mujoco"]


def copy_data(target: Any, model: Any, source: Any) -> None:
    """Make one MjData equal to another of the same model."""
    mujoco = library()
    if hasattr(mujoco, "mj_copyData"):
        mujoco.mj_copyData(target, model, source)
        return
    # Older versions cannot copy into an MjData that exists; so what is derived is computed again.
    state = np.empty(mujoco.mj_stateSize(model, mujoco.mjtState.mjSTATE_INTEGRATION))
    mujoco.mj_getState(model, source, state, mujoco.mjtState.mjSTATE_INTEGRATION)
    mujoco.mj_setState(model, target, state, mujoco.mjtState.mjSTATE_INTEGRATION)
    mujoco.mj_forward(model, target)


def read_kept_fields(env: Any) -> dict[str, Attribute]:
    """Return copies of the fields of `KEPT` of an environment that MuJoCo simulates; empty for any other."""
    if (simulation := find_mujoco(env)) is None:
        return {}
    owners = dict(zip(FIELDS, reversed(simulation), strict=True))
    pairs = [(name, owners[f"{name.partition('.')[0]}."], name.partition(".")[2]) for name in KEPT]
    copies = [(name, owner, key, np.array(getattr(owner, key))) for name, owner, key in pairs]
    return {name: Attribute(name, owner, key, value) for name, owner, key, value in copies if value.size}


def refresh(model: Any, data: Any) -> None:
    """Compute what follows from positions and velocities: poses, contacts, their sensors. No callback is called."""
    mujoco = library()
    mujoco.mj_fwdPosition(model, data)
    mujoco.mj_sensorPos(model, data)
    mujoco.mj_fwdVelocity(model, data)
    mujoco.mj_sensorVel(model, data)


def read_world(model: Any) -> World:
    """Return the bodies of a model: one for each tree of MuJoCo's bodies, and the world itself."""
    roots = [body for body in range(1, model.nbody) if int(model.body_parentid[body]) == 0]
    bodies = sorted((_body(model, root) for root in roots), key=lambda body: (not body.joints, not body.is_free))
    world = WorldBody(0, "what is fixed to the world", ("",), (), is_free=False, has_heavy_links=False)
    motors = [_motor(model, actuator) for actuator in range(model.nu)]
    known = tuple(motor for motor in motors if motor is not None)  # others drive tendons and sites
    return World(0, (*bodies[:MOST_BODIES], world), "MuJoCo", known)


def _links(model: Any, root: int) -> list[int]:
    return [int(body) for body in np.flatnonzero(model.body_rootid == root)]


def _body(model: Any, root: int) -> WorldBody:
    links = _links(model, root)
    names = [model.body(link).name for link in links]
    numbers = [joint for joint in range(model.njnt) if int(model.jnt_bodyid[joint]) in links]
    joints = [_joint(model, joint) for joint in numbers if int(model.jnt_type[joint]) >= SLIDE][:MOST_JOINTS]
    is_free = any(int(model.jnt_type[j]) == FREE for j in numbers)
    heavy = bool(joints) and bool((model.body_mass[links[1:]] > 0).any())
    return WorldBody(root, names[0] or f"body {root}", tuple(names), tuple(joints), is_free, heavy)


def _joint(model: Any, joint: int) -> Joint:
    low, high = model.jnt_range[joint] if model.jnt_limited[joint] else (0.0, -1.0)
    name = model.joint(joint).name or f"joint {joint}"
    link = model.body(int(model.jnt_bodyid[joint])).name
    effort = float(np.abs(model.jnt_actfrcrange[joint]).max()) if model.jnt_actfrclimited[joint] else 0.0
    return Joint(joint, name, int(model.jnt_type[joint]) != SLIDE, float(low), float(high), link, effort)


def _motor(model: Any, actuator: int) -> JointActuator | None:
    joint = int(model.actuator_trnid[actuator, 0])
    if int(model.actuator_trntype[actuator]) not in ON_JOINT or int(model.jnt_type[joint]) < SLIDE:
        return None
    gain, bias = float(model.actuator_gainprm[actuator, 0]), float(model.actuator_biasprm[actuator, 1])
    kinds = int(model.actuator_gaintype[actuator]), int(model.actuator_biastype[actuator])
    holds = kinds == (FIXED_GAIN, AFFINE) and gain > 0 and math.isclose(bias, -gain)
    has_range = bool(model.actuator_ctrllimited[actuator])
    low, high = model.actuator_ctrlrange[actuator] if has_range else (-math.inf, math.inf)
    name = model.actuator(actuator).name or f"actuator {actuator}"
    root, gear = int(model.body_rootid[model.jnt_bodyid[joint]]), float(model.actuator_gear[actuator, 0]) or 1.0
    return JointActuator(actuator, name, _joint(model, joint), root, holds, gear, float(low), float(high))


def read_commands(data: Any, motors: Sequence[JointActuator]) -> Array:
    """Return a copy of what was last written for some motors. Shape (motors,)."""
    return np.array(data.ctrl[[motor.number for motor in motors]])


class MujocoStateReader:
    """Reads one model and its data: a `StateReader`."""

    errors = ()

    def __init__(self, model: Any, data: Any) -> None:
        self.model, self.data = model, data
        self.world = read_world(model)
        self._now, self._other = library().MjData(model), library().MjData(model)
        self._before: tuple[Array, Array] | None = None  # qpos and qvel before the last call that advanced the physics
        self.touched: list[set[int]] = []  # The geoms that touch another one, at each update
        self._calls = 0
        """Calls since the last update that advanced the physics by one substep each; -1 if one took several."""
        self._links = {body.id: _links(model, body.id) for body in self.world.bodies if body.id}
        self._link_of = {body: (root, i - 1) for root, links in self._links.items() for i, body in enumerate(links)}

    def update(self) -> None:
        """See `StateReader`."""
        copy_data(self._now, self.model, self.data)
        refresh(self.model, self._now)
        contacts = self._now.contact
        self.touched.append(set(contacts.geom[(contacts.dist <= 0) & (contacts.exclude == 0)].ravel().tolist()))

    def remember(self, nstep: int) -> None:
        """Keep positions and velocities as those before the next step of the physics."""
        self._before = self.data.qpos.copy(), self.data.qvel.copy()
        self._calls = -1 if nstep > 1 or self._calls < 0 else self._calls + 1

    def forget(self) -> None:
        """Begin another control step."""
        self._before, self._calls = None, 0

    def _read_state(self, body: WorldBody, qpos: Array, qvel: Array, xpos: Array) -> Array:
        joints = [joint.index for joint in body.joints]
        positions, speeds = self.model.jnt_qposadr[joints], self.model.jnt_dofadr[joints]
        base = np.zeros(6)
        if body.is_free:
            (first,) = self.model.jnt_dofadr[self.model.body_jntadr[[body.id]]]
            base = qvel[first : first + 6]
        return np.concatenate([xpos, base, qpos[positions], qvel[speeds]])

    def read_states(self) -> list[Array]:
        """See `StateReader`."""
        now = self._now
        return [self._read_state(body, now.qpos, now.qvel, now.xpos[body.id]) for body in self.world.bodies]

    def read_poses(self) -> Poses:
        """See `StateReader`."""
        return self._read_poses(self._now)

    def _read_poses(self, data: Any) -> Poses:
        poses = {}
        for body in self.world.bodies:
            if body.is_free or body.joints:
                for number, link in enumerate(self._links[body.id][: MOST_LINKS + 1]):
                    quaternion = np.roll(data.xquat[link], -1)  # w last
                    poses[body.id, number - 1] = np.concatenate([data.xpos[link], quaternion, data.xipos[link]])
        return poses

    @functools.cached_property
    def _point_bodies(self) -> list[int]:
        """MuJoCo's bodies that are links of what moves."""
        moving = [body for body in self.world.bodies if body.is_free or body.joints]
        return [link for body in moving for link in self._links[body.id][: MOST_LINKS + 1]]

    @functools.cached_property
    def _point_sites(self) -> list[int]:
        bodies = set(self._point_bodies)
        return [site for site in range(self.model.nsite) if int(self.model.site_bodyid[site]) in bodies][:MOST_LINKS]

    def name_points(self) -> list[str]:
        """See `StateReader`."""
        links = [self.world.link_name(self._link_of[body]) for body in self._point_bodies]
        return [*links, *(f"site {self.model.site(site).name or site}" for site in self._point_sites)]

    def read_points(self) -> Array:
        """See `StateReader`."""
        model, now = self.model, self._now
        bodies, sites = self._point_bodies, self._point_sites
        owners = [*bodies, *model.site_bodyid[sites].tolist()]
        frames = np.vstack([now.xpos[bodies], now.site_xpos[sites]])
        centres = np.vstack([now.xipos[bodies], now.site_xpos[sites]])
        turning, linear = now.cvel[owners, :3], now.cvel[owners, 3:]  # at the centre of mass of the whole tree
        velocities = linear + np.cross(turning, centres - now.subtree_com[model.body_rootid[owners]])
        return np.hstack([frames, centres, np.roll(now.xquat[owners], -1, axis=1), velocities, turning])

    def throw(self, bodies: Sequence[WorldBody], velocities: Array) -> None:
        """See `StateReader`."""
        for body, velocity in zip(bodies, velocities, strict=True):
            first = int(self.model.jnt_dofadr[self.model.body_jntadr[body.id]])
            self.data.qvel[first : first + 6] = velocity

    def read_before(self) -> tuple[list[Array], Poses] | None:
        """See `StateReader`; None where all substeps were one call."""
        if self._before is None or self._calls < 2:
            return None
        mujoco, before, (qpos, qvel) = library(), self._other, self._before
        copy_data(before, self.model, self._now)
        before.qpos[:] = qpos
        mujoco.mj_kinematics(self.model, before)
        mujoco.mj_comPos(self.model, before)
        states = [self._read_state(body, qpos, qvel, before.xpos[body.id]) for body in self.world.bodies]
        return states, self._read_poses(before)

    def read_contacts(self) -> dict[Pair, float]:
        """See `StateReader`."""
        deepest: dict[Pair, float] = {}
        contacts = self._now.contact
        is_active = contacts.exclude == 0  # the others push nothing, as between parts that are welded together
        pairs = contacts.geom[is_active].tolist(), contacts.dist[is_active].tolist()
        for (one, two), distance in zip(*pairs, strict=True):
            if one >= 0 and two >= 0:  # flexible bodies have none
                pair = self._link(one), self._link(two)
                deepest[pair] = min(deepest.get(pair, math.inf), distance)
        return deepest

    def _link(self, geom: int) -> Link:
        body = int(self.model.geom_bodyid[geom])
        return self._link_of.get(body, (int(self.model.body_rootid[body]), -1))

    def find_link(self, geom: int) -> Link:
        """Return the link that a geom is a part of."""
        return self._link(geom)

    def find_geom(self, link: Link) -> int | None:
        """Return a geom of a link that can touch something, of the world one that is no plane if it has one; None
        where it has none."""
        model = self.model
        touches = (model.geom_contype | model.geom_conaffinity).astype(bool)
        geoms = [geom for geom in np.flatnonzero(touches).tolist() if self._link(geom) == link]
        return min(geoms, key=lambda geom: int(model.geom_type[geom]) in PLANES, default=None)

    def read_overlaps(self) -> dict[Pair, float]:
        """See `StateReader`."""
        free = {body.id for body in self.world.bodies if body.is_free}
        overlaps = {pair: distance for pair, distance in self.read_contacts().items() if distance < 0.0}
        return {pair: overlaps[pair] for pair in overlaps if {root for root, _ in pair} & free}

    def find_thickness(self, pair: Pair) -> float:
        """See `StateReader`."""
        bodies = [self._links[root][number + 1] if root in self._links else root for root, number in pair]
        sizes = [
            2.0 * float(self.model.geom_aabb[geom, 3:].min())
            for geom in range(self.model.ngeom)
            if int(self.model.geom_bodyid[geom]) in bodies and int(self.model.geom_type[geom]) not in PLANES
        ]
        return min(sizes, default=math.inf)

    def read_targets(self) -> dict[JointKey, MotorTarget]:
        """See `StateReader`; of actuators that pull a joint back to a position, which may change while they act."""
        targets, model = {}, self.model
        for motor in self.world.motors:
            number = motor.number
            is_linear = (int(model.actuator_gaintype[number]), int(model.actuator_biastype[number])) == LINEAR
            gain, (offset, pull, *_) = model.actuator_gainprm[number, 0], model.actuator_biasprm[number]
            if is_linear and gain > 0 > pull:
                force = math.inf
                if model.actuator_forcelimited[number]:
                    force = float(np.abs(model.actuator_forcerange[number]).max()) * abs(motor.gear)
                value = float(gain * self.data.ctrl[number] + offset) / float(-pull * motor.gear)
                targets[motor.body, motor.joint.index] = MotorTarget(value, force, f"actuator {motor.name}")
        return targets

    def read_strengths(self) -> dict[JointKey, MotorStrength]:
        """See `StateReader`; of the present model, and of the strongest of several motors of a joint."""
        found: dict[JointKey, MotorStrength] = {}
        for motor in self.world.motors:
            key, force = (motor.body, motor.joint.index), self._find_strength(motor)
            if math.isfinite(force) and (key not in found or force > found[key].force):
                found[key] = MotorStrength(force, is_driven=not motor.holds_position)
        return found

    def _find_strength(self, motor: JointActuator) -> float:
        """Return the most that an actuator can do [N m], [N]; infinite where nothing limits it, or it is not linear."""
        model, number = self.model, motor.number
        if model.actuator_forcelimited[number]:
            return float(np.abs(model.actuator_forcerange[number]).max()) * abs(motor.gear)
        is_force = (int(model.actuator_gaintype[number]), int(model.actuator_biastype[number])) == (FIXED_GAIN, NO_BIAS)
        gain = float(model.actuator_gainprm[number, 0])
        return max(abs(motor.low), abs(motor.high)) * abs(gain * motor.gear) if is_force else math.inf

    def read_command(self) -> Array | None:
        """See `StateReader`."""
        if self._before is None or not self.world.motors:
            return None
        return read_commands(self.data, self.world.motors)

    def read_weights(self) -> dict[JointKey, float]:
        """See `StateReader`; empty for robots that stand on something, or are bound by an equality."""
        model, still = self.model, self._other
        copy_data(still, model, self._now)
        still.qvel[:] = 0
        refresh(model, still)
        forces = np.abs(still.qfrc_bias - still.qfrc_passive)
        touching = {link[0] for pair in self.read_contacts() for link in pair}
        return {
            (body.id, joint.index): float(forces[model.jnt_dofadr[joint.index]])
            for body in self.world.bodies
            if not body.is_free and body.id not in touching and not model.neq
            for joint in body.joints
        }

    def read_physics(self) -> tuple[list[float], float]:
        """See `StateReader`."""
        return self.model.opt.gravity.tolist(), float(self.model.opt.timestep)

    def read_time(self) -> float:
        """See `StateReader`."""
        return float(self.data.time)

    def read_failure(self) -> str:
        """See `StateReader`: MuJoCo found the simulation unstable and set it back to the model's first position."""
        mujoco, warnings = library(), self.data.warning
        for name in UNSTABLE:
            if warnings[int(getattr(mujoco.mjtWarning, name))].number:
                return f"MuJoCo reports {name}: the simulation is unstable, and mj_step has reset it"
        return ""

    def weight_matters(self) -> bool:
        """See `StateReader`; gravity is only zero in MuJoCo where the model says so."""
        return False

    def find_jumps(self, seed: int) -> list[Jump]:
        """See `StateReader`; the environment's data are not changed."""
        mujoco, model, alone = library(), self.model, self._other
        copy_data(alone, model, self.data)
        gravity, dt = float(np.linalg.norm(model.opt.gravity)), float(model.opt.timestep)
        free = {b.name: int(model.jnt_dofadr[model.body_jntadr[b.id]]) for b in self.world.bodies if b.is_free}
        speeds = [_free_speeds(alone, free)]
        for _ in range(min(MOST_STEPS, max(1, round(LONGEST_S / dt)))):
            mujoco.mj_step(model, alone)
            speeds.append(_free_speeds(alone, free))
        jumps = []
        for name, before in speeds[0].items():
            step = max(range(len(speeds)), key=lambda i: speeds[i][name])
            jumps.append(Jump(name, speeds[step][name], before + gravity * step * dt, step * dt, seed))
        return jumps


def _free_speeds(data: Any, free: dict[str, int]) -> dict[str, float]:
    speeds = {name: float(np.linalg.norm(data.qvel[first : first + 3])) for name, first in free.items()}
    return {name: min(speed, 1e6) if math.isfinite(speed) else 1e6 for name, speed in speeds.items()}
