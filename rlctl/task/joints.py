"""`Joints`: the joints that an action moves, as plain data for controllers of real robots."""

import dataclasses
import math
from collections.abc import Sequence
from typing import Any, Literal

import numpy as np
from gymnasium import spaces

from rlctl.errors import TaskError, check_name, short_repr

CommandKind = Literal["", "position", "step", "correction", "speed", "torque"]
WIDEST_RANGE = 1e3  # wider limits are none: some models write 1e16

_KINDS: dict[CommandKind, str] = {
    "position": "scale",
    "step": "step",
    "correction": "correction",
    "speed": "speed",
    "torque": "torque",
}


@dataclasses.dataclass(frozen=True)
class Joints:
    """Joints in the order of the action's elements; every other field has one element per joint, or is empty.

    A single number, which becomes one element per joint, is that of all joints.

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
    action_step: Sequence[float] = ()  # only if the target is what `measured` has, plus `action_step * action`
    action_correction: Sequence[float] = ()  # only if the target is what `reference` has, plus this times the action
    action_speed: Sequence[float] = ()  # only if the target is a speed, `action_speed * action` [rad/s or m/s]
    action_torque: Sequence[float] = ()  # only if the target is a torque or force, `action_torque * action`
    measured: str = ""  # observation, or quantity of a term, with the positions or last targets of these joints
    drive_gain: Sequence[float] = ()  # that stiffness in the drive's own unit: P of a servo, as it is written into it
    drive_voltage: Sequence[float] = ()  # [V], at which a servo of that gain has this stiffness
    reference: str = ""  # observation that is a `Playback` without a quantity: the targets of action 0, of a clip
    clips_target: bool = False  # whether a position that an action commands is clipped to `low` and `high`

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self)[1:]:
            if field.default != ():
                continue
            given = getattr(self, field.name)
            if isinstance(given, str) or np.ndim(given) > 1:
                raise TaskError(f"joints: {field.name} is {given!r:.40}; give a number, or one per joint")
            spread = [given] * len(self.names) if np.ndim(given) == 0 else given
            values = [float(value) for value in spread]
            if values and (len(values) != len(self.names) or not all(map(math.isfinite, values))):
                raise TaskError(
                    f"joints: {field.name} must have {len(self.names)} finite values, one per joint, but is "
                    f"{list(values)}; leave it out if a value is unknown"
                )
            object.__setattr__(self, field.name, tuple(values))
        if odd := [name for name in self.names if not isinstance(name, str)]:
            raise TaskError(f"joints: names must be text, not {odd[0]!r}")
        object.__setattr__(self, "names", tuple(self.names))
        commands = [f"action_{kind}" for kind in _KINDS.values() if getattr(self, f"action_{kind}")]
        if len(commands) > 1:
            raise TaskError(f"joints: {' and '.join(commands)} exclude each other: an action commands one thing")
        if self.action_step and not self.measured:
            raise TaskError(
                "joints: action_step needs measured: the observation with the joints' positions or last targets"
            )
        if bool(self.action_correction) != bool(self.reference):
            raise TaskError(
                "joints: action_correction and reference, the observation that it corrects, need each other"
            )
        if self.clips_target and not (self.low and self.high):
            raise TaskError("joints: clips_target needs low and high")

    @property
    def command(self) -> tuple[CommandKind, Sequence[float]]:
        """What an action commands, and how much per 1 of the action and joint; ("", ()) if that is not known."""
        for command, kind in _KINDS.items():
            if per_action := getattr(self, f"action_{kind}"):
                return command, per_action
        return "", ()


def check_joints(task: str, joints: Any, action_space: spaces.Space[Any], observed: Sequence[str]) -> None:
    """Raise `TaskError` for what `describe_joints` returned, unless it has a joint per element of the action.

    `observed` are the names of observations and of the quantities of terms.
    """
    count = math.prod(action_space.shape or ())
    if joints is not None and (not isinstance(joints, Joints) or len(joints.names) != count):
        given = list(joints.names) if isinstance(joints, Joints) else joints
        raise TaskError(
            f"{task}: describe_joints() returned {short_repr(given)}; "
            f"return body.describe_joints(names) with {count} names, one per element of the action"
        )
    if joints is not None and joints.measured:
        check_name(joints.measured, observed, f"{task}: joints: no observation", TaskError)
    if joints is not None and joints.reference:
        check_name(joints.reference, observed, f"{task}: joints: no observation", TaskError)
