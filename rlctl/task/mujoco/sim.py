"""The world of a task in MuJoCo: one world, or n worlds of one model for tasks in batches.

Contacts are soft: `solref` [s] is their time constant, at least two physics steps. Only the links of different bodies
collide, and those of one body that is loaded with `self_collision`; the friction of a contact is the product of the
frictions of its links, as in PyBullet.
"""

from __future__ import annotations

import contextlib
import itertools
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from rlctl.errors import TaskError, UsageError
from rlctl.task.attachments import Attachment, Joined
from rlctl.task.model_files import find_model_file
from rlctl.task.mujoco.body import MujocoBody
from rlctl.task.mujoco.files import ModelFile, is_colliding, read_model_file
from rlctl.task.mujoco.parts import WORLD, Parts
from rlctl.task.mujoco.pictures import Marker, add_checker, draw, light_scene
from rlctl.task.mujoco.world import Array, Fields, MujocoWorld, Rows
from rlctl.task.sim import Sim

_RIGID = (0.9999, 0.9999, 0.001, 0.5, 2)  # impedance of constraints: as stiff as PyBullet's
_WXYZ = [3, 0, 1, 2]
_WIDE = 5.0  # [m], of half a box
_HIDDEN = 3  # group of geoms that neither pictures nor recordings show
_GROUND_THICKNESS = 0.5  # [m], of rough ground


def read_solref(sim: str) -> float | None:
    """Return the time constant of contacts [s] in `mujoco:0.01`, 0.02 for `mujoco`, None for `pybullet`.

    Raises `UsageError` for anything else.
    """
    engine, _, value = sim.partition(":")
    if sim == "pybullet":
        return None
    try:
        solref = float(value or 0.02)
    except ValueError:
        solref = math.nan
    if engine != "mujoco" or not 0 < solref < 1:
        raise UsageError(f"sim {sim!r}: give pybullet, mujoco, or mujoco:SOLREF with 0 < SOLREF < 1 s")
    return solref


