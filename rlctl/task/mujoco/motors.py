"""Motors of a body's joints in MuJoCo: its own actuators, so that nothing of Python runs between substeps.

Each joint has an actuator with the force `ctrl + b1 * position + b2 * velocity`, within a range. `drive_to` makes it a
spring and a damper (b1 = -stiffness, b2 = -damping), `drive_at` a damper, `set_torques` a force. Without `set_drives`
those of a single world are `IdealMotors` in a command whose joints all turn without limits, as wheels do; all others
are springs and dampers which come close. `set_motors` makes actuators MuJoCo's DC motors, see `real_motors.py`: their
controllers have the same springs and dampers.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rlctl.errors import TaskError, check_name
from rlctl.task.body import Array, Body, Drives
from rlctl.task.motors import AnyMotors, Motor
from rlctl.task.mujoco.ideal_motors import IDEAL_DAMPING, IdealMotors
from rlctl.task.mujoco.parts import Parts, find_slice
from rlctl.task.mujoco.real_motors import (
    CONSTANT,
    DAMPING,
    INTEGRAL,
    RESISTANCE,
    STIFFNESS,
    VOLTAGE,
    MotorArrays,
    count_samples,
    delay_of,
    list_history,
)
from rlctl.task.world_index import WorldIndex

if TYPE_CHECKING:
    from rlctl.task.mujoco.owner import BodyOwner

_UNLIMITED = 1e9  # [N m or N]
_USUAL_SPEED = 10.0  # [rad/s or m/s], of joints whose file gives no limit
_STIFFEST = 10.0
_OWN = -1  # the key of `Parts.active` for the actuators of the file


class _Mode(NamedTuple):
    # What is written into the model for a kind of command; it stays the same in later calls.
    key: tuple[object, ...]
    joints: list[int]
    motors: Any  # their numbers
    positions: Any  # numbers of their elements in `qpos`
    velocities: Any  # and in `qvel`
    stiffness: Array
    damping: Array
    force: Array  # its limit [N m or N]
    max_speed: Array | None
    is_ideal: bool  # see `IdealMotors`
    is_real: NDArray[np.bool_]  # whether `set_motors` has set the joint's motor
    real_motors: NDArray[np.int64]  # numbers of those


class MujocoMotors(Body):
    """The part of `MujocoBody` that drives its joints."""

    def __init__(self, sim: BodyOwner, parts: Parts) -> None:
        self._sim, self.parts = sim, parts
        self._fields = sim.fields
        self._modes: dict[tuple[str, ...], _Mode] = {}
        self._chosen: set[int] = set()
        self._cap = np.inf

    @property
    def drives(self) -> Drives | None:  # type: ignore[override]
        """What `set_drives` set."""
        return None if self.parts.drives is None else Drives(*self.parts.drives[:2])

    @property
    def motors(self) -> Mapping[str, Motor]:  # type: ignore[override]
        """What `set_motors` set, by joint."""
        return {self.joint_names[joint]: motor for joint, motor in sorted(self.parts.real.items())}

    def bind_motors(self) -> None:
        """Take the numbers of a newly compiled model."""
        self._motors = np.arange(self._sim.model.nu)[self.parts.motors]
        self._real = MotorArrays(self.parts.real, len(self.joint_names))
        self._history = list_history(self._sim.model, self._motors.tolist())
        for joint, motor in self.parts.real.items():
            self.joint_max_force[joint] = motor.stall_torque_nm or self.joint_max_force[joint]
            self.joint_max_speed[joint] = motor.no_load_speed_rad_per_s or self.joint_max_speed[joint]
        self._modes.clear()
        self.parts.active.clear()
        self._cap = self.parts.speed_cap
        if self.parts.drives is not None:
            self._write_armature(self.parts.drives[2])

    def measure_inertia(self) -> None:
        """Compute the inertia that a torque on each joint moves in the present pose [kg m^2 or kg], shape (joints,)."""
        sim = self._sim
        if not self.joint_names:
            return
        sim.world.refresh()
        full = np.zeros((sim.model.nv, sim.model.nv))
        sim.mujoco.mj_fullM(sim.model, sim.data, full)
        self.parts.inertia = np.diag(full)[self.parts.velocities].copy()

    def forget_motors(self, worlds: WorldIndex | None) -> None:
        """Let nothing drive the joints after a reset, until the next command."""
        self.parts.active.clear()

    def hold_at(self, positions: Array, worlds: WorldIndex | None) -> None:
        """Let real motors hold these positions of all joints [rad] until the next command.

        Their controllers always act: without it a joint that a reset places would be driven to 0 where physics runs
        before the first command.
        """
        joints = list(self.parts.real)
        rows: Any = ... if worlds is None else worlds[:, None]
        motors, targets = self._motors[joints], np.asarray(positions)[..., joints]
        gains = self._fields.model("actuator_gainprm")[rows, motors, STIFFNESS]
        self._fields.data("ctrl")[rows, motors] = np.where(self._real.has_integral[joints], targets, gains * targets)

    @property
    def joint_torques(self) -> Array:
        if self.parts.own_actuators:  # they may act on several joints
            sums: Array = self._fields.data("qfrc_actuator")[..., self.parts.velocities].copy()
            return sums
        torques: Array = self._fields.data("actuator_force")[..., self.parts.motors].copy()
        return torques

    def set_drives(
        self,
        stiffness: float | Sequence[float] | Array,
        damping: float | Sequence[float] | Array,
        *,
        armature: float | Sequence[float] | Array | None = 0.0,
    ) -> None:
        inertia = None if armature is None else self._spread("armature", armature)
        self.parts.drives = (self._spread("stiffness", stiffness), self._spread("damping", damping), inertia)
        self._write_armature(inertia)
        self._modes.clear()

    def set_motors(self, motors: AnyMotors, *, joints: Sequence[str] = (), **changes: Any) -> None:
        chosen = self._spread_motors(motors, joints, changes)
        self._check_armature(chosen)
        self.parts.real |= chosen
        named = {self.joint_names[joint]: motor for joint, motor in chosen.items()}
        self._sim.add_motors(self.name, named)
        self._write_motors(chosen)

    def _check_armature(self, motors: Mapping[int, Motor]) -> None:
        """Raise `TaskError` for play without an inertia of the motor, which moves in it."""
        model = self._sim.model
        own = model.dof_armature[self.parts.velocities]
        for joint, motor in motors.items():
            armature = own[joint] if motor.armature_kgm2 is None else motor.armature_kgm2
            if motor.backlash_rad > 0 and armature <= 0:
                raise TaskError(
                    f"{self.file.name}: joint {self.joint_names[joint]!r} has backlash and no armature; give its "
                    "motor armature_kgm2, the inertia of rotor and gears"
                )

    def _write_motors(self, motors: Mapping[int, Motor]) -> None:
        """Write what a compilation takes from the model before it."""
        model = self._sim.model
        dofs = np.arange(model.nv)[self.parts.velocities]
        for joint, motor in motors.items():
            model.actuator_biasprm[self._motors[joint]] = 0.0  # that of a DC motor has other elements
            given = {
                "dof_armature": motor.armature_kgm2,
                "dof_frictionloss": motor.coulomb_friction_nm,
                "dof_damping": motor.viscous_friction_nms_per_rad,
            }
            for name, value in given.items():
                if value is not None:
                    getattr(model, name)[dofs[joint]] = value
            if motor.backlash_rad > 0:
                half = motor.backlash_rad / 2
                model.jnt_range[self.parts.plays[joint].joint] = -half, half
            encoder_bias = self._sim.world.extra["encoder bias"]
            encoder_bias[self._motors[joint]] = motor.encoder_bias_rad
            self.parts.has_bias = self.parts.has_bias or motor.encoder_bias_rad != 0

    def _write_armature(self, armature: Array | None) -> None:
        """Write that of `set_drives`; a real motor keeps its own."""
        if armature is None:
            return
        real = self.parts.real
        open_joints = [
            joint for joint in range(len(armature)) if joint not in real or real[joint].armature_kgm2 is None
        ]
        dofs = np.arange(self._sim.model.nv)[self.parts.velocities]
        self._sim.model.dof_armature[dofs[open_joints]] = armature[open_joints]

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
        mode = self._find_mode("position", joints, max_force, gain, max_speed)
        targets = self._read(positions, mode)
        self._write_mode(mode)
        if self.parts.has_bias:
            targets = targets - self._fields.model("encoder bias")[..., mode.motors]
        if mode.is_ideal:
            self._ideal.aim_at(mode.motors, targets)
            return
        force = self._read_stiffness(mode) * targets
        if mode.max_speed is not None:
            force = self._limit_approach(mode, targets, force)
        if self.parts.drives is None and not mode.is_real.all():
            force = force + np.where(mode.is_real, 0.0, self._hold(mode))
        elif velocities is not None:
            force = force + mode.damping * self._read(velocities, mode)
        if self._real.has_integral.any():
            force = self._aim_integrals(mode, targets, velocities, force)
        self._write_controls(mode, force)

    def _read_stiffness(self, mode: _Mode) -> Array:
        """Return the stiffness of the joints now; that of a real motor follows its voltage and its constant."""
        if not len(mode.real_motors):
            return mode.stiffness
        gains: Array = self._fields.model("actuator_gainprm")[..., mode.motors, STIFFNESS]
        return np.where(mode.is_real, gains, mode.stiffness)

    def _aim_integrals(self, mode: _Mode, targets: Array, velocities: Any, force: Array) -> Array:
        """Return the controls; that of a controller with an integral is its target, not a torque."""
        if velocities is not None:
            targets = targets + self._read(velocities, mode) * mode.damping / np.maximum(mode.stiffness, 1e-9)
        return np.where(self._real.has_integral[mode.joints], targets, force)

    def _write_controls(self, mode: _Mode, controls: Array) -> None:
        if self.parts.has_delay and len(mode.real_motors):
            self._fill_history(mode)
        self._fields.data("ctrl")[..., mode.motors] = controls

    def _fill_history(self, mode: _Mode) -> None:
        """After a reset, let motors with a delay hold the joints where they are, until the first command arrives."""
        awaits = self._fields.model("awaits command")
        if not np.count_nonzero(awaits[..., mode.motors]):
            return
        positions = self._fields.data("qpos")[..., mode.positions]
        velocities = self._fields.data("qvel")[..., mode.velocities]
        hold = self._read_stiffness(mode) * positions + mode.damping * velocities
        hold = np.where(self._real.has_integral[mode.joints], positions, hold)
        history = self._fields.data("history")
        for place, joint in enumerate(mode.joints):
            cells = self._history[joint]
            if not len(cells):
                continue
            first = awaits[..., self._motors[joint]] > 0
            history[..., cells] = np.where(first[..., None], hold[..., place, None], history[..., cells])
        awaits[..., mode.motors] = 0.0

    @property
    def _ideal(self) -> IdealMotors:
        return self._sim.world.ideal

    def _hold(self, mode: _Mode) -> Array:
        """Return the torques that hold the joints against gravity now, as PyBullet's ideal motors do."""
        bias: Array = self._fields.derived("qfrc_bias")[..., mode.velocities]
        return bias

    def _limit_approach(self, mode: _Mode, targets: Array, force: Array) -> Array:
        """Drive joints that are far from their target at their top speed instead, as PyBullet's motors do."""
        assert mode.max_speed is not None
        error = targets - self._fields.data("qpos")[..., mode.positions]
        distance = np.abs(error)
        far = distance * mode.stiffness > mode.max_speed * mode.damping
        biases = self._fields.model("actuator_biasprm")
        biases[..., mode.motors, 1] = np.where(far, 0.0, -mode.stiffness)
        if not np.count_nonzero(far):
            return force
        speed = np.minimum(mode.max_speed, distance / self._sim._control_dt)
        result: Array = np.where(far, mode.damping * np.copysign(speed, error), force)
        return result

    def drive_at(
        self, velocities: Array, *, max_force: float | Sequence[float] | None = None, joints: Sequence[str] = ()
    ) -> None:
        mode = self._find_mode("velocity", joints, max_force, 0.0, None)
        targets = self._read(velocities, mode)
        self._write_mode(mode)
        if mode.is_ideal:
            self._ideal.aim_at(mode.motors, targets)
            return
        self._check_torque(mode, "drive_at")
        hold = 0.0 if mode.is_real.all() else np.where(mode.is_real, 0.0, self._hold(mode))
        self._write_controls(mode, mode.damping * targets + hold)

    def disable_motors(self, joints: Sequence[str] = ()) -> None:
        chosen = self.find_joints(joints)
        self._chosen.update(chosen)
        driven = [self.joint_names[joint] for joint in chosen if joint in self.parts.active]
        if driven:
            self.set_torques(np.zeros((*self._fields.shape, len(driven))), driven)

    def set_torques(self, torques: Array, joints: Sequence[str] = ()) -> None:
        mode = self._find_mode("torque", joints, np.inf, 0.0, None)
        given = self._read(torques, mode)
        self._check_free(mode.joints)
        if given.any():
            self._check_torque(mode, "set_torques")
        self._write_mode(mode)
        self._write_controls(mode, given * self._fields.model("strength")[..., mode.motors])

    def _check_torque(self, mode: _Mode, method: str) -> None:
        """Raise `TaskError` for a motor that takes positions only."""
        chosen = np.flatnonzero(self._real.has_integral[mode.joints])
        if len(chosen):
            name = self.joint_names[mode.joints[chosen[0]]]
            raise TaskError(f"{method}: the controller of {name!r} has an integral of the position; use drive_to")

    def set_controls(self, values: Array, actuators: Sequence[str] = ()) -> None:
        names = self.parts.own_actuators
        for actuator in actuators:
            check_name(actuator, names, f"{self.file.name} has no actuator", TaskError)
        chosen = [names.index(actuator) for actuator in actuators] or list(range(len(names)))
        controls, shape = np.asarray(values, float), (*self._fields.shape, len(chosen))
        if not chosen or controls.shape != shape:
            raise TaskError(
                f"{self.file.name}: controls of shape {controls.shape} for actuators of shape {shape}; actuator_names "
                "of the body has all"
            )
        if self.parts.active.get(_OWN) is not self:
            self.parts.active[_OWN] = self
            self._fields.model("actuator_gear")[..., self.parts.own_motors, :] = self.parts.own_gears
            self._fields.touch()
        self._fields.data("ctrl")[..., self.parts.own_motors[chosen]] = controls

    def _read(self, values: Any, mode: _Mode) -> Array:
        array, shape = np.asarray(values, float), (*self._fields.shape, len(mode.joints))
        if array.shape != shape:
            raise TaskError(
                f"{self.file.name}: a command of shape {array.shape} for joints of shape {shape}; joint_names of the "
                "body has all"
            )
        return array

    def _find_mode(self, kind: str, joints: Sequence[str], max_force: Any, gain: float, max_speed: Any) -> _Mode:
        names = tuple(joints)
        # Tuples, because two arrays cannot be compared by `!=`.
        limits = [tuple(limit) if np.ndim(limit) else limit for limit in (max_force, max_speed)]
        key = (kind, gain, *limits)
        mode = self._modes.get(names)
        if mode is None or mode.key != key:
            mode = self._modes[names] = self._plan(key, kind, joints, max_force, gain, max_speed)
        return mode

    def _plan(
        self, key: tuple[object, ...], kind: str, joints: Sequence[str], max_force: Any, gain: float, max_speed: Any
    ) -> _Mode:
        chosen = self.find_joints(joints)
        self._chosen.update(chosen if kind != "torque" else ())
        motors = find_slice(self._motors[chosen])
        if self.parts.inertia is None:
            self.measure_inertia()
        assert self.parts.inertia is not None
        dt, inertia = self._sim.model.opt.timestep, self.parts.inertia[chosen]
        force = np.full(len(chosen), _UNLIMITED) if kind == "torque" else self._find_force_limits(chosen, max_force)
        # PyBullet's motors bring a joint to the wanted velocity in one physics step. The damping inertia / dt removes
        # half of the difference, more of it more; but a force that its limit cuts was computed from the velocity before
        # the step, and overshoots unless the limit changes the velocity by more than the joint's top speed.
        fastest = np.where(self.joint_max_speed[chosen] > 0, self.joint_max_speed[chosen], _USUAL_SPEED)
        damping = np.clip(force * dt / (inertia * fastest), 1.0, _STIFFEST) * inertia / dt
        stiffness = gain * damping / dt
        speed = None
        is_real = self._real.is_real[chosen]
        force = np.where(is_real, self._limit_real(chosen, max_force, force), force)
        if kind == "position":
            if self.parts.drives is not None:
                stiffness, damping = (values[chosen] for values in self.parts.drives[:2])
            if max_speed is not None and is_real.any():
                raise TaskError(
                    f"{self.file.name}: max_speed of a real motor: its speed follows from its voltage; leave it out"
                )
            stiffness = np.where(is_real, self._real.stiffness[chosen], stiffness)
            damping = np.where(is_real, self._real.damping[chosen], damping)
            default = self.joint_max_speed[chosen] if self.parts.drives is None else np.zeros(len(chosen))
            default = np.where(is_real, 0.0, default)
            given = default if max_speed is None else np.broadcast_to(np.asarray(max_speed, float), len(chosen))
            speed = np.where(given > 0, given, np.inf) if (given > 0).any() else None
        elif kind == "torque":
            damping = np.zeros(len(chosen))
        # Wheels carry a robot. The springs of arms and legs come close, without Python between physics steps.
        is_wheel = bool(np.isinf(self.joint_high[chosen]).all())
        is_ideal = is_wheel and self._sim.world.count is None and kind != "torque"
        if (kind == "position" and self.parts.drives is not None) or is_real.any():
            is_ideal = False
        if is_ideal:
            damping = IDEAL_DAMPING * inertia / dt
        is_spring = kind == "position" and not is_ideal
        return _Mode(
            key=key,
            joints=chosen,
            motors=motors,
            positions=find_slice(np.arange(self._sim.model.nq)[self.parts.positions][chosen]),
            velocities=find_slice(np.arange(self._sim.model.nv)[self.parts.velocities][chosen]),
            stiffness=stiffness if is_spring else 0.0 * damping,
            damping=damping,
            force=force,
            max_speed=speed,
            is_ideal=is_ideal,
            is_real=is_real,
            real_motors=self._motors[chosen][is_real],
        )

    def _limit_real(self, joints: list[int], max_force: Any, limits: Array) -> Array:
        """Return the torques that the task, or the model file where nothing else is known, allows real motors."""
        own = self._real.max_torque[joints]
        if max_force is not None:
            return np.minimum(own, np.broadcast_to(np.asarray(max_force, float), len(joints)))
        return np.where(np.isfinite(self._real.stall_torque[joints]), np.minimum(own, _UNLIMITED), limits)

    def _write_mode(self, mode: _Mode) -> None:
        """Write a kind of command into the model, if it is not there yet."""
        if all(self.parts.active.get(joint) is mode for joint in mode.joints):
            return
        self.parts.active.update(dict.fromkeys(mode.joints, mode))
        biases, ranges = self._fields.model("actuator_biasprm"), self._fields.model("actuator_forcerange")
        stiffness, damping = np.where(mode.is_real, 0.0, mode.stiffness), np.where(mode.is_real, 0.0, mode.damping)
        biases[..., mode.motors, 1], biases[..., mode.motors, 2] = -stiffness, -damping
        force = mode.force * self._fields.model("strength")[..., mode.motors]
        if len(mode.real_motors):
            force[..., mode.is_real] = self._write_real(mode)
        if self._sim.world.count is None:
            self._ideal.release(mode.motors)
        if mode.is_ideal:
            kind, gain = mode.key[:2]
            self._ideal.switch_on(
                mode.motors,
                damping=mode.damping,
                max_force=force,
                gain=gain if kind == "position" else None,
                max_speed=mode.max_speed,
            )
            force = np.full_like(force, _UNLIMITED)  # `IdealMotors` limits it
        ranges[..., mode.motors, 0], ranges[..., mode.motors, 1] = -force, force

    def _write_real(self, mode: _Mode) -> Array:
        """Write the controllers of real motors; return the limits of their torques, shape (..., motors)."""
        numbers, gains = mode.real_motors, self._fields.model("actuator_gainprm")
        chosen = np.array(mode.joints)[mode.is_real]
        nominal = self._sim.world.built("actuator_gainprm")[numbers]
        constants, voltages = gains[..., numbers, CONSTANT], gains[..., numbers, VOLTAGE]
        scale = constants / nominal[:, CONSTANT]
        by_voltage = self._real.regulates_voltage[chosen]
        # A servo's controller computes a fraction of its supply: with less voltage it is less stiff.
        gain = np.where(by_voltage, scale * voltages / np.maximum(nominal[:, VOLTAGE], 1e-9), scale)
        back_emf = np.where(by_voltage, constants**2 / nominal[:, RESISTANCE], 0.0)
        is_position = mode.key[0] == "position"
        gains[..., numbers, STIFFNESS] = gain * mode.stiffness[mode.is_real]
        gains[..., numbers, DAMPING] = gain * mode.damping[mode.is_real] + back_emf
        gains[..., numbers, INTEGRAL] = gain * self._real.integral[chosen] * is_position
        strength = self._fields.model("strength")[..., numbers]
        limits = np.minimum(mode.force[mode.is_real], scale * self._real.current_torque[chosen])
        weak = strength * np.minimum(limits, self._real.stall_torque[chosen])
        result: Array = np.where(strength == 1.0, limits, weak)
        return result

    def set_joint_friction(self, friction: Any, joints: Sequence[str] = ()) -> None:
        dofs = np.arange(self._sim.model.nv)[self.parts.velocities][self.find_joints(joints)]
        self._fields.model("dof_frictionloss")[..., dofs] = friction
        self._fields.touch()

    def set_backlash(self, backlash: Any, joints: Sequence[str] = ()) -> None:
        chosen = self.find_joints(joints)
        for joint in chosen:
            if joint not in self.parts.plays:
                raise TaskError(
                    f"{self.file.name}: joint {self.joint_names[joint]!r} has no play that could change; call "
                    "set_motors(.., backlash_rad=0.01) in build first"
                )
        numbers = [self.parts.plays[joint].joint for joint in chosen]
        half = np.asarray(backlash, float) / 2
        ranges = self._fields.model("jnt_range")
        ranges[..., numbers, 0], ranges[..., numbers, 1] = -half, half
        self._fields.touch()

    def set_voltage(self, voltage: Any, joints: Sequence[str] = ()) -> None:
        numbers = self._find_real(joints, "set_voltage")
        if not self._sim.world.built("actuator_gainprm")[numbers, VOLTAGE].all():
            raise TaskError(f"{self.file.name}: set_voltage: these motors have no voltage_v; give it to set_motors")
        self._fields.model("actuator_gainprm")[..., numbers, VOLTAGE] = voltage
        self.parts.active.clear()

    def scale_torque_constant(self, factor: Any, joints: Sequence[str] = ()) -> None:
        numbers = self._find_real(joints, "scale_torque_constant")
        nominal = self._sim.world.built("actuator_gainprm")[numbers, CONSTANT]
        self._fields.model("actuator_gainprm")[..., numbers, CONSTANT] = factor * nominal
        self.parts.active.clear()

    def set_encoder_bias(self, bias: Any, joints: Sequence[str] = ()) -> None:
        self.parts.has_bias = True
        self._fields.model("encoder bias")[..., self._motors[self.find_joints(joints)]] = bias

    def set_motor_delay(self, delay_s: float, joints: Sequence[str] = ()) -> None:
        numbers, model = self._find_real(joints, "set_motor_delay"), self._sim.model
        steps, room = count_samples(delay_s, model.opt.timestep), int(model.actuator_history[numbers, 0].min())
        if steps > room:
            raise TaskError(
                f"{self.file.name}: a delay of {delay_s:g} s; set_motors made room for "
                f"{room * model.opt.timestep:g} s: call set_motors(.., delay_s={delay_s:g}) in build"
            )
        self._fields.model("actuator_delay")[..., numbers] = delay_of(steps, model.opt.timestep)

    def _find_real(self, joints: Sequence[str], method: str) -> NDArray[np.int64]:
        """Return the numbers of real motors; raises `TaskError` for a joint without one."""
        chosen = self.find_joints(joints)
        for joint in chosen:
            if joint not in self.parts.real:
                name = self.joint_names[joint]
                raise TaskError(f"{self.file.name}: {method}: joint {name!r} has no motor; call set_motors in build")
        numbers: NDArray[np.int64] = self._motors[chosen]
        return numbers

    def scale_motor_strength(self, factor: float, joints: Sequence[str] = ()) -> None:
        motors = self._motors[self.find_joints(joints)]
        self._fields.model("strength")[..., motors] = factor * self._sim.world.built("strength")[motors]
        self.parts.active.clear()

    def cap_joint_speed(self, speed: float) -> None:
        self.parts.speed_cap = self._cap = speed

    def limit_speeds(self) -> None:
        """Cut the joints' speeds at the end of a control step; MuJoCo has no such limit."""
        if self._cap == np.inf:
            return
        speeds = self._fields.data("qvel")
        joints = speeds[..., self.parts.velocities]
        if np.count_nonzero(np.abs(joints) > self._cap):
            speeds[..., self.parts.velocities] = np.clip(joints, -self._cap, self._cap)
            self._fields.touch()
