"""The joints that the elements of an action drive, of an environment that MuJoCo simulates.

`ctrl` is in the order of the model's actuators; a `step` may reorder its action, so the order is measured.
"""

from __future__ import annotations

import contextlib
import copy
import dataclasses
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any

import gymnasium
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from rlctl.task.joints import Joints

if TYPE_CHECKING:
    import mujoco

_STEPS = 3  # an action may act some steps later
_PER_JOINT = ("names", "low", "high", "max_torque")
_DRAWING = (
    *("gymnasium.envs.mujoco.mujoco_rendering", "mujoco.renderer", "mujoco.viewer", "mujoco.gl_context"),
    *("mujoco.egl", "mujoco.glfw", "mujoco.osmesa", "glfw", "pygame"),
)
"""Modules of renderers and windows."""
Array = NDArray[np.float64]


def describe_driven_joints(env: gymnasium.Env[Any, Any], model: mujoco.MjModel) -> Joints | None:
    """Describe the joints in the order of the action's elements.

    None if an actuator moves something else than a joint, or the elements do not drive one actuator each.
    """
    joints = _describe_actuators(model) if int(np.prod(env.action_space.shape or ())) == model.nu else None
    order = measure_order(env) if joints is not None else None
    if joints is None or order is None:
        return None
    values = {name: getattr(joints, name) for name in _PER_JOINT}
    reordered: dict[str, Any] = {name: [v[i] for i in order] if v else () for name, v in values.items()}
    return dataclasses.replace(joints, **reordered)


def _describe_actuators(model: mujoco.MjModel) -> Joints | None:
    """Describe the joints that the actuators move, in their order; None if one moves something else."""
    import mujoco

    joint_kind, no_bias = int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtBias.mjBIAS_NONE)
    if not model.nu or any(int(kind) != joint_kind for kind in model.actuator_trntype):
        return None
    moved = model.actuator_trnid[:, 0]
    ranges, limited = model.jnt_range[moved], model.jnt_limited[moved].astype(bool).all()
    gains = np.abs(model.actuator_gainprm[:, 0] * model.actuator_gear[:, 0])
    strengths = gains * np.abs(model.actuator_ctrlrange).max(axis=1)
    motors = all(int(kind) == no_bias for kind in model.actuator_biastype) and model.actuator_ctrllimited.all()
    return Joints(
        names=[joint_name(model, joint) for joint in moved],
        low=ranges[:, 0].tolist() if limited else (),
        high=ranges[:, 1].tolist() if limited else (),
        max_torque=strengths.tolist() if motors else (),
    )


def joint_name(model: mujoco.MjModel, joint: int) -> str:
    """Return a joint's name, or its number if it has no name."""
    return model.joint(int(joint)).name or f"joint {joint}"


def measure_order(env: gymnasium.Env[Any, Any]) -> list[int] | None:
    """Return the index in `ctrl` that each element of the action drives; None unless each drives another one.

    A copy of the environment plays an episode of zero actions, and one per element in which it is not zero; `env` stays
    as it is. None also for an environment that cannot be copied or raises, and one that draws windows.
    """
    space = env.action_space
    if not isinstance(space, spaces.Box) or getattr(env, "render_mode", None) == "human":
        return None
    low, high = (np.ravel(np.clip(bound, -1e3, 1e3)) for bound in (space.low, space.high))
    zero = np.clip(0.0, low, high)
    far = np.where(high - zero >= zero - low, high, low)
    driven = []
    try:
        with _raise_by_environment():
            probe = _copy(env)
        plain = _record_controls(probe, space, zero)
        for element in range(zero.size):
            changed = zero.copy()
            changed[element] = (zero[element] + far[element]) / 2
            driven.append(_find_first_change(plain, _record_controls(probe, space, changed)))
    except _RaisedByEnvironmentError:  # whoever steps it reports the cause
        return None
    order = [indices[0] for indices in driven if len(indices) == 1]
    return order if len(order) == zero.size and len(set(order)) == zero.size else None


class _RaisedByEnvironmentError(Exception):
    """A call of the environment's code has raised; an exception from the code around it is a mistake of rlctl."""


@contextlib.contextmanager
def _raise_by_environment() -> Iterator[None]:
    try:
        yield
    except Exception as error:
        raise _RaisedByEnvironmentError from error


def _copy(env: gymnasium.Env[Any, Any]) -> gymnasium.Env[Any, Any]:
    """Copy an environment by its attributes: Gymnasium's `EzPickle` would build it again, and load its model.

    What draws is shared: it holds contexts of OpenGL, which an incomplete copy would free.
    """
    inner = env.unwrapped
    clone = object.__new__(type(inner))
    values = list(vars(inner).values())
    parts = [*values, *(part for value in values for part in getattr(value, "__dict__", {}).values())]
    memo: dict[int, Any] = {id(part): part for part in parts if type(part).__module__.startswith(_DRAWING)}
    memo[id(inner)] = clone
    vars(clone).update(copy.deepcopy(vars(inner), memo))
    return copy.deepcopy(env, memo)


def _record_controls(env: gymnasium.Env[Any, Any], space: spaces.Box, action: Array) -> list[Array]:
    """Repeat an action; return what `ctrl` is at each substep."""
    import mujoco

    rows: list[Array] = []
    with _raise_by_environment():
        env.reset(seed=0)
    before = mujoco.get_mjcb_control()
    mujoco.set_mjcb_control(lambda model, data: rows.append(data.ctrl.copy()))
    try:
        for _ in range(_STEPS):
            own = action.reshape(space.shape).astype(space.dtype)
            with _raise_by_environment():
                _, _, terminated, truncated, _ = env.step(own)
                is_over = bool(terminated or truncated)
            if is_over:
                break
    finally:
        mujoco.set_mjcb_control(before)
    return rows


def _find_first_change(plain: Sequence[Array], changed: Sequence[Array]) -> list[int]:
    """Return the indices that differ in the first substep with a difference: until then the states were equal."""
    for one, other in zip(plain, changed, strict=False):
        if one.shape != other.shape:  # of different models: an environment may step several
            return []
        if (differ := one != other).any():
            return np.flatnonzero(differ).tolist()
    return []
