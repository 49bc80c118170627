"""Limits as arrays for one policy: joints by index, units of its commands, and a check that it can keep them."""

import dataclasses
import math
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from rlctl.environments.info import EnvInfo
from rlctl.errors import RecipeError, UsageError, check_name
from rlctl.limits.bounds import Bounds
from rlctl.limits.defaults import fill_in, find_positions
from rlctl.limits.limits import JointLimits, Limits
from rlctl.limits.observation import MeasuredPositions, ObservationReader, SensorChecks
from rlctl.limits.steps import Steps, bound_targets
from rlctl.task.joints import Joints
from rlctl.task.terms import Scaled

Array = NDArray[np.float64]

_MOVING = ("position", "step", "speed")  # commands that move joints to positions
_CAN_BE_LIMITED = {
    **dict.fromkeys(_MOVING, ("position", "speed", "acceleration", "action")),
    "torque": ("torque", "rate", "action"),
    "action": ("rate", "action"),
}
_SMALLEST = 1e-100  # step [unit of the command]; squares of smaller ones become 0
_NO_CONTROL_DT = "limits: this policy has no control_dt; write control_dt: SECONDS"


@dataclasses.dataclass(frozen=True)
class FittedLimits:
    """The limits of one policy, as arrays."""

    limits: Limits  # with what the policy knows in place of what they leave out
    reader: ObservationReader
    space: spaces.Space[Any]  # the action space
    control_dt: float | None
    steps: Steps | None  # steps that are bounded as targets
    bounds: Bounds | None  # None where actions are choices
    measured: MeasuredPositions | None
    sensors: SensorChecks
    home: Array | None
    safe: Array  # the command while holding or stopped, if commands are values


def fit_limits(limits: Limits, info: EnvInfo) -> FittedLimits:
    """Convert limits to arrays for a policy; raises `RecipeError` for limits that do not fit it."""
    try:
        return _fit_limits(limits, info)
    except (RecipeError, UsageError) as error:
        if limits.file is None:
            raise
        raise type(error)(f"{limits.file}: {error}") from None


@np.errstate(over="ignore", invalid="ignore")  # a later check refuses such numbers
def _fit_limits(limits: Limits, info: EnvInfo) -> FittedLimits:
    reader = ObservationReader(info)
    limits = fill_in(limits, info, reader)
    control_dt = limits.control_dt or info.control_dt
    if control_dt is not None and not 1e-9 <= control_dt <= 1e9:
        raise RecipeError(f"limits: control_dt is {control_dt:g} s; it must be from 1e-9 to 1e9 s")
    _, space = info.spaces()
    count = math.prod(space.shape or ())
    bounds: Bounds | None = None
    steps = None
    measured = _find_measured(limits.measured.position, reader, info, count)
    if isinstance(space, spaces.Box):
        known = info.joints if info.joints is not None and len(info.joints.names) == count else None
        if limits.joints is not None and known is not None and limits.joints != list(known.names):
            for name in limits.joints:
                check_name(name, known.names, "limits: joints: no joint", RecipeError, listed="Known")
            raise RecipeError(f"limits: joints: write them in the action's order: {', '.join(known.names)}")
        names = limits.joints or (list(known.names) if known else [f"action[{index}]" for index in range(count)])
        if len(names) != count or len(set(names)) != count:
            raise RecipeError(f"limits: joints: {len(set(names))} different names, the action has {count} elements")
        bounds = _make_bounds(limits, space, names, control_dt, known)
        bounds, steps = bound_targets(bounds, space) if measured and limits.kind == "step" else (bounds, None)
    elif limits.limits or limits.lowpass_hz:
        raise UsageError(
            "limits: the actions of this policy are discrete choices; only continuous actions can be limited"
        )
    home = _read_list(limits, "home", count)
    if (limits.lowpass_hz or limits.blend_in_s) and control_dt is None:
        raise RecipeError(_NO_CONTROL_DT)
    _check_home(limits, bounds, home)
    _check_measured(limits, bounds, measured, reader)
    safe = _make_safe_command(limits, bounds, count)
    positions = measured or _find_measured(find_positions(info, reader), reader, info, count)
    sensors = SensorChecks(limits, reader.layout, control_dt, info, positions)
    return FittedLimits(limits, reader, space, control_dt, steps, bounds, measured, sensors, home, safe)


