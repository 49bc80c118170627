"""Turns a policy's actions into commands within limits: low-pass, blend, and the bounds of motion."""

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from rlctl.limits.bounds import Bounds, Intervention
from rlctl.limits.fitting import FittedLimits
from rlctl.limits.limits import Limits

Array = NDArray[np.float64]
_MAX_STEPS = 1e9


class UnsafeCommand(Exception):
    """No command is safe: a joint starts outside its limits, or the computed command breaks a limit."""

    def __init__(self, text: str, limit: str, value: float | str = "", bound: float | None = None) -> None:
        super().__init__(text)
        self.limit, self.value, self.bound = limit, value, bound
        """Name of the limit (`elbow.position`), the value, and its bound."""


class Command:
    """Computes the robot's command in each step. Calls `report` with each intervention, whose time is still 0."""

    def __init__(
        self, limits: Limits, fitted: FittedLimits, bounds: Bounds, report: Callable[[Intervention], None]
    ) -> None:
        self._bounds, self._report = bounds, report
        assert isinstance(fitted.space, spaces.Box)  # what has bounds
        self._space = fitted.space
        self._safe, self._home = fitted.safe, fitted.home
        self._steps = fitted.steps
        self._is_position = limits.command == "position" or self._steps is not None
        self.blend_steps = round(min(limits.blend_in_s / bounds.dt, _MAX_STEPS))
        cutoff = limits.lowpass_hz
        self.alpha = 1.0 if cutoff is None else 1.0 - math.exp(-2.0 * math.pi * cutoff * bounds.dt)
        self.is_action = bool((bounds.factor == 1.0).all() and not bounds.offset.any())
        """Whether a command is the action itself."""
        self._zeros = np.zeros(len(self._safe))
        self._none = bytes(len(self._safe))
        self.reset()

    def reset(self) -> None:
        """Begin an episode: the robot's position is unknown."""
        self.position: Array | None = None  # measured positions of the joints
        self._expected: Array | None = None  # positions that the joints should have reached by the last command
        self._reference: Array | None = None  # the last command's value, or the measured positions
        self._before = self._step = self._zeros  # the motion of the last step, and its distance from the position
        self._sent: NDArray[Any] | None = None  # the last action
        self._smooth: Array | None = None
        self.begin_blend()

    def begin_blend(self) -> None:
        """Blend gradually from the present command into the next ones."""
        self._blend_left = self.blend_steps
        self._blend_from: Array | None = None

    def begin_from_measured(self) -> None:
        """Let the next command begin at the measured positions: a stopped robot may have been moved."""
        if self.position is not None:
            self._reference, self._before, self._sent, self._smooth = None, self._zeros, None, None

    def measure(self, position: Array) -> None:
        """Store the measured positions of the joints."""
        self._expected = self._reference if self._bounds.is_value else None
        if self._reference is not None and not self._bounds.is_value:
            with np.errstate(over="ignore"):
                self._expected = self._reference + self._before
        self.position = position.copy()

    @property
    def motion(self) -> Array | None:
        """The last commanded motion, where commands are motions."""
        if self._steps is not None:
            return self._step
        return None if self._bounds.is_value else self._before

    @property
    def target(self) -> Array | None:
        """Where the joints were sent last, for steps that are bounded as targets; None before the first one."""
        return None if self._steps is None else self._reference

    def find_error(self) -> float:
        """Return the largest difference between a joint's position and the expected one; NaN if unknown."""
        if self._expected is None or self.position is None:
            return math.nan
        with np.errstate(over="ignore"):
            return float(np.abs(self._expected - self.position).max())

    def follow(self, action: Array) -> NDArray[Any]:
        """Return the allowed action closest to the policy's. Raises `UnsafeCommand`."""
        start = self._present(action)
        if self._steps is not None:
            return self._follow_step(self._steps.read(action), start)
        target = action if self.is_action else self._bounds.offset + action * self._bounds.factor
        if self.alpha < 1.0 or self._blend_left:
            target = self._apply_smoothing(self._bounds.clip_ends(target, self._note), start)
        return self._move(target)

    def _follow_step(self, step: Array, start: Array) -> NDArray[Any]:
        assert self.position is not None  # without it the filter holds
        if self.alpha < 1.0 or self._blend_left:
            step = self._apply_smoothing(step, start - self.position)
        return self._move(self.position + step)

    def _apply_smoothing(self, target: Array, start: Array) -> Array:
        """Apply low-pass and blend to a command within its bounds, so that neither overflows nor winds up."""
        if self.alpha < 1.0:
            before = start if self._smooth is None else self._smooth
            self._smooth = target = before + self.alpha * (target - before)
        if self._blend_left:
            part = self._blend_left / (self.blend_steps + 1)
            self._blend_left -= 1
            if self._blend_from is None:
                self._blend_from = start
            target = target + part * (self._blend_from - target)
        return target

    def rest(self, go_home: bool) -> NDArray[Any]:
        """Return the action that brakes the robot and keeps it there, or brings it home; raises `UnsafeCommand`."""
        self._smooth = None
        if self._steps is not None and self.position is None:
            return self._steps.write(None, None)
        present = self._present(None)
        home = self._home if go_home else None
        if self._bounds.is_value:
            goal = present if home is None else home
            return self._move(goal if self._is_position else self._safe)
        return self._move(self._zeros if home is None or self.position is None else home - self.position)

    def stand_still(self) -> NDArray[Any]:
        """Return the last command that kept its limits, or no motion: for a robot for which even braking is unsafe."""
        self._smooth = self._blend_from = None
        self._blend_left, self._before = 0, self._zeros
        if not self._bounds.is_value:
            return self._as_action(self._zeros)
        if self._steps is not None:
            return self._steps.write(self._reference, self.position)
        if self._sent is not None:
            return self._sent.copy()
        return self._as_action(self._safe if self._reference is None else self._reference)

    def _present(self, action: Array | None) -> Array:
        """Return the present command: a value, or a motion. The first value comes from the measured positions."""
        if not self._bounds.is_value:
            self._reference = self.position
            return self._before
        if self._reference is not None:
            return self._reference
        if not self._is_position:
            start = self._safe
        elif self.position is not None:
            start = self.position
        elif action is not None:
            start = self._bounds.offset + action * self._bounds.factor
        else:  # positions are not measured
            return self._safe if self._home is None else self._home
        self._reference = self._bounds.clip_value(start, start)
        away = np.abs(self._reference - start)
        if self.position is not None and away.max(initial=0.0) > 1e-6:
            index = int(away.argmax())
            joint, value, bound = self._bounds.names[index], float(start[index]), float(self._reference[index])
            raise UnsafeCommand(f"{joint} is outside its limits at the start", f"{joint}.position", value, bound)
        return self._reference

    def _move(self, target: Array) -> NDArray[Any]:
        bounds, reference, before = self._bounds, self._reference, self._before
        x = self._zeros
        if not bounds.is_value:
            command = x = bounds.bound(target, before, reference, self._note)
        elif reference is None or (bounds.change is None and bounds.speed is None and bounds.keeps_ends(target)):
            command = target
        else:
            x = bounds.bound(target - reference, before, reference, self._note)
            command = bounds.clip_value(reference + x, reference)
        action = self._as_action(command)
        if self._space.dtype.kind != "f" and not self._keeps_limits(action):
            # The nearest whole action may be beyond a limit; the next one towards the present command is not.
            present = self._safe if reference is None else reference
            if not bounds.is_value:
                present = self._zeros
            action = self._as_action(command, np.where(command > present, -1, 1))
        if self._steps is not None:
            is_safe = bounds.keeps_limits(command, before, reference)
        else:
            is_safe = self._keeps_limits(action)
        if not is_safe:
            raise UnsafeCommand("no command within the limits was found", "limits", str(action.tolist()))
        if self._steps is not None and self.position is not None:
            self._step = command - self.position
        self._before, self._sent = x, action.copy()  # the caller may write into the returned array
        if bounds.is_value and reference is not None:
            self._reference = command if self._space.dtype.kind == "f" else self._read_command(action)
        return action

    def _keeps_limits(self, action: NDArray[Any]) -> bool:
        return self._bounds.keeps_limits(self._read_command(action), self._before, self._reference)

    def _read_command(self, action: NDArray[Any]) -> Array:
        sent = action.ravel().astype(np.float64)
        return sent if self.is_action else self._bounds.offset + sent * self._bounds.factor

    def _as_action(self, command: Array, direction: NDArray[np.int64] | None = None) -> NDArray[Any]:
        """Return the action of a command; whole numbers are rounded, or per joint: -1 down, 1 up."""
        if self._steps is not None:
            return self._steps.write(command, self.position)
        action = command if self.is_action else (command - self._bounds.offset) / self._bounds.factor
        if self._space.dtype.kind != "f":
            action = (
                np.rint(action) if direction is None else np.where(direction < 0, np.floor(action), np.ceil(action))
            )
        action = action.astype(self._space.dtype).reshape(self._space.shape)
        if self.is_action:
            return action
        return np.minimum(np.maximum(action, self._space.low), self._space.high)  # rounding

    def _note(self, limit: str, x: Array, allowed: Array, ends: tuple[Array, Array]) -> None:
        acted = np.abs(allowed - x) > 1e-9  # smaller differences are rounding errors: bounds are reached exactly
        if acted.tobytes() != self._none:
            self._report(Intervention(0.0, self._bounds, limit, x, allowed, ends, self._before, self._reference, acted))
