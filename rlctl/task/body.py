"""A body of the world: joints and links by name, state as numpy, motors with limits."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlctl.errors import TaskError, did_you_mean
from rlctl.task.bullet import pybullet

Array = NDArray[np.float64]


class Body:
    """A body of the world. Joint arrays have one element per movable joint, in `joint_names` order."""

    def __init__(self, client: int, substeps: int, name: str, body_id: int, file: Path, fixed: bool) -> None:
        self.name = name
        self.id = body_id
        self.file = file
        self.fixed = fixed
        self.client = client
        self._substeps = substeps
        self._motor_limits: tuple[Sequence[float], Sequence[float], float] | None = None
        self._cache: dict[Any, Any] = {}
        self._changed = False
        infos = [
            pybullet.getJointInfo(body_id, index, physicsClientId=client)
            for index in range(pybullet.getNumJoints(body_id, physicsClientId=client))
        ]
        self.all_joint_names = [info[1].decode() for info in infos]
        self._links = {info[12].decode(): index for index, info in enumerate(infos)}
        movable = [info for info in infos if info[2] in (pybullet.JOINT_REVOLUTE, pybullet.JOINT_PRISMATIC)]
        self.joint_names = [info[1].decode() for info in movable]
        self.joint_indices = [int(info[0]) for info in movable]
        self.joint_low: Array = np.array([info[8] for info in movable])
        """Lower joint limits [rad or m], shape (joints,)."""
        self.joint_high: Array = np.array([info[9] for info in movable])
        self.joint_max_force: Array = np.array([info[10] for info in movable])
        """Torque or force limit in the model file [N m or N], shape (joints,)."""

    @property
    def link_names(self) -> list[str]:
        return list(self._links)

    def _link_index(self, link: str) -> int:
        if link not in self._links:
            raise TaskError(
                f"{self.file.name} has no link {link!r}.{did_you_mean(link, self._links)} "
                f"It has: {', '.join(self._links)}."
            )
        return self._links[link]

    def _joint_states(self) -> tuple[Array, Array]:
        state = self._cache.get("joints")
        if state is None:
            # None where a body has no joints.
            raw = pybullet.getJointStates(self.id, self.joint_indices, physicsClientId=self.client) or ()
            state = (np.array([joint[0] for joint in raw]), np.array([joint[1] for joint in raw]))
            self._cache["joints"] = state
        return state

    @property
    def joint_positions(self) -> Array:
        """Joint angles [rad] or displacements [m], shape (joints,)."""
        return self._joint_states()[0]

    @property
    def joint_velocities(self) -> Array:
        """Joint velocities [rad/s] or [m/s], shape (joints,)."""
        return self._joint_states()[1]

    def _link_state(self, link: str) -> tuple[Array, Array]:
        state = self._cache.get(("link", link))  # a link may be called "base" or "joints"
        if state is None:
            raw = pybullet.getLinkState(
                self.id, self._link_index(link), computeForwardKinematics=1, physicsClientId=self.client
            )
            # Items 4 and 5 are the link frame; 0 and 1 are the centre of mass.
            state = (np.array(raw[4]), np.array(raw[5]))
            self._cache["link", link] = state
        return state

    def link_position(self, link: str) -> Array:
        """Position of the link frame [m], world frame, shape (3,)."""
        return self._link_state(link)[0]

    def link_orientation(self, link: str) -> Array:
        """Orientation of the link frame, quaternion (x, y, z, w), world frame, shape (4,)."""
        return self._link_state(link)[1]

    def _base_state(self) -> tuple[Array, Array]:
        state = self._cache.get("base")
        if state is None:
            position, orientation = pybullet.getBasePositionAndOrientation(self.id, physicsClientId=self.client)
            state = (np.array(position), np.array(orientation))
            self._cache["base"] = state
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
        """Place the base at rest."""
        pybullet.resetBasePositionAndOrientation(self.id, position, orientation, physicsClientId=self.client)
        self._cache.clear()

    def set_joints(self, positions: Array, velocities: Array | None = None) -> None:
        """Place the joints: `positions` and `velocities` of shape (joints,), at rest without the latter."""
        pybullet.resetJointStatesMultiDof(
            self.id,
            self.joint_indices,
            positions[:, None].tolist(),
            (np.zeros_like(positions) if velocities is None else velocities)[:, None].tolist(),
            physicsClientId=self.client,
        )
        self._cache.clear()

    def drive_to(
        self, positions: Array, *, max_speed: Sequence[float], max_force: Sequence[float], gain: float = 0.1
    ) -> None:
        """Set position targets [rad or m] of every joint; speed [rad/s or m/s] and force [N m or N] are limited.

        `gain` is the part of the position error that a physics step takes away, in (0, 1].
        """
        limits = (max_speed, max_force, gain)
        if self._motor_limits != limits:
            self._limit_motors(max_speed, max_force, gain)
            self._motor_limits = limits
        pybullet.setJointMotorControlArray(
            self.id,
            self.joint_indices,
            pybullet.POSITION_CONTROL,
            targetPositions=positions.tolist(),  # half the time of an array
            forces=self._motor_impulses,
            positionGains=self._motor_gains,
            physicsClientId=self.client,
        )

    def _limit_motors(self, max_speed: Sequence[float], max_force: Sequence[float], gain: float) -> None:
        # PyBullet makes an impulse of a motor's force with the time of a whole step, and gives it in every substep.
        self._motor_impulses = [force / self._substeps for force in max_force]
        self._motor_gains = [gain] * len(self.joint_indices)
        # Only the call for one joint takes a speed; the motor keeps it when the call for all sets the targets.
        for index, speed in zip(self.joint_indices, max_speed, strict=True):
            pybullet.setJointMotorControl2(
                self.id, index, pybullet.POSITION_CONTROL, maxVelocity=speed, physicsClientId=self.client
            )

    def cap_joint_speed(self, speed: float) -> None:
        """Never let a joint, whatever pushes it, turn or slide faster than `speed` [rad/s or m/s]."""
        pybullet.changeDynamics(self.id, -1, maxJointVelocity=speed, physicsClientId=self.client)

    @cached_property
    def _nominal(self) -> list[tuple[int, float, float, tuple[float, float, float]]]:
        links = range(-1, len(self._links))
        infos = [pybullet.getDynamicsInfo(self.id, link, physicsClientId=self.client) for link in links]
        return [(link, info[0], info[1], info[2]) for link, info in zip(links, infos, strict=True)]

    def _save_nominal(self) -> None:
        self._changed = False
        self.__dict__.pop("_nominal", None)  # read again when needed: `build` may have set other values

    def _restore_nominal(self) -> None:
        # PyBullet's saved states have positions and velocities, but neither masses nor friction.
        if not self._changed:
            return
        self._changed = False
        for link, mass, friction, inertia in self._nominal:
            pybullet.changeDynamics(
                self.id,
                link,
                mass=mass,
                lateralFriction=friction,
                localInertiaDiagonal=inertia,
                physicsClientId=self.client,
            )

    def scale_mass(self, factor: float) -> None:
        """Set mass and inertia of every link to `factor` times the built world's value, until the next reset."""
        nominal = self._nominal
        self._changed = True
        for link, mass, _, inertia in nominal:
            pybullet.changeDynamics(
                self.id,
                link,
                mass=mass * factor,
                localInertiaDiagonal=[element * factor for element in inertia],
                physicsClientId=self.client,
            )

    def set_friction(self, friction: float) -> None:
        """Set the lateral friction of every link, until the next reset."""
        nominal = self._nominal
        self._changed = True
        for link, *_ in nominal:
            pybullet.changeDynamics(self.id, link, lateralFriction=friction, physicsClientId=self.client)