def _make_bounds(
    limits: Limits, space: spaces.Box, names: list[str], control_dt: float | None, known: Joints | None
) -> Bounds:
    named = limits.joints is not None or known is not None
    listed = "Known" if named else "Write joints: [names, in the action's order], or one of"
    for name in limits.limits.keys() - {"all"}:
        check_name(name, names, "limits: no joint", RecipeError, listed=listed)
    joints = [_merge(limits, name, _list_known(limits, known, index)) for index, name in enumerate(names)]
    for joint, name in zip(joints, names, strict=True):
        _check_can_be_limited(limits, joint, name)
    timed = limits.kind == "speed" or any(joint.speed or joint.acceleration or joint.rate for joint in joints)
    if timed and control_dt is None:
        raise RecipeError(_NO_CONTROL_DT)
    dt, is_value, moves = control_dt or 1.0, limits.kind not in ("step", "speed"), limits.kind in _MOVING
    scale, offset = _choose_units(limits, space, known, names)
    if not is_value and offset.any():
        raise RecipeError(f"limits: offset: leave it out; with command: {limits.kind}, action 0 means no motion")
    factor = scale * (dt if limits.kind == "speed" else 1.0)
    largest, digits = _describe_numbers(space.dtype)
    low = np.maximum(np.maximum(space.low.ravel(), -largest), _gather(joints, "action", -np.inf, 0))
    high = np.minimum(np.minimum(space.high.ravel(), largest), _gather(joints, "action", np.inf, 1))
    low, high = offset + factor * low, offset + factor * high
    position = np.array([_gather(joints, "position", -np.inf, 0), _gather(joints, "position", np.inf, 1)])
    if is_value:
        torque = np.array([joint.torque or np.inf for joint in joints])
        low = np.maximum(np.maximum(low, position[0]), -torque)
        high = np.minimum(np.minimum(high, position[1]), torque)
    if space.dtype.kind != "f":  # the outermost whole actions within the limits
        low = offset + factor * np.ceil((low - offset) / factor * (1 - digits))
        high = offset + factor * np.floor((high - offset) / factor * (1 + digits))
    if is_value:
        position = np.array([low, high])
    elif ((low > 0) | (high < 0)).any():
        raise UsageError("limits: the action bounds of this policy exclude zero, so the robot could not stand still")
    if (low > high).any():
        name = names[int(np.argmax(low > high))]
        raise RecipeError(f"limits: {name}: no action keeps these limits and the policy's own action bounds")
    speed = np.array([joint.speed or joint.rate or np.inf for joint in joints]) * dt
    change = np.array([joint.acceleration or np.inf for joint in joints]) * dt**2
    if space.dtype.kind != "f" and (slow := np.minimum(speed, change) < factor).any():
        name = names[int(np.argmax(slow))]
        raise RecipeError(f"limits: {name}: the smallest whole action is faster than the limits allow")
    if not (np.isfinite([low, high]).all() and min(factor.min(), speed.min(), change.min()) > _SMALLEST):
        raise RecipeError("limits: scale, offset, a limit or control_dt is too large or too small to calculate with")
    if (factor < np.abs(offset) * 2e-9).any():  # next to the offset, float64 rounds it to less than float32's precision
        raise RecipeError("limits: scale is too small next to offset: the actions of the robot would be rounded")
    return Bounds(
        names,
        dt,
        is_value,
        factor,
        offset,
        low,
        high,
        position,
        _drop_infinite(speed),
        _drop_infinite(change),
        precision=8.0 * digits,
        resolution=factor * digits,
        position_name="position" if moves else limits.kind,
        speed_name="speed" if moves else "rate",
    )


def _describe_numbers(dtype: Any) -> tuple[float, float]:
    """Return the largest action, with which differences stay finite, and the relative precision of its type."""
    if np.dtype(dtype).kind == "f":
        return min(float(np.finfo(dtype).max), 1e30), float(np.finfo(dtype).eps)
    return min(float(np.iinfo(dtype).max), 2.0**53), float(np.finfo(np.float64).eps)


def _drop_infinite(values: Array) -> Array | None:
    return values if np.isfinite(values).any() else None


def _merge(limits: Limits, name: str, known: dict[str, Any]) -> JointLimits:
    merged = dict(known)
    for key in ("all", name):
        if key in limits.limits:
            merged |= limits.limits[key].model_dump(exclude_none=True)
    if "position" in known:
        (low, high), (least, most) = merged["position"], known["position"]
        merged["position"] = max(low, least), min(high, most)
        own = limits.limits.get(name, JointLimits()).position is not None
        wider = not np.allclose((low, high), np.clip((low, high), least, most), rtol=0.01)  # it may be rounded
        if (own and wider) or max(low, least) >= min(high, most):
            raise RecipeError(
                f"limits: {name}.position: {low:g} to {high:g} is not within the robot model's {least:g} to {most:g}; "
                "positions are in rad or m"
            )
    return JointLimits(**merged)


def _list_known(limits: Limits, joints: Joints | None, index: int) -> dict[str, Any]:
    """Return one joint's limits in the task's robot model, as far as the filter can keep them."""
    # Model files write a missing limit as 0, or as a lower end that is not below the upper end.
    known: dict[str, Any] = {}
    if joints is None:
        return known
    measured, moves = limits.measured.position is not None, limits.kind in _MOVING
    if joints.low and joints.high and (limits.kind == "position" or (moves and measured)):
        low, high = joints.low[index], joints.high[index]
        known |= {"position": (low, high)} if low < high else {}
    if joints.max_speed and moves and measured:
        known |= {"speed": speed} if (speed := joints.max_speed[index]) > 0 else {}
    if joints.max_torque and limits.kind == "torque":
        known |= {"torque": torque} if (torque := joints.max_torque[index]) > 0 else {}
    return known