class MujocoSim(Sim):
    """A world in MuJoCo; with `worlds` all arrays of its bodies have a leading axis of so many rows.

    The model is compiled again after every change of its structure, so all of that belongs into `build`.
    """

    engine = "MuJoCo"
    bodies: dict[str, MujocoBody]

    def __init__(
        self, *, control_dt: float, substeps: int, solref: float = 0.02, iterations: int = 50, worlds: int | None = None
    ) -> None:
        self.world = MujocoWorld(substeps, worlds)
        self.mujoco = self.world.mujoco
        self._control_dt, self._solref, self._iterations = control_dt, solref, iterations
        self.fields = Fields(self.world)
        self._views: dict[int, OneWorldSim] = {}
        self.clear()

    def clear(self) -> None:
        self.bodies = {}
        self._parts: dict[str, Parts] = {}
        self._pairs: list[tuple[str, str]] = []  # links whose geoms collide, each as BODY/LINK
        self._pushes: list[_MujocoPush] = []
        self._markers: list[Marker] = []
        self._spec = self.mujoco.MjSpec()
        light_scene(self._spec)
        option = self._spec.option
        option.timestep = self._control_dt / self.world.substeps
        option.gravity = [0.0, 0.0, -9.81]
        # Both take the motors' damping implicitly. The first solves motors and contacts together, which holds stiff
        # motors stable; batches take what is faster.
        kinds = self.mujoco.mjtIntegrator
        option.integrator = kinds.mjINT_DISCRETE if self.world.count is None else kinds.mjINT_IMPLICITFAST
        if self.world.count is None:
            option.cone = self.mujoco.mjtCone.mjCONE_ELLIPTIC
            option.impratio = 10.0  # otherwise feet that stand slide slowly; batches take what is twice as fast
        option.iterations = self._iterations
        # A world that is no longer finite is an error, not a silent reset.
        option.disableflags = int(self.mujoco.mjtDisableBit.mjDSBL_AUTORESET)
        model = self._spec.compile()
        self.world.extra.clear()
        self.world.set_model(model, self.mujoco.MjData(model))
        self._look_up()

    @property
    def model(self) -> Any:
        """MuJoCo's `MjModel`, as it was built."""
        return self.world.mj_model

    @property
    def data(self) -> Any:
        """MuJoCo's `MjData` of a single world."""
        return self.world.mj_data

    def one(self, world: int) -> OneWorldSim:
        """Return one of the `worlds`, whose arrays have no leading axis; events act on it."""
        if world not in self._views:
            self._views[world] = OneWorldSim(self, world)
        return self._views[world]

    def set_gravity(self, gravity: float) -> None:
        self._spec.option.gravity = self.model.opt.gravity[:] = [0.0, 0.0, -gravity]

    def set_contact_erp(self, erp: float) -> None:
        # The part of the depth that a physics step removes: a time constant of dt / erp, of at least two steps.
        self._solref = self._spec.option.timestep * max(2.0, 1.0 / erp)

    def load(
        self,
        name: str,
        file: str | Path,
        *,
        position: Sequence[float] = (0.0, 0.0, 0.0),
        orientation: Sequence[float] = (0.0, 0.0, 0.0, 1.0),
        fixed: bool = False,
        flags: int = 0,
        self_collision: bool = False,
        inertia: Literal["file", "shape"] = "file",
    ) -> MujocoBody:
        self._check_new(name)
        # Nobody sees one world of many.
        visuals = self.world.count in (None, 1)
        source = read_model_file(find_model_file(file), fixed=fixed, inertia=inertia, visuals=visuals)
        child = source.spec
        for joint in child.joints:
            joint.actfrclimited = False  # the force limits are those of the motors
        is_urdf = source.path.suffix == ".urdf"
        free = any(joint.type == self.mujoco.mjtJoint.mjJNT_FREE for joint in child.joints)
        fixed = (fixed or not any(link.mass > 0 for link in child.bodies)) if is_urdf else not free
        if fixed and not child.joints:
            self._flatten_ground(child)
        drawn = {geom.parent.name for geom in child.geoms if is_urdf and not is_colliding(geom)}
        for geom in filter(is_colliding, child.geoms):
            geom.group = _HIDDEN if geom.parent.name in drawn else geom.group
        parts = Parts(name, source, fixed, child)
        for number, geom in enumerate(child.geoms):
            geom.name = str(number)
            # Only the pairs of `_add_pairs` collide.
            geom.contype = geom.conaffinity = 0
        frame = self._spec.worldbody.add_frame(pos=list(position), quat=[orientation[part] for part in _WXYZ])
        for option in dir(self._spec.option):  # the file's are not used, and MuJoCo warns of them
            if not option.startswith("_"):
                setattr(child.option, option, getattr(self._spec.option, option))
        self._spec.attach(child, prefix=f"{name}/", frame=frame)
        if not fixed and is_urdf:
            self._spec.body(f"{name}/{parts.base_name}").add_freejoint(name=f"{name}/free")
        self._add_motors(parts)
        for other in self._parts.values():
            self._add_pairs(parts, other)
        self._add_own_pairs(parts, self_collision)
        return self._add_body(parts)

    def _flatten_ground(self, child: Any) -> None:
        """Make a wide box that is fixed, such as the ground of `plane.urdf`, a plane: faster, and exact."""
        box, plane = self.mujoco.mjtGeom.mjGEOM_BOX, self.mujoco.mjtGeom.mjGEOM_PLANE
        grounds = [geom for geom in child.geoms if geom.type == box and min(geom.size[:2]) > _WIDE]
        for geom in filter(is_colliding, grounds):
            geom.pos = [*geom.pos[:2], geom.pos[2] + geom.size[2]]
            geom.type, geom.size = plane, [geom.size[0], geom.size[1], 1.0]
            geom.material = add_checker(child)
        if grounds:  # recordings draw them themselves
            used = {geom.meshname for geom in child.geoms if is_colliding(geom)}
            unused = [mesh for mesh in child.meshes if mesh.name not in used]
            for part in [*(geom for geom in child.geoms if not is_colliding(geom)), *unused]:
                child.delete(part)

    def _add_body(self, parts: Parts) -> MujocoBody:
        self._parts[parts.name] = parts
        body = self.bodies[parts.name] = MujocoBody(self, parts)
        self._compile()
        return body

    def _look_up(self) -> None:
        """Look the arrays up again, which a compilation and `save` replace."""
        self.fields.forget()
        for body in self.bodies.values():
            body.bind()
        for view in self._views.values():
            view.look_up()

    def _add_motors(self, parts: Parts) -> None:
        """Add a motor to each joint: its force is `ctrl + b1 * position + b2 * velocity`, within a range."""
        mujoco = self.mujoco
        for joint in parts.joint_names:
            motor = self._spec.add_actuator(
                name=f"{parts.name}/motor {joint}", target=f"{parts.name}/{joint}", trntype=mujoco.mjtTrn.mjTRN_JOINT
            )
            motor.gainprm[0], motor.biastype = 1.0, mujoco.mjtBias.mjBIAS_AFFINE
            motor.forcelimited, motor.forcerange = True, [-1e9, 1e9]

    def _add_pairs(self, first: Parts, second: Parts) -> None:
        for (one, link), (two, other) in itertools.product(first.collision_geoms, second.collision_geoms):
            if link in first.moving or other in second.moving:
                self._add_pair(first, one, link, second, two, other)

    def _add_own_pairs(self, parts: Parts, self_collision: bool) -> None:
        for (one, link), (two, other) in itertools.combinations(parts.collision_geoms, 2):
            if WORLD in (link, other):  # the floor of an MJCF file
                collide = link in parts.moving or other in parts.moving
            else:
                related = link == other or link in parts.ancestors[other] or other in parts.ancestors[link]
                collide = self_collision and not related and parts.may_collide(one, two)
            if collide:
                self._add_pair(parts, one, link, parts, two, other)

    def _add_pair(self, first: Parts, one: int, link: str, second: Parts, two: int, other: str) -> None:
        spins = first.file.spin.get(link, 0.0) + second.file.spin.get(other, 0.0)
        self._spec.add_pair(
            geomname1=f"{first.name}/{one}",
            geomname2=f"{second.name}/{two}",
            condim=4 if spins else 3,
            solref=[self._solref, 1.0],
        )
        self._pairs.append((first.full_name(link), second.full_name(other)))

    def add_height_field(
        self, name: str, heights: Array, *, cell: float, color: Sequence[float] = (0.55, 0.6, 0.5)
    ) -> MujocoBody:
        self._check_new(name)
        child, (rows, columns) = self.mujoco.MjSpec(), heights.shape
        half = [(count - 1) / 2 * cell for count in (rows, columns)]
        lowest, top = float(heights.min()), float(np.ptp(heights))
        scaled = (heights - lowest) / (top or 1.0)
        # MuJoCo's rows run along y.
        size = [*half, top or 1e-3, _GROUND_THICKNESS]
        child.add_hfield(name="heights", size=size, nrow=columns, ncol=rows, userdata=scaled.T.ravel())
        body = child.worldbody.add_body(name="ground")
        geom = body.add_geom(type=self.mujoco.mjtGeom.mjGEOM_HFIELD, hfieldname="heights", rgba=[*color, 1.0])
        geom.pos, geom.name = [0.0, 0.0, lowest], "0"
        source = ModelFile(Path("height field"), child, {}, {}, {"ground": 0.5}, {"ground": 0.0}, {})
        parts = Parts(name, source, True, child)
        geom.contype = geom.conaffinity = 0
        x, y = ((np.arange(count) - (count - 1) / 2) * cell for count in heights.shape)
        parts.terrain = np.stack([*np.meshgrid(x, y, indexing="ij"), heights], axis=-1)
        self._spec.attach(child, prefix=f"{name}/", frame=self._spec.worldbody.add_frame())
        for other in self._parts.values():
            self._add_pairs(other, parts)
        return self._add_body(parts)

    def connect_gear(
        self, body: Any, driver: str, driven: str, *, ratio: float, max_force: float = 0, stiffness: float = 0
    ) -> None:
        body.find_joints([driver, driven])
        names = {"name1": f"{body.name}/{driven}", "name2": f"{body.name}/{driver}"}
        self._add_equality(self.mujoco.mjtEq.mjEQ_JOINT, data=[0.0, ratio, *[0.0] * 10], **names)

    def connect_point(self, first: Attachment, second: Attachment, *, max_force: float = 0) -> Joined:
        return self._connect(self.mujoco.mjtEq.mjEQ_CONNECT, first, second)

    def connect_fixed(self, first: Attachment, second: Attachment, *, max_force: float = 0) -> Joined:
        return self._connect(self.mujoco.mjtEq.mjEQ_WELD, first, second)

    def _connect(self, kind: Any, first: Attachment, second: Attachment) -> Joined:
        names = {"name1": self._add_site(first), "name2": self._add_site(second)}
        self._add_equality(kind, objtype=self.mujoco.mjtObj.mjOBJ_SITE, **names)
        return Joined(first, second)

    def _add_equality(self, kind: Any, **values: Any) -> None:
        solref = [2 * self._control_dt / self.world.substeps, 1.0]
        self._spec.add_equality(type=kind, solref=solref, solimp=_RIGID, **values)
        # It solves motors and constraints together: otherwise strong motors pull gears and pins apart.
        self._spec.option.integrator = self.mujoco.mjtIntegrator.mjINT_DISCRETE
        self._compile()

    def _add_site(self, end: Attachment) -> str:
        name, link = f"site {len(self._spec.sites)}", self._spec.body(f"{end.body.name}/{end.link}")
        origin = link.ipos if end.link == end.body.base_name else np.zeros(3)
        link.add_site(name=name, pos=origin + end.position, quat=[end.orientation[part] for part in _WXYZ])
        return name

    def add_force_sensor(self, joint: str, link: str) -> None:
        """Measure force and torque of a joint at the centre of mass of `link`; both names are "BODY/NAME"."""
        part, kinds = self._spec.body(link), self.mujoco.mjtSensor
        part.add_site(name=joint, pos=part.ipos)
        for name, kind in ((joint, kinds.mjSENS_FORCE), (f"{joint} torque", kinds.mjSENS_TORQUE)):
            self._spec.add_sensor(name=name, type=kind, objtype=self.mujoco.mjtObj.mjOBJ_SITE, objname=joint)
        self._compile()

    def _compile(self) -> None:
        try:
            model, data = self._spec.recompile(self.world.mj_model, self.world.mj_data)  # keeps the state
        except ValueError as error:
            newest = list(self._parts.values())[-1]  # those before it have been compiled
            raise TaskError(f"MuJoCo cannot load {newest.file.path}: {' '.join(str(error).split())}") from None
        self._keep_changes(self.world.mj_model, model)
        self.world.set_model(model, data)
        for parts in self._parts.values():
            parts.bind(model)
        self._set_extra(model)
        self._look_up()
        self.spread_friction()

    def _keep_changes(self, before: Any, after: Any) -> None:
        # What a task has changed in `build` before the last change of structure, by the names of bodies and joints.
        for body in range(1, before.nbody):
            number = after.body(before.body(body).name).id
            for name in ("body_mass", "body_inertia", "body_pos", "body_quat"):
                getattr(after, name)[number] = getattr(before, name)[body]
        for actuator in range(before.nu):
            number = after.actuator(before.actuator(actuator).name).id
            for name in ("actuator_biasprm", "actuator_forcerange"):
                getattr(after, name)[number] = getattr(before, name)[actuator]

    def _set_extra(self, model: Any) -> None:
        friction, spin = np.zeros(model.nbody), np.zeros(model.nbody)
        for parts in self._parts.values():
            for link, value in parts.file.friction.items():
                number = 0 if link == WORLD else parts.links.get(link)
                if number is not None:
                    friction[number] = parts.built_friction.get(link, value)
                    spin[number] = parts.file.spin[link]
        self.world.extra |= {"friction": friction, "spin": spin, "strength": np.ones(model.nu)}
        numbers = [[model.body(end).id for end in pair] for pair in self._pairs]
        self._pair_links = np.array(numbers, int).reshape(-1, 2)

    def spread_friction(self) -> None:
        """Give contacts the product of the frictions of their links, as PyBullet computes it."""
        if not len(self._pairs):
            return
        friction, spin, (one, two) = self.fields.model("friction"), self.fields.model("spin"), self._pair_links.T
        product = friction[..., one] * friction[..., two]
        turning = spin[..., one] * friction[..., two] + spin[..., two] * friction[..., one]
        pairs = self.fields.model("pair_friction")
        pairs[..., :3] = np.maximum(np.stack([product, product, turning], axis=-1), self.mujoco.mjMINMU)
        self.fields.touch()

    def step(self, worlds: Rows = None) -> None:
        if self._pushes:
            self._apply_pushes(None if worlds is None else set(worlds.tolist()))
        self.world.step(worlds)
        for body in self.bodies.values():
            body.limit_speeds()

    def _apply_pushes(self, worlds: set[int] | None) -> None:
        forces = self.world.data("xfrc_applied")
        moving = [push for push in self._pushes if worlds is None or push.world in worlds]
        for push in moving:
            forces[(push.world, push.link) if self.world.count is not None else push.link] = 0.0
        self._pushes[:] = [push for push in self._pushes if push.steps > 0 or push not in moving]
        for push in [push for push in moving if push.steps > 0]:
            row = (push.world, push.link) if self.world.count is not None else push.link
            forces[row][:3] += push.force
            push.steps -= 1

    @property
    def deepest_contact(self) -> float:
        distances = self.world.read_contact_distances(self.fields.index or 0)
        return max(0.0, -float(distances.min(initial=0.0)))

    def save(self) -> None:
        for body in self.bodies.values():
            body.measure_inertia()
        self.world.save()
        self._look_up()

    def restore(self, worlds: Rows = None) -> None:
        rows = None if worlds is None else set(worlds.tolist())
        self._pushes[:] = [push for push in self._pushes if rows is not None and push.world not in rows]
        self.world.restore(worlds)
        for body in self.bodies.values():
            body.forget_motors(worlds)

    def shift_gravity(self, change: float) -> None:
        self.fields.model("opt.gravity")[..., 2] = self.world.built("opt.gravity")[2] + change
        self.fields.touch()

    def push(self, body: str, force: Sequence[float], duration_s: float, link: str | None = None) -> None:
        pushed = self.body(body)
        steps = max(1, round(duration_s / self._control_dt))
        number = pushed.find_link(link or pushed.base_name)  # type: ignore[attr-defined]
        self._pushes.append(_MujocoPush(self.fields.index or 0, number, np.array(force, float), steps))

    def add_marker(self, position: Sequence[float], radius: float, color: Sequence[float]) -> int:
        self._markers.append(Marker(position, radius, color))
        return len(self._markers) - 1

    def move_marker(self, marker: int, position: Sequence[float] | Array) -> None:
        self._markers[marker].position = position

    def render(
        self,
        width: int = 320,
        height: int = 240,
        *,
        eye: Sequence[float] = (1.5, 1.1, 1.1),
        target: Sequence[float] = (0.2, 0.0, 0.4),
        up: Sequence[float] = (0.0, 0.0, 1.0),
        field_of_view: float = 45.0,
    ) -> NDArray[np.uint8]:
        if self.world.batch is not None:
            self._refuse("pictures of many worlds")
        self.world.refresh()
        size = width, height
        return draw(self.model, self.data, size, self._markers, eye=eye, target=target, field_of_view=field_of_view)

    def close(self) -> None:
        with contextlib.suppress(AttributeError):
            self.world.batch = None


