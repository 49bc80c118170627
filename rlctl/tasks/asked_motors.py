"""The real motors of a starter plugin: a name of the table of motors, a backlash, and the events that vary them."""

from __future__ import annotations

import dataclasses
import math
import re
from collections.abc import Mapping
from typing import Self

from rlctl.errors import UsageError, check_name
from rlctl.task.motors import Motor
from rlctl.task.named_motors import TABLE, find_motor
from rlctl.tasks.source_text import SourceText, write_comment, write_number, write_string

_ANGLE = re.compile(r"\s*([0-9.eE+-]+)\s*(deg|rad)\s*")
_LARGEST = math.radians(20.0)
"""Play beyond which a typing mistake is more likely than a gear."""
_VOLTAGES, _CONSTANTS, _FRICTIONS, _PLAYS = (0.85, 1.05), (0.9, 1.1), (0.5, 2.0), (0.0, 1.5)  # of the motor's own
_BIAS = 0.02  # [rad]
_OF_JOINTS = ("torque_constant", "motor_friction", "backlash")  # events that draw a number per joint that has no sign


@dataclasses.dataclass(frozen=True)
class AskedMotors:
    """What `--motors` and `--backlash` ask for."""

    name: str
    backlash_rad: float = 0.0

    @classmethod
    def read(cls, name: str | None, backlash: str | None) -> Self | None:
        """Read the two options; raises `UsageError` for a name or an angle that cannot be."""
        if name is None:
            if backlash is not None:
                raise UsageError("--backlash needs --motors")
            return None
        check_name(name, TABLE, "--motors: no motor", UsageError)
        return cls(name, 0.0 if backlash is None else _read_angle(backlash))

    @property
    def motor(self) -> Motor:
        """The motor of the table."""
        return find_motor(self.name)

    def list_missing(self, guesses: Mapping[str, float]) -> dict[str, float]:
        """Return values that the table does not have, of `guesses` by field, and the backlash."""
        motor = self.motor
        missing = [name for name in guesses if getattr(motor, name) is None]
        if motor.stiffness_nm_per_rad is None:
            missing.append("damping_nms_per_rad")  # which is part of the same choice
        values = {name: guesses[name] for name in missing}
        if self.backlash_rad:
            values["backlash_rad"] = float(f"{self.backlash_rad:.3g}")
        return values

    def complete(self, guesses: Mapping[str, float]) -> Motor:
        """Return the motor as the plugin sets it."""
        return self.motor.with_values(self.list_missing(guesses))

    def write(self, guesses: Mapping[str, float], body: str, joints: str = "") -> dict[str, str]:
        """Return texts for the placeholders `motor*` of the templates.

        `body` is the name of the robot's body; `joints` names those with these motors in the events' source text.
        """
        values = self.list_missing(guesses)
        entry, items = TABLE[self.name], [f'"{name}": {write_number(value, "g")}' for name, value in values.items()]
        unknown = [name for name in values if name != "backlash_rad"]
        guessed = f"; CHANGE: guesses are {', '.join(unknown)}" if unknown else ""
        events = self._list_events(values, body, joints)
        return {
            "motor": write_string(self.name),
            "motor_comment": write_comment(f"From: {entry.source} ({entry.kind}). {entry.unknown}{guessed}."),
            "motor_values": SourceText(f"{{{', '.join(items)}}}"),
            "motor_events": SourceText("\n".join(f"        {line}" for line in events.values())),
            "motor_factors": SourceText(", ".join(f'"events/{name}"' for name in _OF_JOINTS if name in events)),
        }

    def _list_events(self, values: Mapping[str, float], body: str, joints: str) -> dict[str, str]:
        """Return the source text of each event, whose range grows from the motor's value with a stage's level."""
        motor, play = self.motor, values.get("backlash_rad", 0.0)
        ranges = {
            "torque_constant": ("factor", 1.0, _CONSTANTS),
            "voltage": ("voltage_v", motor.voltage_v, _VOLTAGES),
            "motor_friction": ("coulomb_nm", motor.coulomb_friction_nm, _FRICTIONS),
            "backlash": ("backlash_rad", play or None, _PLAYS),
        }
        texts = {"motor_bias": f'bias_rad={{"from": (0, 0), "to": (-{_BIAS}, {_BIAS})}}'}
        for name, (key, value, factors) in ranges.items():
            if value is not None:
                own, low, high = (write_number(float(f"{factor * value:.3g}"), "g") for factor in (1.0, *factors))
                texts[name] = f'{key}={{"from": ({own}, {own}), "to": ({low}, {high})}}'
        where = f'body="{body}"' + (f", joints={joints}" if joints else "")
        return {name: f'"{name}": Event("reset", events.{name}, {where}, {text}),' for name, text in texts.items()}


def _read_angle(text: str) -> float:
    """Return an angle [rad]; raises `UsageError` unless it is a number with its unit."""
    match = _ANGLE.fullmatch(text)
    try:
        value = float(match[1]) if match else math.nan
    except ValueError:
        value = math.nan
    if match is None or not math.isfinite(value):
        raise UsageError(f"--backlash {text!r}: give an angle with its unit, such as 1deg or 0.02rad")
    angle = math.radians(value) if match[2] == "deg" else value
    if not 0 <= angle <= _LARGEST:
        raise UsageError(f"--backlash {text!r}: it is from end to end, from 0 to {math.degrees(_LARGEST):g}deg")
    return angle
