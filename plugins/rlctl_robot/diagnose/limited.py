"""Rows of a log in which limits changed the policy's action: `rlctl diagnose --limits FILE`."""

import copy

import numpy as np
from gymnasium import spaces

from rlctl.environments.info import EnvInfo
from rlctl.errors import ArtifactError, UsageError
from rlctl.limits.command import Command, UnsafeCommand
from rlctl.limits.fitting import fit_limits
from rlctl.limits.limits import Limits
from rlctl_robot.diagnose.signals import Array, LoggedSignals

_FEWEST_FREE = 20  # rows in which no limit acts
_PUSH = 1e-3
"""Part of an action's range in the log by which the action is moved, to see whether a limit moves it back."""


def find_limited_rows(limits: Limits, info: EnvInfo, signals: LoggedSignals, margin: int) -> Array:
    """Return for each row whether its action is at a limit, shape (T,): what the policy returned is then not known.

    An action is at a limit if the filter, in the state to which the logged actions have brought it, moves it back when
    it is pushed a little further. Raises `UsageError` for limits that change every action, `ArtifactError` if they act
    in nearly all rows that are at least `margin` rows inside a segment.
    """
    if limits.lowpass_hz is not None:
        raise UsageError("--limits: a low-pass changes every action, so the policy's cannot be read from the log")
    # What a controller's sensors are called is no matter here: only its commands are compared.
    fitted = fit_limits(limits.model_copy(update={"sensors": {}, "blend_in_s": 0.0}), info)
    assert fitted.bounds is not None  # the actions are vectors of real numbers
    command = Command(fitted.limits, fitted, fitted.bounds, lambda intervention: None)
    blend = 0 if limits.blend_in_s == 0.0 else round(limits.blend_in_s / fitted.bounds.dt)
    assert isinstance(fitted.space, spaces.Box)
    ends = fitted.space.low.ravel(), fitted.space.high.ravel()
    push = _PUSH * np.maximum(np.ptp(signals.actions, axis=0), 1e-6)
    limited = np.zeros(len(signals.actions), bool)
    for start, length in zip(signals.starts, signals.lengths, strict=True):
        command.reset()
        for row in range(start, start + length):
            if fitted.measured is not None:
                command.measure(fitted.measured.read(signals.observations[row]))
            limited[row] = row - start < blend or _is_limited(command, signals.actions[row], push, ends)
    inner = signals.inner_rows(margin)
    if (free := int((~limited[inner]).sum())) < _FEWEST_FREE:
        raise ArtifactError(
            f"the limits act in all but {free} of {len(inner)} rows; to compare the policy's actions, diagnose needs "
            f"{_FEWEST_FREE} rows without them: log longer, or with wider limits"
        )
    return limited


def _is_limited(command: Command, action: Array, push: Array, ends: tuple[Array, Array]) -> bool:
    """Return whether an action is at a limit other than the ends of its own range, and let it be the last one."""
    try:
        for pushed in (action + push, action - push):
            moved = np.ravel(copy.copy(command).follow(pushed)) - action
            if ((np.abs(moved) < 0.5 * push) & (ends[0] <= pushed) & (pushed <= ends[1])).any():
                return True
        return False
    except UnsafeCommand:
        return True
    finally:
        try:
            command.follow(action)
        except UnsafeCommand:  # it begins elsewhere: from what is measured
            command.reset()