def _check_can_be_limited(limits: Limits, joint: JointLimits, name: str) -> None:
    for key in joint.model_fields_set:
        if key not in _CAN_BE_LIMITED[limits.kind]:
            can = ", ".join(_CAN_BE_LIMITED[limits.kind])
            raise RecipeError(
                f"limits: {name}.{key}: with command: {limits.kind} only {can} can be limited; "
                "set command: to what an action is, or check a measured value with sensors:"
            )


def _choose_units(limits: Limits, space: spaces.Box, known: Joints | None, names: list[str]) -> tuple[Array, Array]:
    scale: Any = 1.0
    offset: Any = 0.0
    if known is not None and known.command[0] == limits.kind:
        scale = known.command[1]
        offset = (known.default_positions or 0.0) if limits.kind == "position" else 0.0
    elif limits.scale is None and limits.kind != "action" and (space.low == -1).all() and (space.high == 1).all():
        raise RecipeError(
            f"limits: scale: required when actions range from -1 to 1; write scale: NUMBER, the {limits.kind} of "
            "action 1 in rad, rad/s or N m; 1 if actions are in that unit"
        )
    return _spread("scale", limits.scale, scale, names), _spread("offset", limits.offset, offset, names)


def _spread(key: str, numbers: Any, default: Any, names: list[str]) -> Array:
    values = np.atleast_1d(np.asarray(default if numbers is None else numbers, np.float64))
    if len(values) not in (1, len(names)):
        raise RecipeError(f"limits: {key} has {len(values)} numbers, the action {len(names)}")
    return np.broadcast_to(values, (len(names),)).copy()


def _gather(joints: list[JointLimits], key: str, default: float, end: int) -> Array:
    return np.array([default if (ends := getattr(joint, key)) is None else ends[end] for joint in joints])


def _find_measured(name: str | None, reader: ObservationReader, info: EnvInfo, count: int) -> MeasuredPositions | None:
    if name is None:
        return None
    check_name(name, reader.layout.columns, "limits: measured.position: no observation", RecipeError, listed="Known")
    part = reader.layout.columns[name]
    if (size := part.stop - part.start) != count:
        raise RecipeError(f"limits: measured.position: {name} has {size} elements, the action has {count}")
    term = info.observation_terms.get(name)
    if term is None:
        return MeasuredPositions(part)
    if not isinstance(term, Scaled) or 0.0 in term.scale:
        raise RecipeError(f"limits: measured.position: {name} is computed; positions cannot be read from it")
    scale, offset = (np.array(numbers) if numbers else None for numbers in (term.scale, term.offset))
    return MeasuredPositions(part, scale, offset)


def _read_list(limits: Limits, key: str, count: int) -> Array | None:
    values = getattr(limits, key)
    if values is not None and len(values) != count:
        raise RecipeError(f"limits: {key}: {len(values)} numbers, the action has {count} elements")
    return None if values is None else np.array(values, np.float64)


def _check_home(limits: Limits, bounds: Bounds | None, home: Array | None) -> None:
    if home is None:
        if limits.on_fault == "home":
            raise RecipeError("limits: on_fault: home: it needs the home position; write home: [positions]")
        return
    if limits.kind not in _MOVING or bounds is None:
        raise RecipeError(f"limits: home: actions that command {limits.kind!r} cannot bring a robot to positions")
    if ((home < bounds.position[0]) | (home > bounds.position[1])).any():
        raise RecipeError("limits: home: outside the position limits")


def _check_measured(
    limits: Limits, bounds: Bounds | None, measured: MeasuredPositions | None, reader: ObservationReader
) -> None:
    if measured is not None or bounds is None:
        return
    moves = bounds.speed is not None or bounds.change is not None or limits.blend_in_s > 0
    needs_start = limits.kind == "position" and moves
    if needs_start or (not bounds.is_value and bounds.bounds_position) or limits.home is not None:
        raise RecipeError(
            "limits: these limits need the positions of the joints; write measured: {position: NAME} "
            f"with the name of the observation, one of {', '.join(reader.layout.columns)}"
        )


def _make_safe_command(limits: Limits, bounds: Bounds | None, count: int) -> Array:
    safe = _read_list(limits, "safe_action", count)
    if safe is not None and limits.kind in _MOVING:
        raise RecipeError(f"limits: safe_action: leave it out; with command: {limits.kind}, it means no motion")
    if bounds is None:
        return np.zeros(count)
    command = bounds.offset + (np.zeros(count) if safe is None else safe) * bounds.factor
    clipped: Array = np.clip(command, bounds.low, bounds.high)
    if safe is not None and not np.allclose(clipped, command):
        raise RecipeError("limits: safe_action: outside the action's limits")
    return clipped
