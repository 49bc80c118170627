"""Limits fitted to a policy: which elements of its observation and action they are about, and whether they can be."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from rlctl.deploy.bounds import Bounds
from rlctl.deploy.limits import Limits, check_names
from rlctl.deploy.observation import ObservationLayout
from rlctl.errors import RecipeError, UsageError
from rlctl.run.env_info import EnvInfo

Array = NDArray[np.float64]

_NO_CONTROL_DT = "limits: this policy does not say its control_dt; write control_dt: SECONDS"


@dataclasses.dataclass(frozen=True)
class FittedLimits:
    """What limits mean for one policy."""

    layout: ObservationLayout
    space: spaces.Space[Any]
    """The action space."""
    control_dt: float | None
    bounds: Bounds | None
    """None where actions are choices."""
    measured: slice | None
    """Where the joints' positions are in the flat observation."""
    home: Array | None
    safe: Array
    """The command that is given while holding or stopped, where it is a value."""


def fit_limits(limits: Limits, info: EnvInfo) -> FittedLimits:
    """Return what limits mean for a policy; raises `RecipeError` for limits that it cannot have."""
    layout = ObservationLayout(info)
    control_dt = limits.control_dt or info.control_dt
    _, space = info.spaces()
    count = math.prod(space.shape or ())
    bounds: Bounds | None = None
    if isinstance(space, spaces.Box):
        known = info.joints if info.joints is not None and len(info.joints.names) == count else None
        if limits.joints is not None and known is not None and limits.joints != list(known.names):
            check_names("joint", limits.joints, known.names, "limits: joints: ")
            raise RecipeError(f"limits: joints: the action's order is {', '.join(known.names)}")
        names = limits.joints or (list(known.names) if known else [f"action[{index}]" for index in range(count)])
        if len(names) != count or len(set(names)) != count:
            raise RecipeError(f"limits: joints: {len(set(names))} different names, the action has {count} elements")
        bounds = Bounds(limits, space, names, control_dt, known)
    elif limits.limits or limits.lowpass_hz:
        raise UsageError("limits: the actions of this policy are choices, not quantities that can be bounded")
    measured = _find_measured(limits, layout, count)
    home = _read_list(limits, "home", count)
    if (limits.lowpass_hz or limits.blend_in_s) and control_dt is None:
        raise RecipeError(_NO_CONTROL_DT)
    _check_home(limits, bounds, home)
    _check_measured(limits, bounds, measured, layout)
    safe = _make_safe_command(limits, bounds, count)
    return FittedLimits(layout, space, control_dt, bounds, measured, home, safe)


def _find_measured(limits: Limits, layout: ObservationLayout, count: int) -> slice | None:
    name = limits.measured.position
    if name is None:
        return None
    check_names("observation", [name], layout.slices, "limits: measured.position: ")
    place = layout.slices[name]
    if (size := place.stop - place.start) != count:
        raise RecipeError(f"limits: measured.position: {name} has {size} elements, the action has {count}")
    return place


def _read_list(limits: Limits, key: str, count: int) -> Array | None:
    values = getattr(limits, key)
    if values is not None and len(values) != count:
        raise RecipeError(f"limits: {key}: {len(values)} numbers, the action has {count} elements")
    return None if values is None else np.array(values, np.float64)


def _check_home(limits: Limits, bounds: Bounds | None, home: Array | None) -> None:
    if home is None:
        if limits.on_fault == "home":
            raise RecipeError("limits: on_fault: home: where that is must be said: home: [positions]")
        return
    if limits.command in ("torque", "action") or bounds is None:
        raise RecipeError(f"limits: home: actions that command {limits.command!r} cannot bring a robot to positions")
    if ((home < bounds.position[0]) | (home > bounds.position[1])).any():
        raise RecipeError("limits: home: it is outside the limits of position")


def _check_measured(limits: Limits, bounds: Bounds | None, measured: slice | None, layout: ObservationLayout) -> None:
    """Raise `RecipeError` where limits need the joints' positions and nothing says which observation has them."""
    if measured is not None or bounds is None:
        return
    moves = bounds.speed is not None or bounds.change is not None or limits.blend_in_s > 0
    if (limits.command == "position" and moves) or bounds.needs_position or limits.home is not None:
        raise RecipeError(
            "limits: these need to know where the joints are; write measured: {position: NAME} with the name of the "
            f"observation, one of {', '.join(layout.slices)}"
        )


def _make_safe_command(limits: Limits, bounds: Bounds | None, count: int) -> Array:
    safe = _read_list(limits, "safe_action", count)
    if safe is not None and limits.command not in ("torque", "action"):
        raise RecipeError("limits: safe_action: of positions, steps and speeds it is to keep still; leave it out")
    if bounds is None:
        return np.zeros(count)
    wanted = bounds.offset + (np.zeros(count) if safe is None else safe) * bounds.factor
    clipped: Array = np.clip(wanted, bounds.low, bounds.high)
    if safe is not None and not np.allclose(clipped, wanted):
        raise RecipeError("limits: safe_action: it is outside the limits of the action")
    return clipped
