"""`Motor`: a real motor with its gears and its position controller, as data that all parts of rlctl share.

All values are those at the joint, in SI units, but the torque constant: it is the electric motor's, before the gears.
The torque at the joint, before friction, is

    stiffness * (target - position) - damping * velocity + integral of the error     within these limits:
    torque constant * gear ratio * current limit, and `max_torque_nm`
    what the voltage drives through the resistance against the back-EMF, so less at higher speed

A drive that regulates its voltage only, as hobby servos do, is also braked by the back-EMF. For sliding joints read m
for rad, N for N m and kg for kg m^2.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import Any, Literal, Self

from rlctl.errors import TaskError, check_name

Regulates = Literal["torque", "voltage"]


@dataclasses.dataclass(frozen=True)
class Motor:
    """A motor, its gears and its position controller. None: unknown, and without effect or as in the model file."""

    stiffness_nm_per_rad: float | None = None
    """Torque per position error, at the voltage `voltage_v`; `set_motors` needs it."""
    damping_nms_per_rad: float = 0.0
    """Torque per velocity that the controller adds; friction and back-EMF are not part of it."""
    integral_nm_per_rads: float = 0.0
    """Torque per integral of the position error [N m/(rad s)]."""
    regulates: Regulates = "torque"
    """What the controller sets: the torque, by the current, until a limit; or the voltage, as hobby servos do."""
    torque_constant_nm_per_a: float | None = None
    """Of the electric motor, before the gears; its back-EMF constant [V s/rad] is the same number."""
    resistance_ohm: float | None = None
    """Of the electric motor's terminals."""
    voltage_v: float | None = None
    """Supply; stall torque and no-load speed follow from it, the torque constant and the resistance."""
    current_limit_a: float | None = None
    gear_ratio: float = 1.0
    """Turns of the motor per turn of the joint; 1 where the constants are already those at the joint."""
    max_torque_nm: float | None = None
    armature_kgm2: float | None = None
    """Inertia of rotor and gears at the joint; None: the model file's."""
    coulomb_friction_nm: float | None = None
    """Torque of dry friction; None: the model file's `frictionloss`."""
    viscous_friction_nms_per_rad: float | None = None
    """Torque of friction per velocity; None: the model file's `damping`."""
    backlash_rad: float = 0.0
    """Play between the gears and the link, from end to end; the encoder is on the motor's side of it."""
    delay_s: float = 0.0
    """Time from a command to the torque that follows it, rounded to physics steps."""
    encoder_bias_rad: float = 0.0
    """What the encoder reads where the joint is at 0."""
    name: str = ""
    """In the table of `rlctl.task.named_motors`."""
    duty_per_rad_and_gain: float | None = None
    """Fraction of the supply per position error [rad] and per 1 of the controller's own gain; see `position_gain`."""

    def __post_init__(self) -> None:
        if self.regulates not in ("torque", "voltage"):
            raise TaskError(f"motor: regulates is {self.regulates!r}; it can be 'torque' or 'voltage'")
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            if field.name in ("regulates", "name") or value is None:
                continue
            self._check_number(field.name, value)
        if (self.torque_constant_nm_per_a is None) != (self.resistance_ohm is None):
            raise TaskError("motor: torque_constant_nm_per_a and resistance_ohm need each other")
        if self.voltage_v is not None and self.resistance_ohm is None:
            raise TaskError("motor: a limit of the voltage needs torque_constant_nm_per_a and resistance_ohm")
        if self.current_limit_a is not None and self.torque_constant_nm_per_a is None:
            raise TaskError("motor: a limit of the current needs torque_constant_nm_per_a and resistance_ohm")
        if self.regulates == "voltage" and self.voltage_v is None:
            raise TaskError("motor: a controller that regulates the voltage needs voltage_v")

    def _check_number(self, name: str, value: Any) -> None:
        is_number = isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
        if not is_number:
            raise TaskError(f"motor: {name} is {value!r}; give a finite number")
        if value < 0 and name != "encoder_bias_rad":
            raise TaskError(f"motor: {name} is {value:g}; it cannot be negative")
        if value == 0 and name in _POSITIVE:
            raise TaskError(f"motor: {name} is 0; leave it out if it is unknown or has no limit")

    @property
    def joint_constant_nm_per_a(self) -> float | None:
        """Torque at the joint per current, which is also the back-EMF per velocity of the joint [V s/rad]."""
        if self.torque_constant_nm_per_a is None:
            return None
        return self.torque_constant_nm_per_a * self.gear_ratio

    @property
    def stall_torque_nm(self) -> float | None:
        """Largest torque at standstill, by voltage, current and `max_torque_nm`; None: no limit is known."""
        limits = [self.max_torque_nm]
        constant = self.joint_constant_nm_per_a
        if constant is not None and self.resistance_ohm is not None:
            if self.voltage_v is not None:
                limits.append(constant * self.voltage_v / self.resistance_ohm)
            if self.current_limit_a is not None:
                limits.append(constant * self.current_limit_a)
        return min((limit for limit in limits if limit is not None), default=None)

    @property
    def no_load_speed_rad_per_s(self) -> float | None:
        """Speed at which the back-EMF is the supply's voltage, without friction; None: unknown."""
        constant = self.joint_constant_nm_per_a
        if constant is None or self.voltage_v is None:
            return None
        return self.voltage_v / constant

    @property
    def back_emf_damping_nms_per_rad(self) -> float:
        """What the back-EMF adds to the damping of a drive that regulates its voltage; 0 for others."""
        constant = self.joint_constant_nm_per_a
        if self.regulates != "voltage" or constant is None or self.resistance_ohm is None:
            return 0.0
        return constant**2 / self.resistance_ohm

    @property
    def position_gain(self) -> float | None:
        """The gain in the controller's own unit (P of a servo) that gives this stiffness; None: unknown."""
        per_gain = self._stiffness_per_gain
        if per_gain is None or self.stiffness_nm_per_rad is None:
            return None
        return float(f"{self.stiffness_nm_per_rad / per_gain:.9g}")  # a register of a servo is a whole number

    @property
    def _stiffness_per_gain(self) -> float | None:
        constant, duty = self.joint_constant_nm_per_a, self.duty_per_rad_and_gain
        if constant is None or self.resistance_ohm is None or self.voltage_v is None or duty is None:
            return None
        return constant * self.voltage_v / self.resistance_ohm * duty

    def at_gain(self, position_gain: float) -> Self:
        """Return this motor with another gain of its controller, in the controller's own unit (P of a servo)."""
        per_gain = self._stiffness_per_gain
        if per_gain is None:
            raise TaskError(f"motor {self.name!r}: the unit of its gain is unknown; set stiffness_nm_per_rad")
        return dataclasses.replace(self, stiffness_nm_per_rad=position_gain * per_gain)

    @classmethod
    def of_line(
        cls, *, voltage_v: float, stall_torque_nm: float, no_load_speed_rad_per_s: float, **values: Any
    ) -> Self:
        """Return a motor whose torque falls on a straight line from standstill to the no-load speed.

        Its constants are those that the line needs: they hold the losses of gears and friction too, so the friction of
        the joint must not count them again. `values` are other fields.
        """
        constant = voltage_v / no_load_speed_rad_per_s
        return cls(
            torque_constant_nm_per_a=constant,
            resistance_ohm=constant * voltage_v / stall_torque_nm,
            voltage_v=voltage_v,
            **values,
        )

    def with_values(self, changes: Mapping[str, Any]) -> Self:
        """Return this motor with some fields replaced; raises `TaskError` for a field that is not there."""
        names = [field.name for field in dataclasses.fields(self)]
        for name in changes:
            check_name(name, names, "a motor has no value", TaskError)
        return dataclasses.replace(self, **changes)


_POSITIVE = (
    "torque_constant_nm_per_a",
    "resistance_ohm",
    "voltage_v",
    "current_limit_a",
    "gear_ratio",
    "max_torque_nm",
    "duty_per_rad_and_gain",
)

AnyMotors = Motor | str | Sequence[Motor | str] | Mapping[str, Motor | str | Mapping[str, Any]]
"""A motor, or the name of one in the table, for all joints or one per joint, or by joint.

By joint it may also be a mapping of values by field, as `rlctl identify` writes them.
"""
