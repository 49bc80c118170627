"""A body of a task's world in MuJoCo."""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from rlctl.errors import TaskError, UsageError, check_name
from rlctl.task.body import Contacts, MassState, Vector
from rlctl.task.mujoco.inverse_kinematics import solve
from rlctl.task.mujoco.motors import MujocoMotors
from rlctl.task.mujoco.parts import Parts
from rlctl.task.mujoco.world import Array
from rlctl.task.rotations import cross, rotate, rotate_inverse
from rlctl.task.world_index import WorldIndex

if TYPE_CHECKING:
    from rlctl.task.mujoco.owner import BodyOwner

XYZW, WXYZ = [1, 2, 3, 0], [3, 0, 1, 2]
"""Indices that reorder MuJoCo's quaternions (w, x, y, z) for rlctl, and back."""
_RAIL = 100.0  # [m]
_FAR = 100.0  # [m]
_SLIPPERY = 0.3
"""Friction below which contacts need more iterations of the solver than a task for batches takes (3, say)."""
_SLIPPERY_ITERATIONS = 50  # as PyBullet and MuJoCo take for any task by default
_SURFACE_GROUPS = np.array([1, 0, 0, 0, 0, 0], np.uint8)  # of geoms that rays meet
_OTHER_GROUP = 5
_LOCK_DAMPING = 1e7  # [N m s/rad or N s/m]; a motor of 100 N m moves such a joint by 1e-5 rad in a second


