"""The world of a task in MuJoCo instead of PyBullet, with the same methods: to test if a policy depends on the engine.

Models are the same URDF files. Motors work as in PyBullet: the solver drives joints to a velocity with limited force.
Contacts differ: they are soft, with the time constant `solref` [s] of at least two physics steps. Methods without an
equivalent in MuJoCo are not defined here or in `MujocoBody`; using one raises `UsageError`.
"""

import itertools
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from rlctl.errors import TaskError, UsageError, check_name
from rlctl.library_output import print_mujoco_warnings
from rlctl.task.constraints import Attachment, Joined
from rlctl.task.model_files import find_model_file
from rlctl.task.mujoco_body import WXYZ, MujocoBody, refuse

Array = NDArray[np.float64]

_RIGID = (0.9999, 0.9999, 0.001, 0.5, 2)  # impedance of motors and constraints: as stiff as PyBullet's
_CHANGEABLE = ("body_mass", "body_inertia", "body_pos", "body_quat")


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


class MujocoSim:
    """The methods of `Sim`, for a world in MuJoCo. The model is compiled again after every change of its structure."""

    def __init__(self, *, control_dt: float, substeps: int, solref: float) -> None:
        try:
            import mujoco
        except ImportError:
            raise UsageError("--sim mujoco needs MuJoCo: pip install mujoco") from None
        self.mujoco = mujoco
        print_mujoco_warnings()
        self._control_dt, self._substeps, self._solref = control_dt, substeps, solref
        self.clear()

    def clear(self) -> None:
        """As `Sim.clear`."""
        self.bodies: dict[str, MujocoBody] = {}
        self._pushes: list[tuple[int, Array, list[int]]] = []
        self._pairs: list[tuple[MujocoBody, str, MujocoBody, str]] = []
        self._spec = self.mujoco.MjSpec()
        option = self._spec.option
        option.timestep = self._control_dt / self._substeps
        option.gravity = [0.0, 0.0, -9.81]
        option.disableflags = int(self.mujoco.mjtDisableBit.mjDSBL_EULERDAMP)
        option.cone = self.mujoco.mjtCone.mjCONE_ELLIPTIC
        option.impratio = 10.0  # otherwise feet that stand slide slowly
        self.model: Any = self._spec.compile()
        self.data: Any = self.mujoco.MjData(self.model)

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_"):
            raise AttributeError(name)
        refuse(name)

    def set_gravity(self, gravity: float) -> None:
        """As `Sim.set_gravity`."""
        self._spec.option.gravity = self.model.opt.gravity[:] = [0.0, 0.0, -gravity]

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
        """As `Sim.load`, for URDF files without `self_collision`; `flags` and `inertia` have no effect."""
        path = find_model_file(file)
        if path.suffix != ".urdf" or self_collision:
            refuse("self_collision" if self_collision else f"{path.name}, which is not a URDF file")
        child = self.mujoco.MjSpec.from_file(str(path))
        child.compiler.fusestatic = False  # links on fixed joints keep their names
        for number, geom in enumerate(child.geoms):
            geom.name, geom.contype, geom.conaffinity = str(number), 0, 0  # only the pairs of `_add_pairs` collide
        body = MujocoBody(self, name, path, fixed or not any(link.mass > 0 for link in child.bodies), child)
        for joint in child.joints:
            # Implicit damping, in the form that constraints take part in: m (v' - v) = dt (f - d v').
            joint.armature = joint.damping[0] * self._spec.option.timestep
        frame = self._spec.worldbody.add_frame(pos=list(position), quat=[orientation[part] for part in WXYZ])
        self._spec.attach(child, prefix=f"{name}/", frame=frame)
        if not body.fixed:
            self._spec.body(f"{name}/{body.base_name}").add_freejoint(name=f"{name}/free")
        for other in self.bodies.values():
            self._add_pairs(body, other)
        self.bodies[name] = body
        self._compile()
        return body

    def _add_pairs(self, first: MujocoBody, second: MujocoBody) -> None:
        for (one, link), (two, other) in itertools.product(enumerate(first.geom_links), enumerate(second.geom_links)):
            if link in first.moving or other in second.moving:
                names = {"geomname1": f"{first.name}/{one}", "geomname2": f"{second.name}/{two}"}
                self._spec.add_pair(**names, condim=4, solref=[self._solref, 1.0])
                self._pairs.append((first, link, second, other))

    def connect_gear(
        self, body: MujocoBody, driver: str, driven: str, *, ratio: float, max_force: float = 0, stiffness: float = 0
    ) -> None:
        """As `Sim.connect_gear`; `max_force` and `stiffness` have no effect."""
        names = {"name1": f"{body.name}/{driven}", "name2": f"{body.name}/{driver}"}
        self._add_equality(self.mujoco.mjtEq.mjEQ_JOINT, data=[0.0, ratio, *[0.0] * 10], **names)

    def connect_point(self, first: Attachment, second: Attachment, *, max_force: float = 0) -> Joined:
        """As `Sim.connect_point`; `max_force` has no effect."""
        names = {"name1": self._add_site(first), "name2": self._add_site(second)}
        self._add_equality(self.mujoco.mjtEq.mjEQ_CONNECT, objtype=self.mujoco.mjtObj.mjOBJ_SITE, **names)
        return Joined(first, second)

    def _add_equality(self, kind: Any, **values: Any) -> None:
        self._spec.add_equality(type=kind, solref=[2 * self._control_dt / self._substeps, 1.0], solimp=_RIGID, **values)
        self._compile()

    def _add_site(self, end: Attachment) -> str:
        name, link = f"site {len(self._spec.sites)}", self._spec.body(f"{end.body.name}/{end.link}")
        origin = link.ipos if end.link == end.body.base_name else np.zeros(3)
        link.add_site(name=name, pos=origin + end.position)
        return name

    def add_force_sensor(self, joint: str, link: str) -> None:
        """Measure force and torque of a joint at the centre of mass of `link`; both names are "BODY/NAME"."""
        part, kinds = self._spec.body(link), self.mujoco.mjtSensor
        part.add_site(name=joint, pos=part.ipos)
        for name, kind in ((joint, kinds.mjSENS_FORCE), (f"{joint} torque", kinds.mjSENS_TORQUE)):
            self._spec.add_sensor(name=name, type=kind, objtype=self.mujoco.mjtObj.mjOBJ_SITE, objname=joint)
        self._compile()

    def body(self, name: str) -> MujocoBody:
        """As `Sim.body`."""
        check_name(name, self.bodies, "no body", TaskError, listed="Loaded")
        return self.bodies[name]

    def _compile(self) -> None:
        self.model, self.data = self._spec.recompile(self.model, self.data)  # keeps the state
        model = self.model
        model.dof_solimp[:] = _RIGID
        model.jnt_actfrclimited[:] = 0
        self._positions = np.zeros(model.nv, int)  # index in qpos, by degree of freedom
        self._positions[model.jnt_dofadr] = model.jnt_qposadr
        self.velocity_cap, self.top_speed = np.full((2, model.nv), np.inf)  # of joints, of position motors
        self._forget_motors()
        self._dirty = True
        for body in self.bodies.values():
            body.bind(model)
        self.spread_friction()

    def _forget_motors(self) -> None:
        count = self.model.nv
        self.target, self.speed = np.full(count, np.nan), np.full(count, np.nan)  # of position, of velocity motors
        self.gain, self.force, self.torque, self.applied = np.zeros((4, count))

    def spread_friction(self) -> None:
        """Give contacts the product of the frictions of their links, as PyBullet computes it."""
        for pair, (first, link, second, other) in enumerate(self._pairs):
            one, two = first.friction[link], second.friction[other]
            spin = first.spin[link] * two + second.spin[other] * one
            self.model.pair_friction[pair, :3] = np.maximum((one * two, one * two, spin), self.mujoco.mjMINMU)

    def forward(self) -> Any:
        """Return the data after computing everything that depends on the positions."""
        if self._dirty:
            self.mujoco.mj_step1(self.model, self.data)
            self._dirty = False
        return self.data

    def touch(self) -> Any:
        """Return the data for a change of positions or velocities."""
        self._dirty = True
        return self.data

    def step(self) -> None:
        """As `Sim.step`."""
        model = self.model
        if (model.dof_frictionloss != self.force).any():
            model.dof_frictionloss[:] = self.force
            self._dirty = True
        data, dt = self.forward(), model.opt.timestep
        data.xfrc_applied[:] = 0
        for link, force, left in self._pushes:
            data.xfrc_applied[link, :3] += force
            left[0] -= 1
        self._pushes = [push for push in self._pushes if push[2][0] > 0]
        data.qfrc_applied[:] = self.torque
        friction_row = int(self.mujoco.mjtConstraint.mjCNSTR_FRICTION_DOF)
        driven = ~np.isnan(self.target)
        for _ in range(self._substeps):
            speeds = self.gain * (self.target - data.qpos[self._positions]) / dt
            speeds = np.where(driven, np.clip(speeds, -self.top_speed, self.top_speed), self.speed)
            rows = np.flatnonzero(data.efc_type == friction_row)
            moved = data.efc_id[rows]
            # A friction row holds the velocity at 0; this reference makes it the motor's target, as in PyBullet.
            data.efc_aref[rows] = (speeds[moved] - data.qvel[moved]) / dt
            self.mujoco.mj_step2(model, data)
            self.applied[:] = self.torque
            self.applied[moved] = data.efc_force[rows]
            np.clip(data.qvel, -self.velocity_cap, self.velocity_cap, out=data.qvel)
            self.mujoco.mj_step1(model, data)

    def save(self) -> None:
        """As `Sim.save`."""
        self._saved = self.data.qpos.copy(), self.data.qvel.copy()
        self._gravity = self.model.opt.gravity.copy()
        self.nominal = {name: getattr(self.model, name).copy() for name in _CHANGEABLE}
        for body in self.bodies.values():
            body._save_nominal()

    def restore(self) -> None:
        """As `Sim.restore`; bit for bit."""
        model, data = self.model, self.touch()
        model.dof_frictionloss[:] = 0
        self.mujoco.mj_resetData(model, data)
        data.qpos[:], data.qvel[:] = self._saved
        model.opt.gravity[:] = self._gravity
        for name, values in self.nominal.items():
            getattr(model, name)[:] = values
        self._forget_motors()
        self._pushes.clear()
        for body in self.bodies.values():
            body._restore_nominal()
        self.spread_friction()

    def shift_gravity(self, change: float) -> None:
        """As `Sim.shift_gravity`."""
        self.model.opt.gravity[2] = self._gravity[2] + change

    def push(self, body: str, force: Sequence[float], duration_s: float, link: str | None = None) -> None:
        """As `Sim.push`."""
        pushed = self.body(body)
        steps = [max(1, round(duration_s / self._control_dt))]
        self._pushes.append((pushed.find_link(link or pushed.base_name), np.array(force, float), steps))

    def close(self) -> None:
        """As `Sim.close`."""
