"""What a world in MuJoCo consists of, before it is compiled: files, motors, pairs that collide, and constraints."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np

from rlctl.errors import TaskError
from rlctl.task.attachments import Attachment
from rlctl.task.model_files import find_model_file
from rlctl.task.motors import Motor
from rlctl.task.mujoco.files import ModelFile, is_colliding, read_model_file
from rlctl.task.mujoco.parts import WORLD, Parts
from rlctl.task.mujoco.pictures import add_checker, light_scene
from rlctl.task.mujoco.real_motors import add_motors
from rlctl.task.mujoco.world import Array

_RIGID = (0.9999, 0.9999, 0.001, 0.5, 2)  # impedance of constraints: as stiff as PyBullet's
_WXYZ = [3, 0, 1, 2]
_WIDE = 5.0  # [m], of half a box
_HIDDEN = 3  # group of geoms that neither pictures nor recordings show
_GROUND_THICKNESS = 0.5  # [m], of rough ground
_SIZES = ("memory", "nkey", "njmax", "nconmax", "nstack", "nemax", "nuserdata")  # of an MJCF file's <size>


class MujocoScene:
    """The `MjSpec` of a world, and the parts of its bodies by name.

    A single world is solved more exactly than one of many (`single=False`), and has shapes that are only looked at
    (`visuals`). `solref` [s] is the time constant of contacts of the files that follow.
    """

    def __init__(
        self, mujoco: Any, *, timestep: float, iterations: int, solref: float, single: bool, visuals: bool
    ) -> None:
        self.mujoco, self.solref, self._visuals = mujoco, solref, visuals
        self.parts: dict[str, Parts] = {}
        self.spec = mujoco.MjSpec()
        light_scene(self.spec)
        option = self.spec.option
        option.timestep = timestep
        option.gravity = [0.0, 0.0, -9.81]
        # Both take the motors' damping implicitly. The first solves motors and contacts together, which holds stiff
        # motors stable; batches take what is faster.
        kinds = mujoco.mjtIntegrator
        option.integrator = kinds.mjINT_DISCRETE if single else kinds.mjINT_IMPLICITFAST
        if single:
            option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
            option.impratio = 10.0  # otherwise feet that stand slide slowly; batches take what is twice as fast
        option.iterations = iterations
        # A world that is no longer finite is an error, not a silent reset.
        option.disableflags = int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)

    def add_file(
        self,
        name: str,
        file: str | Path,
        *,
        position: Sequence[float],
        orientation: Sequence[float],
        fixed: bool,
        self_collision: bool,
        inertia: Literal["file", "shape"],
        floor: bool = True,
    ) -> Parts:
        """Add what a model file describes, with a motor for each joint; raises `TaskError` if it cannot be read."""
        source = read_model_file(find_model_file(file), fixed=fixed, inertia=inertia, visuals=self._visuals)
        child = source.spec
        if not floor:
            _delete_floor(child)
            if child.worldbody.first_body() is None:
                raise TaskError(f"{source.path}: it has no body that moves")
        for key in list(child.keys):  # poses of this file alone, which nobody uses here
            child.delete(key)
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
        frame = self.spec.worldbody.add_frame(pos=list(position), quat=[orientation[part] for part in _WXYZ])
        self._replace_settings(child)
        self._attach(child, name, frame)
        if not fixed and is_urdf:
            self.spec.body(f"{name}/{parts.base_name}").add_freejoint(name=f"{name}/free")
        self._add_motors(parts)
        for other in self.parts.values():
            self._add_pairs(parts, other)
        self._add_own_pairs(parts, self_collision)
        self.parts[name] = parts
        return parts

    def add_height_field(self, name: str, heights: Array, cell: float, color: Sequence[float]) -> Parts:
        """Add rough ground: heights [m] of shape (nx, ny), `cell` [m] apart."""
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
        self.spec.attach(child, prefix=f"{name}/", frame=self.spec.worldbody.add_frame())
        for other in self.parts.values():
            self._add_pairs(other, parts)
        self.parts[name] = parts
        return parts

    def add_motors(self, body: str, motors: Mapping[str, Motor]) -> None:
        """Make motors of a body real ones, by joint."""
        add_motors(self.mujoco, self.spec, body, motors)

    def connect(self, kind: Any, first: Attachment, second: Attachment) -> None:
        """Add a constraint of a kind of `mjtEq` between two places on links."""
        names = {"name1": self._add_site(first), "name2": self._add_site(second)}
        self.add_equality(kind, objtype=self.mujoco.mjtObj.mjOBJ_SITE, **names)

    def add_equality(self, kind: Any, **values: Any) -> None:
        """Add a constraint of a kind of `mjtEq`, as stiff as the physics step permits."""
        solref = [2 * self.spec.option.timestep, 1.0]
        self.spec.add_equality(type=kind, solref=solref, solimp=_RIGID, **values)
        # It solves motors and constraints together: otherwise strong motors pull gears and pins apart.
        self.spec.option.integrator = self.mujoco.mjtIntegrator.mjINT_DISCRETE

    def add_force_sensor(self, joint: str, link: str) -> None:
        """Measure force and torque of a joint at the centre of mass of `link`; both names are "BODY/NAME"."""
        part, kinds = self.spec.body(link), self.mujoco.mjtSensor
        part.add_site(name=joint, pos=part.ipos)
        for name, kind in ((joint, kinds.mjSENS_FORCE), (f"{joint} torque", kinds.mjSENS_TORQUE)):
            self.spec.add_sensor(name=name, type=kind, objtype=self.mujoco.mjtObj.mjOBJ_SITE, objname=joint)

    def add_contact_sensor(self, link: str) -> None:
        """Count the contacts of a link, which is named "BODY/NAME", with anything else."""
        mujoco = self.mujoco
        sensor = self.spec.add_sensor(
            name=f"{link} contacts",
            type=mujoco.mjtSensor.mjSENS_CONTACT,
            objtype=mujoco.mjtObj.mjOBJ_BODY,
            objname=link,
        )
        sensor.intprm[:3] = [1 << int(mujoco.mjtConDataField.mjCONDATA_FOUND), 0, 1]  # what, of which, how many

    def compile(self, model: Any, data: Any) -> tuple[Any, Any]:
        """Return the model and its data, with the state and the changes of those that were compiled before.

        Raises `TaskError` naming the newest file if MuJoCo refuses.
        """
        try:
            # Of a copy: a spec keeps all meshes that it has compiled.
            new_model = self.spec.copy().compile()
        except ValueError as error:
            newest = list(self.parts.values())[-1]  # those before it have been compiled
            raise TaskError(f"MuJoCo cannot load {newest.file.path}: {' '.join(str(error).split())}") from None
        # A link without mass has its centre at its origin; MuJoCo puts it elsewhere.
        new_model.body_ipos[new_model.body_mass == 0] = 0.0
        new_data = self.mujoco.MjData(new_model)
        _keep_changes(model, new_model)
        _keep_state(model, data, new_model, new_data)
        for parts in self.parts.values():
            try:
                parts.bind(new_model)
            except KeyError:  # attaching leaves out what refers to nothing, and says nothing
                self._explain_missing(parts)
                raise
        return new_model, new_data

    def _explain_missing(self, parts: Parts) -> None:
        """Raise `TaskError` with what MuJoCo says of a model file alone, if it does."""
        path = parts.file.path
        if path.suffix != ".xml":
            return
        try:
            self.mujoco.MjSpec.from_file(str(path)).compile()
        except ValueError as error:
            raise TaskError(f"MuJoCo cannot load {path}: {' '.join(str(error).split())}") from None

    def _attach(self, child: Any, name: str, frame: Any) -> None:
        # Where a model has files in memory, `attach` puts the prefix before the names of all other files.
        in_memory = {**self.spec.assets, **child.assets}
        for spec in (self.spec, child):
            spec.assets.clear()
        self.spec.attach(child, prefix=f"{name}/", frame=frame)
        self.spec.assets.update(in_memory)

    def _replace_settings(self, child: Any) -> None:
        """Give a file the settings of the world: its own are not used, and MuJoCo warns of those that differ."""
        parts = [(child.option, self.spec.option)]
        for name in _list_fields(self.spec.visual):
            parts.append((getattr(child.visual, name), getattr(self.spec.visual, name)))
        for own, new in parts:
            for name in _list_fields(new):
                setattr(own, name, getattr(new, name))
        for name in _list_fields(self.spec):
            if name in _SIZES or name.startswith("nuser_"):
                setattr(child, name, getattr(self.spec, name))

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

    def _add_motors(self, parts: Parts) -> None:
        """Add a motor to each joint: its force is `ctrl + b1 * position + b2 * velocity`, within a range."""
        mujoco = self.mujoco
        for joint in parts.joint_names:
            motor = self.spec.add_actuator(
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
        rolls = first.file.roll.get(link, 0.0) + second.file.roll.get(other, 0.0)
        dimensions = 3
        if rolls:
            dimensions = 6
        elif spins:
            dimensions = 4
        self.spec.add_pair(
            geomname1=f"{first.name}/{one}",
            geomname2=f"{second.name}/{two}",
            condim=dimensions,
            solref=[self.solref, 1.0],
        )

    def _add_site(self, end: Attachment) -> str:
        name, link = f"site {len(self.spec.sites)}", self.spec.body(f"{end.body.name}/{end.link}")
        origin = link.ipos if end.link == end.body.base_name else np.zeros(3)
        link.add_site(name=name, pos=origin + end.position, quat=[end.orientation[part] for part in _WXYZ])
        return name


def _delete_floor(child: Any) -> None:
    """Delete what a model file has besides its robot: shapes of the world, and bodies of it in which nothing moves."""
    for geom in list(child.worldbody.geoms):
        child.delete(geom)
    for link in list(child.worldbody.bodies):
        if not link.find_all("joint"):
            child.delete(link)


def _keep_changes(before: Any, after: Any) -> None:
    # What a task has changed in `build` before the last change of structure, by the names of the parts.
    for body in range(1, before.nbody):
        number = after.body(before.body(body).name).id
        for name in ("body_mass", "body_inertia", "body_pos", "body_quat"):
            getattr(after, name)[number] = getattr(before, name)[body]
    for joint in range(before.njnt):
        old_joint = before.joint(joint)
        new_joint = after.joint(old_joint.name)
        for name in ("range", "damping", "frictionloss", "armature"):
            getattr(new_joint, name)[:] = getattr(old_joint, name)
    for actuator in range(before.nu):
        number = after.actuator(before.actuator(actuator).name).id
        for name in ("actuator_biasprm", "actuator_forcerange"):
            getattr(after, name)[number] = getattr(before, name)[actuator]
    for geom in range(before.ngeom):
        after.geom(before.geom(geom).name).rgba[:] = before.geom(geom).rgba
    # MuJoCo sorts pairs, so their numbers change.
    numbers = {pair: number for number, pair in enumerate(_list_pairs(after))}
    for pair, names in enumerate(_list_pairs(before)):
        after.pair_solref[numbers[names]] = before.pair_solref[pair]


def _list_pairs(model: Any) -> list[tuple[str, str]]:
    """Return the names of the geoms of all pairs."""
    ends = zip(model.pair_geom1.tolist(), model.pair_geom2.tolist(), strict=True)
    return [(model.geom(one).name, model.geom(two).name) for one, two in ends]


def _keep_state(model: Any, data: Any, new_model: Any, new_data: Any) -> None:
    for number in range(model.njnt):
        name = model.joint(number).name
        before, after = data.joint(name), new_data.joint(name)
        after.qpos[:], after.qvel[:] = before.qpos, before.qvel
    for number in range(model.nu):
        name = model.actuator(number).name
        new_data.actuator(name).ctrl[:] = data.actuator(name).ctrl
    new_data.time = data.time


def _list_fields(settings: Any) -> list[str]:
    return [name for name in dir(settings) if not name.startswith("_")]
