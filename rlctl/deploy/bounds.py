"""The arithmetic of limits: what a command may be next, so that every limit holds now and can hold later."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from rlctl.deploy.limits import JointLimits, Limits, check_names
from rlctl.errors import RecipeError, UsageError
from rlctl.joints import Joints

Array = NDArray[np.float64]
Report = Callable[[str, Array, Array, tuple[Array, Array]], None]
"""Called with the name of a limit, the wanted values, the allowed ones and the two ends, where they differ."""

_FITTING = {
    "position": ("position", "speed", "acceleration", "action"),
    "step": ("position", "speed", "acceleration", "action"),
    "speed": ("position", "speed", "acceleration", "action"),
    "torque": ("torque", "rate", "action"),
    "action": ("rate", "action"),
}


class Bounds:
    """The limits of a policy's actions as arrays, an element per joint.

    A command is a value (positions, torques, plain actions) or a change of a measured position (steps, speeds). Both
    move by `x` in a control step; the arrays bound `x`, its change, and where it leads.
    """

    def __init__(
        self, limits: Limits, space: spaces.Box, names: list[str], control_dt: float | None, known: Joints | None = None
    ) -> None:
        self.names = names
        given = [name for name in limits.limits if name != "all"]
        named = limits.joints is not None or known is not None
        hint = "" if named else " This policy does not name them: write joints: [names, in the action's order]."
        check_names("joint", given, names, "limits: ", hint)
        each = [_merge(limits, name, _list_known(limits, known, index)) for index, name in enumerate(names)]
        for joint, name in zip(each, names, strict=True):
            _check_fitting(limits, joint, name)
        timed = limits.command == "speed" or any(joint.speed or joint.acceleration or joint.rate for joint in each)
        if timed and control_dt is None:
            raise RecipeError("limits: this policy does not say its control_dt; write control_dt: SECONDS")
        self.dt = dt = control_dt or 1.0
        """[s]"""
        self.is_value = limits.command in ("position", "torque", "action")
        scale, offset = _choose_units(limits, known, names)
        if not self.is_value and offset.any():
            raise RecipeError(f"limits: offset: with command: {limits.command} action 0 is to keep still; leave it out")
        self.offset = offset
        """What action 0 is in the unit of a value."""
        self.factor = scale * (dt if limits.command == "speed" else 1.0)
        """What 1 of the action is in the unit of `x`."""
        low = offset + self.factor * np.maximum(space.low.ravel(), _gather(each, "action", -np.inf, 0))
        high = offset + self.factor * np.minimum(space.high.ravel(), _gather(each, "action", np.inf, 1))
        position = np.array([_gather(each, "position", -np.inf, 0), _gather(each, "position", np.inf, 1)])
        speed = np.array([joint.speed or joint.rate or np.inf for joint in each]) * dt
        if self.is_value:
            torque = np.array([joint.torque or np.inf for joint in each])
            low = np.maximum(np.maximum(low, position[0]), -torque)
            high = np.minimum(np.minimum(high, position[1]), torque)
            position = np.array([low, high])
        elif ((low > 0) | (high < 0)).any():
            raise UsageError("limits: an action of this policy cannot stand still: its bounds exclude zero")
        if (low > high).any():
            name = names[int(np.argmax(low > high))]
            raise RecipeError(f"limits: {name}: no action keeps these limits and the policy's own action bounds")
        self.low, self.high = low, high
        """Bounds of the command: of a value, or of `x`."""
        self.position = position
        """Bounds of where `x` leads, shape (2, count)."""
        self.needs_position = not self.is_value and bool(np.isfinite(position).any())
        self.bounds_position = bool(np.isfinite(position).any())
        self.speed = speed if np.isfinite(speed).any() else None
        change = np.array([joint.acceleration or np.inf for joint in each]) * dt**2
        self.change = change if np.isfinite(change).any() else None
        """Largest change of `x` from one control step to the next."""
        self.value_name = {"position": "position", "torque": "torque"}.get(limits.command, "action")
        self.speed_name = "speed" if limits.command in ("position", "step", "speed") else "rate"
        self._ends = np.array([self.high, -self.low]) if self.is_value else np.array([position[1], -position[0]])
        self._prepare_quick_check(speed, change)

    def _prepare_quick_check(self, speed: Array, change: Array) -> None:
        self._most = speed if self.is_value else np.minimum(speed, self.high)
        self._least = -speed if self.is_value else np.maximum(-speed, self.low)
        limited = np.isfinite(change)
        s = np.where(limited, change, 1.0)
        # To brake from x takes at most x (x / (2 s) + 1 / 2) + s / 8: the sum in `_find_room` is below it.
        self._per_square, self._per_step = np.where(limited, 0.5 / s, 0.0), np.where(limited, 0.5, 1.0)
        margin = np.where(limited, s / 8.0, 0.0)
        self._quick_low, self._quick_high = -self._ends[1] + margin, self._ends[0] - margin

    def bound(self, x: Array, before: Array, reference: Array | None, report: Report) -> Array:
        """Return the motion closest to `x` that keeps the limits.

        `before` is the motion of the last step, `reference` where it led; None if positions are not bounded.
        """
        return x if self._keeps_all(x, before, reference) else self._bound_in_turn(x, before, reference, report)

    def keeps_ends(self, value: Array) -> bool:
        """Say whether a value is within its bounds."""
        # To compare bytes takes a tenth of the time of `(a != b).any()`.
        return np.minimum(np.maximum(value, self.low), self.high).tobytes() == value.tobytes()

    def _keeps_all(self, x: Array, before: Array, reference: Array | None) -> bool:
        """Say whether a motion clearly keeps all limits, in as few operations as it takes: most motions do."""
        low, high = self._least, self._most
        if self.change is not None:
            low, high = np.maximum(low, before - self.change), np.minimum(high, before + self.change)
        if np.minimum(np.maximum(x, low), high).tobytes() != x.tobytes():
            return False
        return not self.bounds_position or reference is None or self._keeps_position(x, reference)

    def _keeps_position(self, x: Array, reference: Array) -> bool:
        """Say whether there is clearly room to brake after a motion."""
        end = x if self.change is None else x * (np.abs(x) * self._per_square + self._per_step)
        end = end + reference
        inside = np.minimum(np.maximum(end, self._quick_low), self._quick_high)
        return bool(inside.tobytes() == end.tobytes())

    def _bound_in_turn(self, x: Array, before: Array, reference: Array | None, report: Report) -> Array:
        """Apply one limit after the other: what is stricter first, what is more important last."""
        if self.change is not None:
            x = _clip(x, before - self.change, before + self.change, "acceleration", report)
        if self.speed is not None:
            x = _clip(x, -self.speed, self.speed, self.speed_name, report)
        if not self.is_value:
            x = _clip(x, self.low, self.high, "action", report)
        if self.bounds_position and reference is not None and not self._keeps_position(x, reference):
            room = self._find_room(reference)
            x = _clip(x, -room[1], room[0], self.value_name if self.is_value else "position", report)
        return x

    def _find_room(self, reference: Array) -> Array:
        """Return how far a step may go up and down, shape (2, count).

        After it there must be room to brake: with motions x, x - s, x - 2 s, ... that a change of at most s allows. Of
        n motions the sum is n x - s n (n - 1) / 2; it must not exceed the distance d to the bound, with the n for which
        (n - 1) s <= x <= n s.
        """
        distance = self._ends.copy()
        distance[0] -= reference
        distance[1] += reference
        np.maximum(distance, 0.0, out=distance)
        if self.change is None:
            return distance
        s = self.change
        with np.errstate(invalid="ignore", over="ignore"):
            n = np.ceil((np.sqrt(1.0 + 8.0 * distance / s) - 1.0) * 0.5)
            np.maximum(n, 1.0, out=n)
            room = distance / n + 0.5 * s * (n - 1.0)
        # No bound on the change, or none on the position.
        return np.where(np.isfinite(room), room, distance)


def _clip(x: Array, low: Array, high: Array, name: str, report: Report) -> Array:
    allowed: Array = np.minimum(np.maximum(x, low), high)
    if allowed.tobytes() != x.tobytes():
        report(name, x, allowed, (low, high))
    return allowed


def _merge(limits: Limits, name: str, known: dict[str, Any]) -> JointLimits:
    own = limits.limits.get(name, JointLimits())
    every = limits.limits.get("all", JointLimits())
    given = {**every.model_dump(exclude_none=True), **own.model_dump(exclude_none=True)}
    return JointLimits(**{**known, **given})


def _list_known(limits: Limits, joints: Joints | None, index: int) -> dict[str, Any]:
    """Return the limits of one joint that the task's model of the robot has, as far as they can be kept."""
    found: dict[str, Any] = {}
    if joints is None:
        return found
    measured = limits.measured.position is not None
    moves = limits.command in ("position", "step", "speed")
    if joints.low and joints.high and (limits.command == "position" or (moves and measured)):
        found["position"] = joints.low[index], joints.high[index]
    if joints.max_speed and moves and measured:
        found["speed"] = joints.max_speed[index]
    if joints.max_torque and limits.command == "torque":
        found["torque"] = joints.max_torque[index]
    return found


