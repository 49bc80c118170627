"""The world of a task in MuJoCo instead of PyBullet, with the same methods: to test if a policy depends on the engine.

Models are the same URDF files. Motors work as in PyBullet: a row of the solver demands a velocity with a bounded force.
Two things differ: contacts are soft, with the time constant `solref` [s] of at least two physics steps; and a joint's
damping acts after its motor, so that a light joint with high damping lags. Methods without an equivalent in MuJoCo are
not defined here or in `MujocoBody`; using one raises `UsageError`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from rlctl.errors import TaskError, UsageError, check_name
from rlctl.task.bullet import pybullet_data
from rlctl.task.mujoco_body import MujocoBody, refuse

Array = NDArray[np.float64]

_WXYZ = [3, 0, 1, 2]
_NO_FRICTION = 1e-3  # MuJoCo takes the larger value of two geoms
_CHANGEABLE = ("body_mass", "body_inertia", "body_pos", "body_quat", "geom_friction", "dof_damping")


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
    """The methods of `Sim`, for a world in MuJoCo. The model is compiled when the world is first read or moved."""

    def __init__(self, *, control_dt: float, substeps: int, solref: float) -> None:
        try:
            import mujoco
        except ImportError:
            raise UsageError("--sim mujoco needs MuJoCo: pip install mujoco") from None
        self.mujoco = mujoco
        self._control_dt, self._substeps, self._solref = control_dt, substeps, solref
        self._begin()

    def _begin(self) -> None:
        self.bodies: dict[str, MujocoBody] = {}
        self._pushes: list[tuple[int, Array, list[int]]] = []
        self._model: Any = None
        self._dirty = True
        self._spec = self.mujoco.MjSpec()
        option = self._spec.option
        option.timestep = self._control_dt / self._substeps
        option.gravity = [0.0, 0.0, -9.81]
        option.integrator = self.mujoco.mjtIntegrator.mjINT_IMPLICITFAST
        option.cone = self.mujoco.mjtCone.mjCONE_ELLIPTIC
        option.impratio = 10.0  # otherwise feet that stand slide slowly

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_"):
            raise AttributeError(name)
        refuse(name)

    def set_gravity(self, gravity: float) -> None:
        """As `Sim.set_gravity`."""
        self._spec.option.gravity = [0.0, 0.0, -gravity]

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
        """As `Sim.load`, for URDF files; `flags` and `inertia` have no effect."""
        path = Path(file)
        if not path.is_absolute() and not path.is_file():
            path = Path(pybullet_data.getDataPath()) / file
        if path.suffix != ".urdf":
            refuse(f"{path.name}, which is not a URDF file")
        child = self.mujoco.MjSpec.from_file(str(path))
        child.compiler.fusestatic = False  # links on fixed joints keep their names
        base = child.worldbody.first_body().name
        bit = 1 << len(self.bodies)
        for geom in child.geoms:
            # Links of one body do not collide with each other without `self_collision`.
            geom.contype, geom.conaffinity = bit, 0x3FFFFFFF if self_collision else 0x3FFFFFFF & ~bit
            geom.condim = 3
            geom.solref[0] = self._solref
        frame = self._spec.worldbody.add_frame(pos=list(position), quat=[orientation[part] for part in _WXYZ])
        self._spec.attach(child, prefix=f"{name}/", frame=frame)
        fixed = fixed or not any(body.mass > 0 for body in child.bodies)
        if not fixed:
            self._spec.body(f"{name}/{base}").add_freejoint(name=f"{name}/free")
        body = self.bodies[name] = MujocoBody(self, name, path, fixed, base)
        self._model = None
        return body

    def body(self, name: str) -> MujocoBody:
        """As `Sim.body`."""
        check_name(name, self.bodies, "no body", TaskError, listed="Loaded")
        return self.bodies[name]

    @property
    def is_compiled(self) -> bool:
        """Whether the compiled model contains all bodies."""
        return self._model is not None

    @property
    def model(self) -> Any:
        """The `mujoco.MjModel`, compiled again if bodies were loaded."""
        if self._model is None:
            self._compile()
        return self._model

    @property
    def data(self) -> Any:
        """The `mujoco.MjData` of the model."""
        _ = self.model
        return self._data

    def _compile(self) -> None:
        model = self._model = self._spec.compile()
        self._data = self.mujoco.MjData(model)
        model.dof_solimp[:] = (0.9999, 0.9999, 0.001, 0.5, 2)  # motors are as stiff as PyBullet's
        model.jnt_actfrclimited[:] = 0
        self._positions = np.zeros(model.nv, int)  # index in qpos, by degree of freedom
        self._positions[model.jnt_dofadr] = model.jnt_qposadr
        self.velocity_cap = np.full(model.nv, np.inf)
        self._forget_motors()
        self._dirty = True
        for body in self.bodies.values():
            body.bind(model)
        self.spread_friction()

    def _forget_motors(self) -> None:
        count = self._model.nv
        self.target, self.speed = np.full(count, np.nan), np.full(count, np.nan)  # of position, of velocity motors
        self.gain, self.top_speed = np.zeros(count), np.full(count, np.inf)
        self.force, self.torque, self.applied = np.zeros(count), np.zeros(count), np.zeros(count)

    def spread_friction(self) -> None:
        """Give the geoms of moving bodies the product of their friction and the ground's, as PyBullet computes it."""
        fixed = [body for body in self.bodies.values() if body.fixed and not body.joint_names]
        ground = max((friction for body in fixed for friction in body.friction.values()), default=1.0)
        for body in self.bodies.values():
            for geom, link in body.geoms.items():
                moving = body.friction[link] * ground
                self.model.geom_friction[geom, 0] = _NO_FRICTION if body in fixed else moving

    def forward(self) -> Any:
        """Return the data after computing everything that depends on the positions."""
        data = self.data
        if self._dirty:
            self.mujoco.mj_step1(self._model, data)
            self._dirty = False
        return data

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
            speeds = np.where(driven, self.gain * (self.target - data.qpos[self._positions]) / dt, self.speed)
            speeds = np.clip(speeds, -self.top_speed, self.top_speed)
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
        data = self.data
        self._saved = data.qpos.copy(), data.qvel.copy()
        self._gravity = self._model.opt.gravity.copy()
        self.nominal = {name: getattr(self._model, name).copy() for name in _CHANGEABLE}
        for body in self.bodies.values():
            body.save()

    def restore(self) -> None:
        """As `Sim.restore`; bit for bit."""
        model, data = self.model, self.data
        model.dof_frictionloss[:] = 0
        self.mujoco.mj_resetData(model, data)
        data.qpos[:], data.qvel[:] = self._saved
        model.opt.gravity[:] = self._gravity
        for name, values in self.nominal.items():
            getattr(model, name)[:] = values
        self._forget_motors()
        self._pushes.clear()
        self._dirty = True
        for body in self.bodies.values():
            body.restore()

    def clear(self) -> None:
        """As `Sim.clear`."""
        self._begin()

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