class OneWorldSim(MujocoSim):
    """One world of a `MujocoSim` with many: the same, but its arrays have no leading axis."""

    def __init__(self, batch: MujocoSim, index: int) -> None:
        self.batch = batch
        """The simulation of all worlds."""
        self.fields = Fields(batch.world, index)
        self.look_up()

    def __getattr__(self, name: str) -> Any:
        if name == "batch":
            raise AttributeError(name)
        return getattr(self.batch, name)

    def look_up(self) -> None:
        """Look the arrays up again."""
        self.fields.forget()
        self.bodies = {name: MujocoBody(self, parts) for name, parts in self.batch._parts.items()}

    def load(self, *args: Any, **kwargs: Any) -> MujocoBody:
        self.batch.load(*args, **kwargs)
        return self.bodies[args[0]]

    def step(self, worlds: Rows = None) -> None:
        self.batch.step(worlds)

    def save(self) -> None:
        self.batch.save()

    def restore(self, worlds: Rows = None) -> None:
        self.batch.restore(worlds)

    def clear(self) -> None:
        self.batch.clear()
        self.look_up()

    def close(self) -> None:
        self.batch.close()


class _MujocoPush:
    def __init__(self, world: int, link: int, force: Array, steps: int) -> None:
        self.world, self.link = world, link
        self.force = force  # [N], world frame
        self.steps = steps  # control steps that it still acts