def _check_fitting(limits: Limits, joint: JointLimits, name: str) -> None:
    for key in joint.model_fields_set:
        if key not in _FITTING[limits.command]:
            can = ", ".join(_FITTING[limits.command])
            raise RecipeError(
                f"limits: {name}.{key}: with command: {limits.command} only {can} can be limited; "
                "say with command: what an action is, or watch a measured value with sensors:"
            )


def _choose_units(limits: Limits, known: Joints | None, names: list[str]) -> tuple[Array, Array]:
    """Return scale and offset of the command, per joint."""
    scale: Any = 1.0
    offset: Any = 0.0
    if known is not None and known.action_scale and limits.command == "position":
        scale, offset = known.action_scale, known.default_positions or 0.0
    return _spread("scale", limits.scale, scale, names), _spread("offset", limits.offset, offset, names)


def _spread(key: str, given: Any, default: Any, names: list[str]) -> Array:
    """Return a number per joint: what was given, or the default."""
    values = np.atleast_1d(np.asarray(default if given is None else given, np.float64))
    if len(values) not in (1, len(names)):
        raise RecipeError(f"limits: {key} has {len(values)} numbers, the action {len(names)}")
    return np.broadcast_to(values, (len(names),)).copy()


def _gather(joints: list[JointLimits], key: str, default: float, end: int) -> Array:
    return np.array([default if (bounds := getattr(joint, key)) is None else bounds[end] for joint in joints])
