"""A body of a task's world in PyBullet."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlctl.errors import TaskError, check_name
from rlctl.task.body import Array, Contacts, MassState, Vector
from rlctl.task.pybullet.library import pybullet
from rlctl.task.pybullet.properties import Properties


class PybulletBody(Properties):
    """A body in PyBullet. Its state is read at most once per control step."""

    engine = "PyBullet"

    def __init__(self, client: int, dt: float, substeps: int, name: str, body_id: int, file: Path, fixed: bool) -> None:
        super().__init__()
        self.name = name
        self.id = body_id
        self.file = file
        self.fixed = fixed
        self.terrain: Array | None = None
        self.client = client
        self._substeps, self._physics_dt = substeps, dt / substeps
        self._cache: dict[Any, Any] = {}
        self._force_sensors: set[str] = set()
        self._contact_sensors: dict[str, int] = {}  # numbers of links
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
        self.joint_max_force: Array = np.array([info[10] for info in movable])
        self.joint_max_speed: Array = np.array([info[11] for info in movable])

    def let_roll(self, wheels: Mapping[str, float]) -> None:
        """Let a body move on its wheels as in MuJoCo; their widths [m] are by link.

        PyBullet slows all links down: with the speed v they lose 0.04 * v * (1 + v) per second, which brakes fast
        wheels. And it finds one contact point of a wheel, in its middle, where two at its edges resist its turning.
        """
        pybullet.changeDynamics(self.id, -1, linearDamping=0.0, angularDamping=0.0, physicsClientId=self.client)
        for link, width in wheels.items():
            index = self._links[link]
            spinning = pybullet.getDynamicsInfo(self.id, index, physicsClientId=self.client)[7]
            if spinning == 0.0:  # the file gives none
                self._change(index, spinningFriction=width / 2)

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
        return self._joint_states()[0]

    @property
    def joint_velocities(self) -> Array:
        return self._joint_states()[1]

    @property
    def joint_torques(self) -> Array:
        torques: Array | None = self._cache.get("torques")
        if torques is None:
            # PyBullet divides a substep's impulse by the time of the whole step.
            torques = self._substeps * np.array(self._joint_states()[2])
            if self._commanded is not None:
                torques = np.where(np.isnan(self._commanded), torques, self._commanded)
            self._cache["torques"] = torques
        return torques

    def add_force_sensor(self, joint: str) -> None:
        pybullet.enableJointForceTorqueSensor(self.id, self._joint_number(joint), True, physicsClientId=self.client)
        self._force_sensors.add(joint)

    def joint_reaction(self, joint: str) -> Array:
        if joint not in self._force_sensors:
            raise TaskError(f"joint {joint!r} has no force sensor: call add_force_sensor({joint!r}) in build")
        return np.array(pybullet.getJointState(self.id, self._joint_number(joint), physicsClientId=self.client)[2])

    def add_contact_sensor(self, link: str) -> None:
        if link == self.base_name and link not in self._links:
            self._contact_sensors[link] = -1
        else:
            self._contact_sensors[link] = self._link_index(link)

    def touches(self, link: str) -> NDArray[np.bool_]:
        if link not in self._contact_sensors:
            raise TaskError(f"link {link!r} has no contact sensor: call add_contact_sensor({link!r}) in build")
        points = pybullet.getContactPoints(
            bodyA=self.id, linkIndexA=self._contact_sensors[link], physicsClientId=self.client
        )
        return np.array(bool(points))

    def _joint_number(self, joint: str) -> int:
        check_name(joint, self.all_joint_names, f"{self.file.name} has no joint", TaskError)
        return self.all_joint_names.index(joint)

    def solve_inverse_kinematics(
        self, link: str, position: Sequence[float] | Array, orientation: Sequence[float] | Array | None = None
    ) -> Array:
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
        if pose is None and link == self.base_name and link not in self._links:
            pose = self._cache["link", link] = self._base_frame()
        elif pose is None:
            index = self._link_index(link)
            state = pybullet.getLinkState(self.id, index, computeForwardKinematics=1, physicsClientId=self.client)
            # Items 4 and 5 are the link frame; 0 and 1 are the centre of mass.
            pose = self._cache["link", link] = (np.array(state[4]), np.array(state[5]))
        return pose

    def _base_frame(self) -> tuple[Array, Array]:
        # PyBullet has the pose of the base's centre of mass; the frame of the link is relative to it.
        mass = pybullet.getBasePositionAndOrientation(self.id, physicsClientId=self.client)
        info = pybullet.getDynamicsInfo(self.id, -1, physicsClientId=self.client)
        frame = pybullet.multiplyTransforms(*mass, *pybullet.invertTransform(info[3], info[4]))
        return np.array(frame[0]), np.array(frame[1])

    def link_position(self, link: str) -> Array:
        return self._link_pose(link)[0]

    def link_orientation(self, link: str) -> Array:
        return self._link_pose(link)[1]

    def mass_state(self, link: str) -> MassState:
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
        if self.base_name in links and self.base_name not in self._links:
            centres = [self._mass_centre(self._part_index(link)) for link in links]
            return [(x, y, z) for x, y, z in centres]
        numbers = [self._links[link] if link in self._links else self._link_index(link) for link in links]
        states = pybullet.getLinkStates(self.id, numbers, physicsClientId=self.client) or ()
        return [state[0] for state in states]

    def links_touching(self, other: "PybulletBody") -> set[str]:
        points = self._contact_points()
        # Each point lists this body first; a contact of the body with itself is listed once for both links.
        numbers = {point[3] for point in points if point[2] == other.id}
        if other is self:
            numbers |= {point[4] for point in points if point[2] == self.id}
        return {self._all_names[number] for number in numbers}  # the base, -1, is the last name

    def contacts_with(self, other: "PybulletBody") -> Contacts:
        points = [point for point in self._contact_points() if point[2] == other.id]
        names = [self._all_names[point[3]] for point in points]
        # PyBullet divides a substep's impulse by the time of the whole step.
        forces = np.array([point[9] for point in points]) * self._substeps
        return Contacts(names, forces, np.array([point[8] for point in points]))

    def distance_to(self, other: "PybulletBody", link: str | None = None) -> float:
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
        return self._base_state()[0]

    @property
    def base_orientation(self) -> Array:
        return self._base_state()[1]

    def set_base(
        self,
        position: Any,
        orientation: Any = (0.0, 0.0, 0.0, 1.0),
        *,
        velocity: Any = None,
        angular_velocity: Any = None,
        worlds: object = None,
    ) -> None:
        pybullet.resetBasePositionAndOrientation(self.id, position, orientation, physicsClientId=self.client)
        if velocity is not None or angular_velocity is not None:
            linear = np.zeros(3) if velocity is None else velocity
            angular = np.zeros(3) if angular_velocity is None else angular_velocity
            pybullet.resetBaseVelocity(self.id, list(linear), list(angular), physicsClientId=self.client)
        self._cache.clear()

    @property
    def base_velocity(self) -> Array:
        return np.array(pybullet.getBaseVelocity(self.id, physicsClientId=self.client)[0])

    @property
    def base_angular_velocity(self) -> Array:
        return np.array(pybullet.getBaseVelocity(self.id, physicsClientId=self.client)[1])

    def add_velocity(
        self, velocity: Sequence[float] | Array, turning: Sequence[float] | Array = (0.0, 0.0, 0.0)
    ) -> None:
        linear, angular = pybullet.getBaseVelocity(self.id, physicsClientId=self.client)
        new = np.add(linear, velocity).tolist(), np.add(angular, turning).tolist()
        pybullet.resetBaseVelocity(self.id, *new, physicsClientId=self.client)
        self._cache.clear()

    def set_joints(self, positions: Array, velocities: Array | None = None, *, worlds: object = None) -> None:
        count = len(self.joint_indices)
        angles = self._read_values("positions", positions, count)
        speeds = [0.0] * count if velocities is None else self._read_values("velocities", velocities, count)
        states = [[angle] for angle in angles], [[speed] for speed in speeds]
        pybullet.resetJointStatesMultiDof(self.id, self.joint_indices, *states, physicsClientId=self.client)
        self._cache.clear()
