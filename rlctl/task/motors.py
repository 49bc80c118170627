"""Motors of a body's joints: position, velocity and torque control, limits; and joints as plain data."""

import dataclasses
import math
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rlctl.errors import TaskError, check_name
from rlctl.task.bullet import pybullet

Array = NDArray[np.float64]
_NUMBER = (int, float, np.number)


@dataclasses.dataclass(frozen=True)
class Joints:
    """Joints in the order of the action's elements; every other field has one element per joint, or is empty.

    Units: [rad] and [N m] for rotating joints, [m] and [N] for sliding joints.
    """

    names: Sequence[str]
    default_positions: Sequence[float] = ()  # start positions; with `action_scale` also the target of action 0
    action_scale: Sequence[float] = ()  # only if the target of an action is `default_positions + action_scale * action`
    stiffness: Sequence[float] = ()  # of the position controller that follows the action [N m/rad]
    damping: Sequence[float] = ()  # of the same controller [N m s/rad]
    low: Sequence[float] = ()  # lower position limits
    high: Sequence[float] = ()
    max_speed: Sequence[float] = ()  # [rad/s or m/s]
    max_torque: Sequence[float] = ()

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self)[1:]:
            values = [float(value) for value in getattr(self, field.name)]
            if values and (len(values) != len(self.names) or not all(map(math.isfinite, values))):
                raise TaskError(
                    f"joints: {field.name} must have {len(self.names)} finite values, one per joint, but is "
                    f"{list(values)}; leave it out if a value is unknown"
                )
            object.__setattr__(self, field.name, tuple(values))
        if odd := [name for name in self.names if not isinstance(name, str)]:
            raise TaskError(f"joints: names must be text, not {odd[0]!r}")
        object.__setattr__(self, "names", tuple(self.names))


class _Plan(NamedTuple):
    # The part of a call of `drive_to` that stays the same in later calls.
    limits: tuple[object, ...]
    joints: list[int]
    impulses: list[float]  # force of a substep [N m or N]
    gains: list[float]


