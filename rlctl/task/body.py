"""A body of the world: joints and links by name, state as numpy, motors with limits."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rlctl.errors import TaskError, check_name
from rlctl.task.bullet import pybullet
from rlctl.task.properties import Properties

Array = NDArray[np.float64]
Vector = tuple[float, float, float]


class MassState(NamedTuple):
    """Pose and velocity of a link's centre of mass, world frame. Plain floats are faster here than arrays."""

    position: Vector  # [m]
    orientation: tuple[float, float, float, float]  # quaternion (x, y, z, w) of the inertial frame
    velocity: Vector  # [m/s]
    angular_velocity: Vector  # [rad/s]

    @property
    def roll_pitch_yaw(self) -> Vector:
        """The orientation as angles about x, y, z [rad]."""
        return pybullet.getEulerFromQuaternion(self.orientation)


class Contacts(NamedTuple):
    """Points where a body touches another: one element per point."""

    links: list[str]  # the body's own link, or its base
    forces: Array  # normal forces [N], shape (points,), 0 or more
    distances: Array  # [m], shape (points,), negative where the bodies overlap, as in `rewards.penetration`


class Body(Properties):
    """A body of the world. Joint arrays have one element per movable joint, in `joint_names` order."""

    def __init__(self, client: int, substeps: int, name: str, body_id: int, file: Path, fixed: bool) -> None:
        super().__init__()
        self.name = name
        self.id = body_id
        self.file = file
        self.fixed = fixed
        self.terrain: Array | None = None
        """Points of rough ground [m], world frame, shape (along x, along y, 3); None for any other body."""
        self.inertia_from_file = False
        self.client = client
        self._substeps = substeps
        self._cache: dict[Any, Any] = {}
        self._force_sensors: set[str] = set()
        infos = [
            pybullet.getJointInfo(body_id, index, physicsClientId=client)
            for index in range(pybullet.getNumJoints(body_id, physicsClientId=client))
        ]
        self.all_joint_names = [info[1].decode() for info in infos]
        self._links = {info[12].decode(): index for index, info in enumerate(infos)}
        self.link_names = list(self._links)  # names of all links but the base
        self.base_name: str = pybullet.getBodyInfo(body_id, physicsClientId=client)[0].decode()
        self._all_names = [*self._links, self.base_name]
        movable = [info for info in infos if info[2] in (pybullet.JOINT_REVOLUTE, pybullet.JOINT_PRISMATIC)]
        self.joint_names = [info[1].decode() for info in movable]
        self.joint_indices = [int(info[0]) for info in movable]
        limits = np.array([info[8:10] for info in movable]).reshape(-1, 2)
        # PyBullet gives a joint without limits a lower limit above the upper one.
        self.joint_low, self.joint_high = np.where(limits[:, :1] > limits[:, 1:], (-np.inf, np.inf), limits).T
        """Joint limits [rad or m], infinite where the model file has none; each of shape (joints,)."""
        self.joint_max_force: Array = np.array([info[10] for info in movable])
        """Torque or force limit in the model file [N m or N], shape (joints,)."""
        self.joint_max_speed: Array = np.array([info[11] for info in movable])
        """Velocity limit in the model file [rad/s or m/s], shape (joints,)."""

    def _joint_states(self) -> tuple[Array, Array, Any]:
        # Positions, velocities, and motor torques in a tuple: few tasks need them as an array.
        state = self._cache.get("joints")
        if state is None:
            # None for a body without joints.
            raw = pybullet.getJointStates(self.id, self.joint_indices, physicsClientId=self.client) or ()
            positions, velocities, _, torques = zip(*raw, strict=True) if raw else ((), (), (), ())
            state = self._cache["joints"] = (np.array(positions), np.array(velocities), torques)
        return state

    @property
    def joint_positions(self) -> Array:
        """Joint angles [rad] or displacements [m], shape (joints,)."""
        return self._joint_states()[0]

    @property
    def joint_velocities(self) -> Array:
        """Joint velocities [rad/s] or [m/s], shape (joints,)."""
        return self._joint_states()[1]

    @property
    def joint_torques(self) -> Array:
        """Torques [N m] or forces [N] that the motors gave in the last physics step, shape (joints,).

        They include those of `drive_to` and `drive_at`, limited by their maximum force, and those of `set_torques`.
        """
        torques: Array | None = self._cache.get("torques")
        if torques is None:
            # PyBullet divides a substep's impulse by the time of the whole step.
            torques = self._substeps * np.array(self._joint_states()[2])
            if self._commanded is not None:
                torques = np.where(np.isnan(self._commanded), torques, self._commanded)
            self._cache["torques"] = torques
        return torques

    def add_force_sensor(self, joint: str) -> None:
        """Measure the load of a joint, which may be fixed; `joint_reaction` reads it. Call it in `build`."""
        pybullet.enableJointForceTorqueSensor(self.id, self._joint_number(joint), True, physicsClientId=self.client)
        self._force_sensors.add(joint)

    def joint_reaction(self, joint: str) -> Array:
        """Return the force [N] and torque [N m] that a joint carried in the last physics step, shape (6,).

        Both act on the link that the joint moves, in the axes of that link's inertial frame; the torque is about its
        centre of mass, without that of the joint's own motor. If a load hangs from the joint, the force points up.
        """
        if joint not in self._force_sensors:
            raise TaskError(f"joint {joint!r} has no force sensor: call add_force_sensor({joint!r}) in build")
        return np.array(pybullet.getJointState(self.id, self._joint_number(joint), physicsClientId=self.client)[2])

    def _joint_number(self, joint: str) -> int:
        check_name(joint, self.all_joint_names, f"{self.file.name} has no joint", TaskError)
        return self.all_joint_names.index(joint)

    def solve_inverse_kinematics(
        self, link: str, position: Sequence[float] | Array, orientation: Sequence[float] | Array | None = None
    ) -> Array:
        """Return joint positions [rad or m], shape (joints,), that bring a link's frame to a world pose.

        `position` [m]; `orientation` is a quaternion (x, y, z, w), by default any will do. The search starts at the
        current joint positions and stops within 0.1 mm or after 100 iterations, even if the pose is out of reach.
        """
        solution = pybullet.calculateInverseKinematics(
            self.id,
            self._link_index(link),
            *[list(part) for part in (position, orientation) if part is not None],
            maxNumIterations=100,
            residualThreshold=1e-4,
            physicsClientId=self.client,
        )
        return np.array(solution)

    def _link_pose(self, link: str) -> tuple[Array, Array]:
        pose = self._cache.get(("link", link))  # a pair: a link may be called "base" or "joints"
        if pose is None:
            index = self._link_index(link)
            state = pybullet.getLinkState(self.id, index, computeForwardKinematics=1, physicsClientId=self.client)
            # Items 4 and 5 are the link frame; 0 and 1 are the centre of mass.
            pose = self._cache["link", link] = (np.array(state[4]), np.array(state[5]))
        return pose

    def link_position(self, link: str) -> Array:
        """Position of the link frame [m], world frame, shape (3,)."""
        return self._link_pose(link)[0]

    def link_orientation(self, link: str) -> Array:
        """Orientation of the link frame, quaternion (x, y, z, w), world frame, shape (4,)."""
        return self._link_pose(link)[1]

    def mass_state(self, link: str) -> MassState:
        """Return where the centre of mass of a link, or of the base, is and how it moves.

        The position and orientation of a link are from the beginning of the last physics step (substep), because
        PyBullet computes them without `computeForwardKinematics`. Its velocities, and all values of the base, are from
        the end of that step.
        """
        state = self._cache.get(("mass", link))
        if state is None:
            state = self._cache["mass", link] = self._read_mass_state(link)
        return state

    def _read_mass_state(self, link: str) -> MassState:
        if link in self._links:
            raw = pybullet.getLinkState(self.id, self._links[link], computeLinkVelocity=1, physicsClientId=self.client)
            return MassState(raw[0], raw[1], raw[6], raw[7])
        if link != self.base_name:
            self._link_index(link)
        pose = pybullet.getBasePositionAndOrientation(self.id, physicsClientId=self.client)
        return MassState(*pose, *pybullet.getBaseVelocity(self.id, physicsClientId=self.client))

    def mass_positions(self, links: Sequence[str]) -> list[Vector]:
        """Return the positions of the centres of mass of links [m], world frame, as in `mass_state`; not cached."""
        numbers = [self._links[link] if link in self._links else self._link_index(link) for link in links]
        states = pybullet.getLinkStates(self.id, numbers, physicsClientId=self.client) or ()
        return [state[0] for state in states]

    def links_touching(self, other: "Body") -> set[str]:
        """Return the links, or the base, that touched `other` in the last step; `other` may be the body itself."""
        points = self._contact_points()
        # Each point lists this body first; a contact of the body with itself is listed once for both links.
        numbers = {point[3] for point in points if point[2] == other.id}
        if other is self:
            numbers |= {point[4] for point in points if point[2] == self.id}
        return {self._all_names[number] for number in numbers}  # the base, -1, is the last name

    def contacts_with(self, other: "Body") -> Contacts:
        """Return the points where this body touches `other`, at the last physics step."""
        points = [point for point in self._contact_points() if point[2] == other.id]
        names = [self._all_names[point[3]] for point in points]
        # PyBullet divides a substep's impulse by the time of the whole step.
        forces = np.array([point[9] for point in points]) * self._substeps
        return Contacts(names, forces, np.array([point[8] for point in points]))

    def distance_to(self, other: "Body", link: str | None = None) -> float:
        """Return the shortest distance [m] between the collision shapes of two bodies, negative where they overlap.

        If `link` is given, only that link of this body is measured.
        """
        index = {} if link is None else {"linkIndexA": self._part_index(link)}
        points = pybullet.getClosestPoints(self.id, other.id, 100.0, **index, physicsClientId=self.client)
        return min((float(point[8]) for point in points), default=math.inf)

    def _contact_points(self) -> Any:
        points = self._cache.get("contacts")
        if points is None:
            points = self._cache["contacts"] = pybullet.getContactPoints(self.id, physicsClientId=self.client)
        return points

    def _base_state(self) -> tuple[Array, Array]:
        state = self._cache.get("base")
        if state is None:
            position, orientation = pybullet.getBasePositionAndOrientation(self.id, physicsClientId=self.client)
            state = self._cache["base"] = (np.array(position), np.array(orientation))
        return state

    @property
    def base_position(self) -> Array:
        """Position of the base's centre of mass [m], world frame, shape (3,)."""
        return self._base_state()[0]

    @property
    def base_orientation(self) -> Array:
        """Orientation of the base's inertial frame, quaternion (x, y, z, w), shape (4,)."""
        return self._base_state()[1]

    def set_base(self, position: Sequence[float], orientation: Sequence[float] = (0, 0, 0, 1)) -> None:
        """Place the base at rest, its centre of mass at `position` [m]; `Sim.load` places its origin."""
        pybullet.resetBasePositionAndOrientation(self.id, position, orientation, physicsClientId=self.client)
        self._cache.clear()

    def add_velocity(self, velocity: Sequence[float]) -> None:
        """Add to the velocity of the base [m/s], world frame; all links move with it."""
        linear, angular = pybullet.getBaseVelocity(self.id, physicsClientId=self.client)
        pybullet.resetBaseVelocity(self.id, np.add(linear, velocity).tolist(), angular, physicsClientId=self.client)
        self._cache.clear()

    def set_joints(self, positions: Array, velocities: Array | None = None) -> None:
        """Place the joints: `positions` and `velocities` of shape (joints,); without velocities they are at rest."""
        count = len(self.joint_indices)
        angles = self._read_values("positions", positions, count)
        speeds = [0.0] * count if velocities is None else self._read_values("velocities", velocities, count)
        states = [[angle] for angle in angles], [[speed] for speed in speeds]
        pybullet.resetJointStatesMultiDof(self.id, self.joint_indices, *states, physicsClientId=self.client)
        self._cache.clear()