class MujocoBody(MujocoMotors):
    """A body in MuJoCo: a view of the arrays of its world, or worlds."""

    engine = "MuJoCo"

    def __init__(self, sim: BodyOwner, parts: Parts) -> None:
        super().__init__(sim, parts)
        self.name, self.file, self.fixed = parts.name, parts.file.path, parts.fixed
        self.base_name, self.terrain = parts.base_name, parts.terrain
        self.actuator_names, self.sensor_names = parts.own_actuators, parts.own_sensors
        self.inertia_from_file = parts.file.inertia_from_file
        self.joint_names = parts.joint_names
        self.joint_max_force, self.joint_max_speed = (
            np.array([limits.get(joint, 0.0) for joint in parts.joint_names])
            for limits in (parts.file.max_force, parts.file.max_speed)
        )
        if parts.links:
            self.bind()

    def bind(self) -> None:
        """Take the numbers of a newly compiled model."""
        parts = self.parts
        self._surface: tuple[Any, Any] | None = None  # for rays, of `surface_heights`
        self.joint_low, self.joint_high = parts.low, parts.high
        self.link_names = [link for link in parts.links if link != self.base_name]
        self._base = parts.links[self.base_name]
        self._positions, self._velocities = parts.positions, parts.velocities
        self.bind_motors()

    def find_link(self, link: str) -> int:
        """Return MuJoCo's number of a link or the base; raises `TaskError` for an unknown name."""
        if link not in self.parts.links:  # checked first because links are read at every step
            check_name(link, self.parts.links, f"{self.file.name} has no link", TaskError)
        return self.parts.links[link]

    def _find_links(self, links: Sequence[str]) -> list[int]:
        return [self.find_link(link) for link in links] or list(self.parts.link_names)

    def find_trunk(self) -> str | None:
        if not self.fixed:
            return self.base_name
        model = self._sim.model
        if not self.parts.joints:
            return None
        first = self.parts.joints[0]
        endless = not (model.jnt_limited[first] and np.ptp(model.jnt_range[first]) < _RAIL)
        if int(model.jnt_type[first]) != 2 or not endless:
            return None
        return next((link for link in self.link_names if link in dict(self.parts.collision_geoms).values()), None)

    @property
    def joint_positions(self) -> Array:
        positions: Array = self._fields.data("qpos")[..., self._positions].copy()
        if self.parts.has_bias:
            positions += self._fields.model("encoder bias")[..., self.parts.motors]
        return positions

    @property
    def joint_velocities(self) -> Array:
        velocities: Array = self._fields.data("qvel")[..., self._velocities].copy()
        return velocities

    def link_position(self, link: str) -> Array:
        position: Array = self._fields.derived("xpos")[..., self.find_link(link), :].copy()
        return position

    def link_orientation(self, link: str) -> Array:
        orientation: Array = self._fields.derived("xquat")[..., self.find_link(link), XYZW]
        return orientation

    @property
    def base_position(self) -> Array:
        position: Array = self._fields.derived("xipos")[..., self._base, :].copy()
        return position

    @property
    def base_orientation(self) -> Array:
        # MuJoCo's own inertial frame may have its axes in another order than the file.
        return self.link_orientation(self.base_name)

    @property
    def base_velocity(self) -> Array:
        if self.parts.free is None:
            return np.zeros((*self._fields.shape, 3))
        start = self.parts.free[1]
        velocity = self._fields.data("qvel")[..., start : start + 3]
        offset = rotate(self.base_orientation, self._fields.model("body_ipos")[..., self._base, :])
        return velocity + cross(self.base_angular_velocity, offset)

    @property
    def base_angular_velocity(self) -> Array:
        if self.parts.free is None:
            return np.zeros((*self._fields.shape, 3))
        start = self.parts.free[1] + 3
        # MuJoCo has it in the frame of the base.
        return rotate(self.base_orientation, self._fields.data("qvel")[..., start : start + 3])

    def mass_state(self, link: str) -> MassState:
        sim, number, velocity = self._single("mass_state"), self.find_link(link), np.zeros(6)
        sim.world.refresh()
        mujoco, data = sim.mujoco, sim.data
        mujoco.mj_objectVelocity(sim.model, data, mujoco.mjtObj.mjOBJ_BODY, number, velocity, 0)
        frame = data.xquat[number][XYZW]
        return MassState(*(tuple(part.tolist()) for part in (data.xipos[number], frame, velocity[3:], velocity[:3])))

    def mass_positions(self, links: Sequence[str]) -> list[Vector]:
        sim = self._single("mass_positions")
        sim.world.refresh()
        positions = sim.data.xipos[[self.find_link(link) for link in links]]
        return [(x, y, z) for x, y, z in positions.tolist()]

    def _single(self, method: str) -> BodyOwner:
        """Return the simulation; raises `UsageError` if it has many worlds."""
        if self._sim.world.count not in (None, 1):
            raise UsageError(
                f"{method} has no rows, so a BatchTask of many worlds cannot use it; link_position, link_orientation, "
                "base_velocity, base_angular_velocity and sensor have"
            )
        return self._sim

    def add_force_sensor(self, joint: str) -> None:
        moved = self.parts.file.moved_by
        check_name(joint, moved, f"{self.file.name} has no joint", TaskError)
        self._sim.add_force_sensor(f"{self.name}/{joint}", f"{self.name}/{moved[joint]}")

    def joint_reaction(self, joint: str) -> Array:
        try:
            halves = [self._fields.sensor(f"{self.name}/{name}") for name in (joint, f"{joint} torque")]
        except KeyError:
            raise TaskError(f"joint {joint!r} has no force sensor: call add_force_sensor({joint!r}) in build") from None
        return np.concatenate(halves, axis=-1)

    def add_contact_sensor(self, link: str) -> None:
        self.find_link(link)
        self._sim.add_contact_sensor(f"{self.name}/{link}")

    def touches(self, link: str) -> NDArray[np.bool_]:
        try:
            found = self._fields.sensor(f"{self.name}/{link} contacts")
        except KeyError:
            raise TaskError(
                f"link {link!r} has no contact sensor: call add_contact_sensor({link!r}) in build"
            ) from None
        touching: NDArray[np.bool_] = found[..., 0] > 0
        return touching

    def sensor(self, name: str) -> Array:
        check_name(name, self.sensor_names, f"{self.file.name} has no sensor", TaskError)
        return self._fields.sensor(f"{self.name}/{name}")

    def links_touching(self, other: Any) -> set[str]:
        return set(self._list_contacts("links_touching", other)[0])

    def contacts_with(self, other: Any) -> Contacts:
        links, contacts = self._list_contacts("contacts_with", other)
        sim, force = self._sim, np.zeros(6)
        forces = []
        for contact in contacts:
            sim.mujoco.mj_contactForce(sim.model, sim.data, contact, force)
            forces.append(float(force[0]))
        return Contacts(links, np.array(forces), sim.data.contact.dist[contacts].copy())

    def _list_contacts(self, method: str, other: Any) -> tuple[list[str], list[int]]:
        """Return the own links of contacts with another body, or with itself, and the numbers of the contacts."""
        sim, own, others = self._single(method), self.parts.link_names, other.parts.link_names
        sim.world.refresh()
        links, contacts = [], []
        pairs = sim.model.geom_bodyid[sim.data.contact.geom].tolist() if sim.data.ncon else ()
        for contact, (first, second) in enumerate(pairs):
            for one, two in ((first, second), (second, first)):
                if one in own and two in others:
                    links.append(own[one])
                    contacts.append(contact)
        return links, contacts

    def surface_heights(self, places: Array) -> Array:
        mujoco = self._sim.mujoco
        model, data = self._find_surface()
        top = float((data.geom_xpos[self.parts.geoms, 2] + model.geom_rbound[self.parts.geoms]).max()) + 1.0
        down, met = np.array([0.0, 0.0, -1.0]), np.zeros(1, np.int32)
        heights = np.zeros(places.shape[:-1])
        for index in np.ndindex(heights.shape):
            start = np.array([*places[index], top])
            distance = mujoco.mj_ray(model, data, start, down, _SURFACE_GROUPS, True, -1, met)
            if distance >= 0:
                heights[index] = top - distance
        return heights

    def _find_surface(self) -> tuple[Any, Any]:
        """Return a copy of the model in which rays meet this body only, and its data."""
        if self._surface is None:
            model = copy.copy(self._sim.model)
            model.geom_group[:] = _OTHER_GROUP
            model.geom_group[self.parts.geoms] = 0
            model.geom_rgba[self.parts.geoms, 3], model.geom_matid[self.parts.geoms] = (
                1.0,
                -1,
            )  # rays pass the invisible
            data = self._sim.mujoco.MjData(model)
            self._sim.mujoco.mj_kinematics(model, data)
            self._surface = model, data
        return self._surface

    def distance_to(self, other: Any, link: str | None = None) -> float:
        sim = self._single("distance_to")
        sim.world.refresh()
        owners = {self.find_link(link)} if link is not None else set(self.parts.link_names)
        own = [geom for geom in self.parts.geoms if int(sim.model.geom_bodyid[geom]) in owners]
        ends = np.zeros(6)
        distances = [
            sim.mujoco.mj_geomDistance(sim.model, sim.data, one, two, _FAR, ends)
            for one in own
            for two in other.parts.geoms
        ]
        nearest = min(distances, default=_FAR)
        return math.inf if nearest >= _FAR else float(nearest)

    def solve_inverse_kinematics(
        self, link: str, position: Sequence[float] | Array, orientation: Sequence[float] | Array | None = None
    ) -> Array:
        sim = self._single("solve_inverse_kinematics")
        turn = None if orientation is None else np.asarray(orientation, float)[WXYZ]
        found = solve(sim, self.parts, self.find_link(link), np.asarray(position, float), turn)
        if self.parts.has_bias:
            found = found + self._fields.model("encoder bias")[..., self.parts.motors]
        return found

    def set_base(
        self,
        position: Any,
        orientation: Any = (0.0, 0.0, 0.0, 1.0),
        *,
        velocity: Any = None,
        angular_velocity: Any = None,
        worlds: WorldIndex | None = None,
    ) -> None:
        rows: Any = ... if worlds is None else worlds
        turn = np.asarray(orientation, float)
        offset = rotate(turn, self._fields.model("body_ipos")[rows][..., self._base, :])
        origin = np.asarray(position, float) - offset
        if self.parts.free is None:
            self._fields.model("body_pos")[rows, self._base, :] = origin
            self._fields.model("body_quat")[rows, self._base, :] = turn[..., WXYZ]
        else:
            start, speed = self.parts.free
            self._fields.data("qpos")[rows, start : start + 3] = origin
            self._fields.data("qpos")[rows, start + 3 : start + 7] = turn[..., WXYZ]
            speeds = self._fields.data("qvel")
            speeds[rows, speed : speed + 6] = 0.0
            if velocity is not None:
                speeds[rows, speed : speed + 3] = velocity
            if angular_velocity is not None:
                # MuJoCo has it in the frame of the base, and the velocity of the base's origin.
                speeds[rows, speed : speed + 3] -= np.cross(angular_velocity, offset)
                speeds[rows, speed + 3 : speed + 6] = rotate_inverse(turn, angular_velocity)
        self._fields.touch(worlds)

    def add_velocity(self, velocity: Any, turning: Any = (0.0, 0.0, 0.0)) -> None:
        if self.parts.free is None:
            return
        start, speeds = self.parts.free[1], self._fields.data("qvel")
        if np.any(turning):
            # MuJoCo has the velocity of the frame's origin, and the angular velocity in the frame of the base.
            offset = rotate(self.base_orientation, self._fields.model("body_ipos")[..., self._base, :])
            velocity = np.subtract(velocity, np.cross(turning, offset))
            speeds[..., start + 3 : start + 6] += rotate_inverse(self.base_orientation, turning)
        speeds[..., start : start + 3] += velocity
        self._fields.touch()

    def set_joints(
        self, positions: Array, velocities: Array | None = None, *, worlds: WorldIndex | None = None
    ) -> None:
        rows: Any = ... if worlds is None else worlds
        places, speeds = self._fields.data("qpos"), self._fields.data("qvel")
        shape = places[rows][..., self._positions].shape
        self._check("positions", positions, shape)
        if self.parts.has_bias:
            positions = positions - self._fields.model("encoder bias")[rows][..., self.parts.motors]
        for play in self.parts.plays.values():
            places[rows, play.position] = speeds[rows, play.velocity] = 0.0
        if isinstance(self._positions, slice) or worlds is None:
            places[rows, self._positions] = positions
            speeds[rows, self._velocities] = 0.0 if velocities is None else velocities
        else:
            places[rows[:, None], self._positions] = positions
            speeds[rows[:, None], self._velocities] = 0.0 if velocities is None else velocities
        if self.parts.real:
            self.hold_at(positions, worlds)
        self._fields.touch(worlds)

    def _check(self, name: str, values: Any, shape: tuple[int, ...]) -> None:
        if np.shape(values) != shape:
            raise TaskError(
                f"{self.file.name}: {name} of shape {np.shape(values)}, expected {shape}; joint_names of the body has "
                "all joints"
            )

    def set_friction(self, friction: float, links: Sequence[str] = ()) -> None:
        numbers = self._find_links(links)
        self._fields.model("friction")[..., numbers] = friction
        if self._sim.world.batch is None and self._sim.world._saved is None:
            self.parts.built_friction |= {self.parts.link_names[number]: friction for number in numbers}
        if friction < _SLIPPERY:
            self._sim.world.solve_further(_SLIPPERY_ITERATIONS)
        self._sim.spread_friction()

    def scale_mass(self, factor: float, links: Sequence[str] = ()) -> None:
        numbers, world = self._find_links(links), self._sim.world
        masses, inertias = self._fields.model("body_mass"), self._fields.model("body_inertia")
        masses[..., numbers] = factor * world.built("body_mass")[numbers]
        inertias[..., numbers, :] = factor * world.built("body_inertia")[numbers]
        self._fields.touch()

    def total_mass(self) -> float:
        return float(self._sim.world.built("body_mass")[list(self.parts.link_names)].sum())

    def set_contact_stiffness(self, stiffness: float, links: Sequence[str] = ()) -> None:
        # MuJoCo's constraint pushes with k * depth / (sum of the inverse masses that the contact moves).
        sim, numbers = self._sim, self._find_links(links)
        chosen = np.isin(sim._pair_links, numbers).any(axis=1)
        inverse_mass = sim.model.body_invweight0[sim._pair_links, 0].sum(axis=1)[chosen]
        spring = stiffness * inverse_mass
        self._fields.model("pair_solref")[..., chosen, :] = np.stack([-spring, -2.0 * np.sqrt(spring)], axis=-1)
        self._fields.touch()

    def scale_joint_damping(self, factor: float, joints: Sequence[str] = ()) -> None:
        chosen, nominal = self._dofs(joints), self._sim.world.built("dof_damping")
        if not nominal[chosen].any():
            raise TaskError(f"{self.file.name}: these joints have no damping to scale; use set_joint_damping")
        self._fields.model("dof_damping")[..., chosen] = factor * nominal[chosen]
        self._fields.touch()

    def set_joint_damping(self, damping: float, joints: Sequence[str] = ()) -> None:
        self._fields.model("dof_damping")[..., self._dofs(joints)] = damping
        self._fields.touch()

    def lock_joints(self, joints: Sequence[str] = ()) -> None:
        self.set_joint_damping(_LOCK_DAMPING, joints)

    def _dofs(self, joints: Sequence[str]) -> NDArray[np.int64]:
        numbers = np.arange(self._sim.model.nv)[self._velocities]
        return numbers[self.find_joints(joints)]

    def set_color(self, rgb: Sequence[float], links: Sequence[str] = ()) -> None:
        numbers, bodies = self._find_links(links), self._sim.model.geom_bodyid
        geoms = np.flatnonzero(np.isin(bodies, numbers))
        self._fields.model("geom_rgba")[..., geoms, :3] = rgb
        self._fields.model("color")[..., numbers, :] = rgb
