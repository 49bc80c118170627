"""A body of a task's world in MuJoCo, with the methods of `Body`."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

import numpy as np
from numpy.typing import NDArray

from rlctl.errors import TaskError, UsageError, check_name
from rlctl.task.body import MassState
from rlctl.task.motors import Motors

if TYPE_CHECKING:
    from rlctl.task.mujoco_sim import MujocoSim

Array = NDArray[np.float64]

XYZW, WXYZ = [1, 2, 3, 0], [3, 0, 1, 2]
"""Indices that reorder MuJoCo's quaternions (w, x, y, z) for rlctl, and back."""
_FRICTION = 0.5  # PyBullet's, of a link whose file gives none


def refuse(name: str) -> NoReturn:
    """Raise `UsageError` for a feature without an equivalent in MuJoCo."""
    raise UsageError(f"{name}: not in MuJoCo; this task runs in PyBullet only")


class MujocoBody(Motors):
    """The methods of `Body`, for a body in MuJoCo; `child` is the `MjSpec` of its file."""

    def __init__(self, sim: MujocoSim, name: str, file: Path, fixed: bool, child: Any) -> None:
        super().__init__()
        self._sim, self.name, self.file, self.fixed = sim, name, file, fixed
        self._substeps = 1  # forces are not divided among substeps
        self.base_name: str = child.worldbody.first_body().name
        self.terrain = None
        self.geom_links: list[str] = [geom.parent.name for geom in child.geoms]
        """Name of the link of each geom."""
        self.moving: set[str] = set()
        """Links that are not fixed to the world."""
        for link in child.bodies[1:]:  # a parent comes before its children
            if not fixed or link.joints or link.parent.name in self.moving:
                self.moving.add(link.name)
        root = ElementTree.fromstring(file.read_bytes().strip())
        self._joints = {str(joint.get("name")): joint for joint in root.findall("joint")}
        links = {str(link.get("name")): link for link in root.findall("link")}
        # MuJoCo ignores PyBullet's `contact` tags.
        self.friction = {
            link: _read(part, "contact/lateral_friction", default=_FRICTION) for link, part in links.items()
        }
        """Lateral friction by link."""
        self.spin = {link: _read(part, "contact/spinning_friction") for link, part in links.items()}
        """Spinning friction by link [m]."""
        speeds = [_read(self._joints[joint.name], "limit", "velocity") for joint in child.joints]
        self._speed_cap = max(speeds) if fixed and speeds and min(speeds) > 0 else np.inf

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        refuse(name)

    def bind(self, model: Any) -> None:
        """Look up joints and links in a compiled model."""
        prefix, slide = f"{self.name}/", int(self._sim.mujoco.mjtJoint.mjJNT_SLIDE)
        names = {joint: model.joint(joint).name for joint in range(model.njnt) if model.jnt_type[joint] >= slide}
        names = {joint: name.removeprefix(prefix) for joint, name in names.items() if name.startswith(prefix)}
        self.joint_names, joints = list(names.values()), list(names)
        self._positions, self._velocities = model.jnt_qposadr[joints].astype(int), model.jnt_dofadr[joints].astype(int)
        limited, limits = model.jnt_limited[joints][:, None], model.jnt_range[joints]
        self.joint_low, self.joint_high = np.where(limited, limits, (-np.inf, np.inf)).T
        elements = [self._joints[name] for name in self.joint_names]
        self.joint_max_force = np.array([_read(joint, "limit", "effort") for joint in elements])
        self.joint_max_speed = np.array([_read(joint, "limit", "velocity") for joint in elements])
        bodies = {body: model.body(body).name for body in range(model.nbody)}
        self.links = {name.removeprefix(prefix): body for body, name in bodies.items() if name.startswith(prefix)}
        self.link_names = {body: name for name, body in self.links.items()}
        self._plans.clear()
        self._save_nominal()
        self.cap_joint_speed(self._speed_cap)

    def _save_nominal(self) -> None:
        super()._save_nominal()
        self._built_friction = dict(self.friction)

    def _restore_nominal(self) -> None:
        super()._restore_nominal()
        self.friction = dict(self._built_friction)

    def find_link(self, link: str) -> int:
        """Return MuJoCo's index of a link; raises `TaskError` for an unknown name."""
        check_name(link, self.links, f"{self.file.name} has no link", TaskError)
        return self.links[link]

    def find_trunk(self) -> str | None:
        """As `Body.find_trunk`, of free bodies."""
        return None if self.fixed else self.base_name

    @property
    def joint_positions(self) -> Array:
        """As `Body.joint_positions`."""
        return self._sim.forward().qpos[self._positions]

    @property
    def joint_velocities(self) -> Array:
        """As `Body.joint_velocities`."""
        return self._sim.forward().qvel[self._velocities]

    @property
    def joint_torques(self) -> Array:
        """As `Body.joint_torques`."""
        return self._sim.applied[self._velocities]

    def link_position(self, link: str) -> Array:
        """As `Body.link_position`."""
        return self._sim.forward().xpos[self.find_link(link)].copy()

    def link_orientation(self, link: str) -> Array:
        """As `Body.link_orientation`."""
        return self._sim.forward().xquat[self.find_link(link)][XYZW]

    def mass_state(self, link: str) -> MassState:
        """As `Body.mass_state`, at the end of the last physics step."""
        mujoco, data, number, velocity = self._sim.mujoco, self._sim.forward(), self.find_link(link), np.zeros(6)
        mujoco.mj_objectVelocity(self._sim.model, data, mujoco.mjtObj.mjOBJ_BODY, number, velocity, 0)
        # MuJoCo's own inertial frame may have its axes in another order than the file.
        frame = data.xquat[number][XYZW]
        return MassState(*(tuple(part.tolist()) for part in (data.xipos[number], frame, velocity[3:], velocity[:3])))

    @property
    def base_position(self) -> Array:
        """As `Body.base_position`."""
        return self._sim.forward().xipos[self.find_link(self.base_name)].copy()

    @property
    def base_orientation(self) -> Array:
        """As `Body.base_orientation`."""
        return self.link_orientation(self.base_name)

    def add_force_sensor(self, joint: str) -> None:
        """As `Body.add_force_sensor`."""
        check_name(joint, self._joints, f"{self.file.name} has no joint", TaskError)
        link = self._joints[joint].find("child").get("link")  # type: ignore[union-attr]
        self._sim.add_force_sensor(f"{self.name}/{joint}", f"{self.name}/{link}")

    def joint_reaction(self, joint: str) -> Array:
        """As `Body.joint_reaction`, for a joint without a motor."""
        start = self._sim.model.sensor(f"{self.name}/{joint}").adr[0]
        return self._sim.data.sensordata[start : start + 6].copy()

    def links_touching(self, other: MujocoBody) -> set[str]:
        """As `Body.links_touching`."""
        data, touching = self._sim.forward(), set()
        for first, second in self._sim.model.geom_bodyid[data.contact.geom].tolist() if data.ncon else ():
            if first in self.link_names and second in other.link_names:
                touching.add(self.link_names[first])
            if second in self.link_names and first in other.link_names:
                touching.add(self.link_names[second])
        return touching

    def set_base(self, position: Sequence[float], orientation: Sequence[float] = (0, 0, 0, 1)) -> None:
        """As `Body.set_base`: `position` is that of the centre of mass."""
        data, model, number = self._sim.touch(), self._sim.model, self.find_link(self.base_name)
        turn, offset = np.array(orientation, float)[WXYZ], np.zeros(3)
        self._sim.mujoco.mju_rotVecQuat(offset, model.body_ipos[number], turn)
        if self.fixed:
            model.body_pos[number], model.body_quat[number] = np.array(position) - offset, turn
            return
        joint = model.joint(f"{self.name}/free").id
        start, velocity = model.jnt_qposadr[joint], model.jnt_dofadr[joint]
        data.qpos[start : start + 7] = [*(np.array(position) - offset), *turn]
        data.qvel[velocity : velocity + 6] = 0.0

    def add_velocity(self, velocity: Sequence[float]) -> None:
        """As `Body.add_velocity`."""
        if self.fixed:
            return
        start = self._sim.model.jnt_dofadr[self._sim.model.joint(f"{self.name}/free").id]
        self._sim.touch().qvel[start : start + 3] += velocity

    def set_joints(self, positions: Array, velocities: Array | None = None) -> None:
        """As `Body.set_joints`."""
        data = self._sim.touch()
        data.qpos[self._positions] = positions
        data.qvel[self._velocities] = 0.0 if velocities is None else velocities

    def _command(self, joints: list[int], mode: str, **values: Any) -> None:
        sim, moved = self._sim, self._velocities[joints]
        if mode == "TORQUE_CONTROL":
            sim.torque[moved] = values["forces"]
            return
        sim.force[moved], sim.gain[moved] = values["forces"], values.get("positionGains", 0.0)
        sim.target[moved], sim.speed[moved] = (values.get(f"target{of}", np.nan) for of in ("Positions", "Velocities"))

    def _limit_speeds(self, joints: list[int], speeds: list[float]) -> None:
        self._sim.top_speed[self._velocities[joints]] = [speed or np.inf for speed in speeds]

    def cap_joint_speed(self, speed: float) -> None:
        """As `Body.cap_joint_speed`, but only for the joints."""
        self._sim.velocity_cap[self._velocities] = self._speed_cap = speed

    def set_friction(self, friction: float, links: Sequence[str] = ()) -> None:
        """As `Body.set_friction`."""
        for link in links:
            self.find_link(link)
        self.friction |= dict.fromkeys(links or self.friction, friction)
        self._sim.spread_friction()

    def scale_mass(self, factor: float, links: Sequence[str] = ()) -> None:
        """As `Body.scale_mass`."""
        model, nominal = self._sim.model, self._sim.nominal
        for number in {self.find_link(link) for link in links} or set(self.link_names):
            for name in ("body_mass", "body_inertia"):
                getattr(model, name)[number] = factor * nominal[name][number]


def _read(element: ElementTree.Element, path: str, name: str = "value", default: float = 0.0) -> float:
    part = element.find(path)
    return default if part is None else float(part.get(name, default))
