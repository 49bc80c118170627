"""Motors of a body's joints in PyBullet: position, velocity and torque control, and their limits."""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from rlctl.errors import TaskError
from rlctl.task.body import Array, Body, Drives
from rlctl.task.pybullet.library import pybullet

_NUMBER = (int, float, np.number)
_LOCK_FORCE = 1e6  # [N m or N], more than any motor or load
_MOST_DAMPING = 1.5  # of a velocity that an explicit damper may remove in a physics step; it is unstable above 2


class _Plan(NamedTuple):
    # The part of a call of `drive_to` that stays the same in later calls.
    limits: tuple[object, ...]
    joints: list[int]
    links: list[int]  # of these joints
    impulses: list[float]  # force of a substep [N m or N]
    gains: list[float]


def _as_key(limit: float | Sequence[float] | None) -> Any:
    """Return a limit as what can be compared with `!=`, which two arrays cannot."""
    return limit if limit is None or isinstance(limit, _NUMBER) else tuple(limit)


class Motors(Body):
    """The part of `PybulletBody` that drives its joints."""

    client: int
    id: int
    joint_indices: list[int]
    _substeps: int
    _physics_dt: float  # [s], of a substep

    def __init__(self) -> None:
        self.motor_strength: Array | None = None
        """Fraction of the commanded force that the motors give, shape (joints,); None: all of it."""
        self._built_strength: Array | None = None
        self._plans: dict[tuple[str, ...], _Plan] = {}
        self._commanded: list[float] | None = None  # by `set_torques`, of all joints; NaN: the motor's
        self._chosen: set[int] = set()
        self.drives: Drives | None = None
        self._targets: dict[int, tuple[float, float]] = {}  # of springs: position and limit of the force, by joint
        self._locked: dict[int, float] = {}  # positions of joints that cannot move

    def _save_nominal(self) -> None:
        self._built_strength = self.motor_strength

    def _restore_nominal(self) -> None:
        self.motor_strength = self._built_strength
        self._commanded = None
        self._targets.clear()
        if self._locked:
            self._switch_off([*self._locked])
            self._locked.clear()

    def drive_to(
        self,
        positions: Array,
        *,
        max_speed: float | Sequence[float] | None = None,
        max_force: float | Sequence[float] | None = None,
        gain: float = 0.1,
        joints: Sequence[str] = (),
        velocities: Array | None = None,
    ) -> None:
        if velocities is not None:
            self._refuse("drive_to(velocities=..)")
        limits = (_as_key(max_speed), _as_key(max_force), gain)
        plan = self._plans.get(tuple(joints))
        if plan is None or plan.limits != limits:
            plan = self._plans[tuple(joints)] = self._plan_motors(joints, *limits)
        targets = self._read_values("positions", positions, len(plan.joints))
        self._forget_torques(plan.joints)
        impulses = self._apply_strength(plan.impulses, plan.joints)
        if self.drives is not None:
            pairs = zip(plan.joints, zip(targets, impulses, strict=True), strict=True)
            self._targets |= dict(pairs)
            return
        pybullet.setJointMotorControlArray(
            self.id,
            plan.links,
            pybullet.POSITION_CONTROL,
            targetPositions=targets,
            forces=impulses,
            positionGains=plan.gains,
            physicsClientId=self.client,
        )

    def _plan_motors(
        self,
        joints: Sequence[str],
        max_speed: float | Sequence[float] | None,
        max_force: float | Sequence[float] | None,
        gain: float,
    ) -> _Plan:
        chosen = self.find_joints(joints)
        if self.drives is None:  # the call for the speed starts a position motor
            given = self.joint_max_speed[chosen] if max_speed is None else max_speed
            self._limit_speeds(chosen, self._read_limits("max_speed", given, len(chosen)))
        impulses = self._motor_impulses(chosen, max_force)
        links = [self.joint_indices[joint] for joint in chosen]
        return _Plan((max_speed, max_force, gain), chosen, links, impulses, [gain] * len(chosen))

    def set_drives(
        self,
        stiffness: float | Sequence[float] | Array,
        damping: float | Sequence[float] | Array,
        *,
        armature: float | Sequence[float] | Array | None = 0.0,
    ) -> None:
        self.drives = Drives(self._spread("stiffness", stiffness), self._spread("damping", damping))
        if armature is not None:
            self._spread("armature", armature)  # raises for what cannot be; PyBullet's joints have none
        self.disable_motors()
        self._check_damping(self.drives.damping)

    def _check_damping(self, damping: Array) -> None:
        """Raise `TaskError` for dampers that reverse a velocity in a physics step: in PyBullet they are explicit."""
        rates, shapes = np.linalg.eig(np.linalg.solve(self._mass_matrix(), np.diag(damping)))
        fastest = int(np.argmax(rates.real))
        if (share := float(rates.real[fastest]) * self._physics_dt) > _MOST_DAMPING:
            joint = int(np.argmax(np.abs(shapes[:, fastest])))
            raise TaskError(
                f"{self.file.name}: a damping of {damping[joint]:g} of joint {self.joint_names[joint]!r} is too large "
                f"for PyBullet's steps of {self._physics_dt:g} s: use {math.ceil(share / _MOST_DAMPING)} times as many "
                "substeps, or --sim mujoco"
            )

    def _mass_matrix(self) -> Array:
        """Return the inertia matrix of the joints in the present pose [kg m^2 or kg], shape (joints, joints)."""
        positions = self.joint_positions.tolist()
        matrix = np.array(pybullet.calculateMassMatrix(self.id, positions, physicsClientId=self.client))
        free = len(matrix) - len(positions)  # the velocities of a free base come first
        inertia: Array = np.linalg.inv(np.linalg.inv(matrix)[free:, free:])
        return inertia

    def apply_drives(self) -> None:
        """Apply the torques of springs and dampers for one physics step; their targets are those of `drive_to`."""
        if not self._targets or self.drives is None:
            return
        states = pybullet.getJointStates(self.id, self.joint_indices, physicsClientId=self.client)
        count = len(self.joint_names)
        torques = [math.nan] * count
        for joint, (target, limit) in self._targets.items():
            position, velocity = states[joint][:2]
            torque = self.drives.stiffness[joint] * (target - position) - self.drives.damping[joint] * velocity
            torques[joint] = min(max(float(torque), -limit), limit)
        self._commanded = torques
        chosen = list(self._targets)
        self._command(chosen, "TORQUE_CONTROL", forces=[torques[joint] for joint in chosen])

    def _limit_speeds(self, joints: list[int], speeds: list[float]) -> None:
        # Only the call for one joint takes a speed; the motor keeps it when the call for all sets the targets.
        for joint, speed in zip(joints, speeds, strict=True):
            index = self.joint_indices[joint]
            pybullet.setJointMotorControl2(
                self.id, index, pybullet.POSITION_CONTROL, maxVelocity=speed, physicsClientId=self.client
            )

    def _command(self, joints: list[int], mode: str, **values: Any) -> None:
        links, control = [self.joint_indices[joint] for joint in joints], getattr(pybullet, mode)
        pybullet.setJointMotorControlArray(self.id, links, control, **values, physicsClientId=self.client)

    def drive_at(
        self, velocities: Array, *, max_force: float | Sequence[float] | None = None, joints: Sequence[str] = ()
    ) -> None:
        chosen = self.find_joints(joints)
        targets = self._read_values("velocities", velocities, len(chosen))
        self._forget_torques(chosen)
        forces = self._apply_strength(self._motor_impulses(chosen, max_force), chosen)
        self._command(chosen, "VELOCITY_CONTROL", targetVelocities=targets, forces=forces)

    def _motor_impulses(self, joints: list[int], max_force: float | Sequence[float] | None) -> list[float]:
        # PyBullet computes a motor's impulse for the time of a whole step, and applies it in every substep.
        forces = self._find_force_limits(joints, None).tolist() if max_force is None else max_force
        return [force / self._substeps for force in self._read_limits("max_force", forces, len(joints))]

    def _apply_strength(self, forces: list[float], joints: list[int]) -> list[float]:
        # The forces that the motors give, one per index in `joints`.
        return forces if self.motor_strength is None else (self.motor_strength[joints] * forces).tolist()

    def _read_limits(self, name: str, limits: float | Array | Sequence[float], count: int) -> list[float]:
        return self._read_values(name, [limits] * count if isinstance(limits, _NUMBER) else limits, count)

    def _read_values(self, name: str, values: Array | Sequence[float], count: int) -> list[float]:
        # PyBullet's own error names neither the body nor its number of joints; it reads lists twice as fast as arrays.
        array = np.asarray(values, float)
        if array.shape != (count,):
            raise TaskError(
                f"{self.file.name}: {name} of shape {array.shape} for {count} joints; joint_names of the body has all"
            )
        return array.tolist()

    def _forget_torques(self, joints: list[int]) -> None:
        self._chosen.update(joints)
        if self._commanded is not None:
            for joint in joints:
                self._commanded[joint] = math.nan

    def disable_motors(self, joints: Sequence[str] = ()) -> None:
        chosen = self.find_joints(joints)
        self._chosen.update(chosen)
        self._switch_off(chosen)

    def _switch_off(self, joints: list[int]) -> None:
        gains = [0.1] * len(joints)
        self._command(joints, "POSITION_CONTROL", forces=[0.0] * len(joints), positionGains=gains, velocityGains=gains)

    def lock_joints(self, joints: Sequence[str] = ()) -> None:
        chosen = self.find_joints(joints)
        self._locked |= dict(zip(chosen, self.joint_positions[chosen].tolist(), strict=True))

    def apply_locks(self) -> None:
        """Hold the locked joints in the next step, whatever the task has commanded."""
        if self._locked:
            count = len(self._locked)
            self._command(
                [*self._locked],
                "POSITION_CONTROL",
                targetPositions=[*self._locked.values()],
                forces=[_LOCK_FORCE] * count,
                positionGains=[0.5] * count,
            )

    def set_torques(self, torques: Array, joints: Sequence[str] = ()) -> None:
        chosen = self.find_joints(joints)
        given = self._apply_strength(self._read_values("torques", torques, len(chosen)), chosen)
        self._check_free(chosen)
        if joints:
            self._commanded = self._commanded or [math.nan] * len(self.joint_names)
            for joint, torque in zip(chosen, given, strict=True):
                self._commanded[joint] = torque
        else:
            self._commanded = given
        self._command(chosen, "TORQUE_CONTROL", forces=given)

    def scale_motor_strength(self, factor: float, joints: Sequence[str] = ()) -> None:
        built = np.ones(len(self.joint_names)) if self._built_strength is None else self._built_strength
        strength = built.copy() if self.motor_strength is None else self.motor_strength.copy()
        indices = self.find_joints(joints)
        strength[indices] = factor * built[indices]
        self.motor_strength = strength

    def cap_joint_speed(self, speed: float) -> None:
        pybullet.changeDynamics(self.id, -1, maxJointVelocity=speed, physicsClientId=self.client)