class Motors:
    """The part of `Body` that drives its joints.

    `joints` are names, by default all in `joint_names` order. Arrays have one element per named joint; a limit may
    also be one number for all. Units: [N m] and [rad/s] for rotating joints, [N] and [m/s] for sliding joints.
    `MujocoBody` overrides `_command` and `_limit_speeds`, which call PyBullet.
    """

    client: int
    id: int
    file: Path
    joint_names: list[str]
    joint_indices: list[int]
    joint_low: Array
    joint_high: Array
    joint_max_force: Array
    joint_max_speed: Array
    _substeps: int

    def __init__(self) -> None:
        self.motor_strength: Array | None = None
        """Fraction of the commanded force that the motors give, shape (joints,); None: all of it."""
        self._built_strength: Array | None = None
        self._plans: dict[tuple[str, ...], _Plan] = {}
        self._commanded: list[float] | None = None  # by `set_torques`, of all joints; NaN: the motor's
        self._chosen: set[int] = set()  # joints whose motors the task has set or disabled

    def _save_nominal(self) -> None:
        self._built_strength = self.motor_strength

    def _restore_nominal(self) -> None:
        self.motor_strength = self._built_strength
        self._commanded = None

    def find_joints(self, joints: Collection[str] = ()) -> list[int]:
        """Return the indices of joints, or of all, in joint arrays; raises `TaskError` for a name that is not there."""
        for joint in joints:
            if joint not in self.joint_names:  # checked first because tasks may name joints at every step
                check_name(joint, self.joint_names, f"{self.file.name} has no joint", TaskError)
        if not self.joint_names:
            raise TaskError(f"{self.file.name} has no joints")
        return [self.joint_names.index(joint) for joint in joints] or list(range(len(self.joint_names)))

    def drive_to(
        self,
        positions: Array,
        *,
        max_speed: float | Sequence[float] | None = None,
        max_force: float | Sequence[float] | None = None,
        gain: float = 0.1,
        joints: Sequence[str] = (),
    ) -> None:
        """Set position targets [rad or m]; the default limits of speed and force are those of the model file.

        `gain` is the fraction of the position error that one physics step removes, in (0, 1].
        """
        # Tuples, because two arrays cannot be compared by `!=`.
        speeds, forces = (
            limit if limit is None or isinstance(limit, _NUMBER) else tuple(limit) for limit in (max_speed, max_force)
        )
        limits = (speeds, forces, gain)
        plan = self._plans.get(tuple(joints))
        if plan is None or plan.limits != limits:
            plan = self._plans[tuple(joints)] = self._plan_motors(joints, speeds, forces, gain)
        targets = self._read_values("positions", positions, len(plan.joints))
        self._forget_torques(plan.joints)
        impulses = self._apply_strength(plan.impulses, plan.joints)
        self._command(
            plan.joints, "POSITION_CONTROL", targetPositions=targets, forces=impulses, positionGains=plan.gains
        )

    def _plan_motors(
        self,
        joints: Sequence[str],
        max_speed: float | Sequence[float] | None,
        max_force: float | Sequence[float] | None,
        gain: float,
    ) -> _Plan:
        chosen = self.find_joints(joints)
        given = self.joint_max_speed[chosen] if max_speed is None else max_speed
        self._limit_speeds(chosen, self._read_limits("max_speed", given, len(chosen)))
        impulses = self._motor_impulses(chosen, max_force)
        return _Plan((max_speed, max_force, gain), chosen, impulses, [gain] * len(chosen))

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
        """Set velocity targets [rad/s or m/s]; the default limit of the force is that of the model file.

        A target of 0 brakes the joint with at most that force.
        """
        chosen = self.find_joints(joints)
        targets = self._read_values("velocities", velocities, len(chosen))
        self._forget_torques(chosen)
        forces = self._apply_strength(self._motor_impulses(chosen, max_force), chosen)
        self._command(chosen, "VELOCITY_CONTROL", targetVelocities=targets, forces=forces)

    def _motor_impulses(self, joints: list[int], max_force: float | Sequence[float] | None) -> list[float]:
        # PyBullet computes a motor's impulse for the time of a whole step, and applies it in every substep.
        forces = self.joint_max_force[joints] if max_force is None else max_force
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
        """Switch off the motors that PyBullet gives every joint, so that only `set_torques` moves the joints."""
        chosen = self.find_joints(joints)
        self._chosen.update(chosen)
        gains = [0.1] * len(chosen)
        self._command(chosen, "POSITION_CONTROL", forces=[0.0] * len(chosen), positionGains=gains, velocityGains=gains)

    def set_torques(self, torques: Array, joints: Sequence[str] = ()) -> None:
        """Apply `torques` [N m or N] to the joints in all substeps of the next step.

        Disable the motors of these joints first, with `disable_motors`. Raises `TaskError` for a joint whose default
        motor still holds it in place.
        """
        chosen = self.find_joints(joints)
        given = self._apply_strength(self._read_values("torques", torques, len(chosen)), chosen)
        if not self._chosen.issuperset(chosen):
            held = next(self.joint_names[joint] for joint in chosen if joint not in self._chosen)
            raise TaskError(
                f"set_torques: the motor of {held!r} holds it in place; call disable_motors() in build first"
            )
        if joints:
            self._commanded = self._commanded or [math.nan] * len(self.joint_names)
            for joint, torque in zip(chosen, given, strict=True):
                self._commanded[joint] = torque
        else:
            self._commanded = given
        self._command(chosen, "TORQUE_CONTROL", forces=given)

    def scale_motor_strength(self, factor: float, joints: Sequence[str] = ()) -> None:
        """Scale the force of the joints' motors by `factor`, until the next reset."""
        built = np.ones(len(self.joint_names)) if self._built_strength is None else self._built_strength
        strength = built.copy() if self.motor_strength is None else self.motor_strength.copy()
        indices = self.find_joints(joints)
        strength[indices] = factor * built[indices]
        self.motor_strength = strength

    def cap_joint_speed(self, speed: float) -> None:
        """Limit the speed of all joints to `speed` [rad/s or m/s], even under external forces.

        PyBullet has one such limit per body, which also applies to the base of a free body. `Sim.load` sets it for a
        fixed body to the highest speed limit of the joints in the URDF.
        """
        pybullet.changeDynamics(self.id, -1, maxJointVelocity=speed, physicsClientId=self.client)

    def describe_joints(
        self, joints: Sequence[str], *, default_positions: Sequence[float] = (), action_scale: Sequence[float] = ()
    ) -> Joints:
        """Return joints with the limits of the model file, for `Task.describe_joints`.

        If a limit is missing, 0 or infinite for one of the joints, it is left out for all of them.
        """
        chosen = self.find_joints(joints)
        low, high = self.joint_low[chosen], self.joint_high[chosen]
        speed, torque = (
            limits.tolist() if (limits > 0).all() and np.isfinite(limits).all() else ()
            for limits in (self.joint_max_speed[chosen], self.joint_max_force[chosen])
        )
        bounded = bool((low < high).all() and np.isfinite([low, high]).all())
        return Joints(
            names=[self.joint_names[joint] for joint in chosen],
            default_positions=default_positions,
            action_scale=action_scale,
            low=low.tolist() if bounded else (),
            high=high.tolist() if bounded else (),
            max_speed=speed,
            max_torque=torque,
        )
