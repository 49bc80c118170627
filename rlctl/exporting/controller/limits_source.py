"""The limits of a controller as constants of its C file; the rules are in `templates/limits.c.jinja`."""

import dataclasses
import functools
import math
from typing import Any

import numpy as np
from gymnasium import spaces

from rlctl.limits.bounds import Bounds
from rlctl.limits.command import Command
from rlctl.limits.fitting import FittedLimits
from rlctl.limits.limits import Limits
from rlctl.limits.observation import UNIT_SQUARES
from rlctl.policy.c_writer import write_array, write_number


@dataclasses.dataclass(frozen=True, eq=False)
class LimitsSource:
    """What the templates read: the limits' kinds and numbers."""

    limits: Limits
    fitted: FittedLimits
    bounds: Bounds

    @functools.cached_property
    def _command(self) -> Command:
        return Command(self.limits, self.fitted, self.bounds, lambda intervention: None)

    @property
    def count(self) -> int:
        """Elements of the action."""
        return len(self.bounds.names)

    @property
    def quantities(self) -> int:
        """Numbers that are checked."""
        return self.fitted.reader.layout.size

    @property
    def is_value(self) -> bool:
        """Whether a command is a value, not a motion."""
        return self.bounds.is_value

    @property
    def is_position(self) -> bool:
        """Whether a command is a position."""
        return self.limits.command == "position" or self.tracks

    @property
    def tracks(self) -> bool:
        """Whether steps are bounded as targets: a command is the target of a joint, of type double."""
        return self.fitted.steps is not None

    @property
    def is_action(self) -> bool:
        """Whether a command is the action itself."""
        return self._command.is_action

    @property
    def bounds_position(self) -> bool:
        """Whether positions are bounded."""
        return self.bounds.bounds_position

    @property
    def speed(self) -> bool:
        """Whether the motion of a step is bounded."""
        return self.bounds.speed is not None

    @property
    def change(self) -> bool:
        """Whether the change of the motion is bounded."""
        return self.bounds.change is not None

    @property
    def checks_motion(self) -> bool:
        """Whether the last check looks at more than the range of the command."""
        return self.speed or self.change or (self.bounds_position and not self.is_value)

    @property
    def precision(self) -> str:
        """Relative precision of the last check."""
        return repr(float(self.bounds.precision))

    @property
    def alpha(self) -> str:
        """Weight of the newest command in the low-pass; empty without one."""
        return repr(self._command.alpha) if self._command.alpha < 1.0 else ""

    @property
    def blend_steps(self) -> int:
        """Steps in which the policy takes over."""
        return self._command.blend_steps

    @property
    def is_smooth(self) -> bool:
        """Whether commands are filtered or blended."""
        return bool(self.alpha) or self.blend_steps > 0

    @property
    def has_home(self) -> bool:
        """Whether there is a home position."""
        return self.fitted.home is not None

    @property
    def on_fault(self) -> str:
        """Reaction to a fault."""
        return self.limits.on_fault

    @property
    def measured(self) -> int | None:
        """Where the quantities have the joints' positions; None if they are not measured."""
        return None if self.fitted.measured is None else self.fitted.measured.part.start

    @property
    def has_range(self) -> bool:
        """Whether a sensor has a range."""
        return self.fitted.sensors.has_range

    @property
    def quaternions(self) -> list[int]:
        """Where quantities that must have norm 1 begin."""
        return [part.start for part in self.fitted.sensors.quaternions]

    @property
    def unit_squares(self) -> tuple[float, float]:
        """Bounds of the square of such a norm."""
        return UNIT_SQUARES

    @property
    def checks(self) -> list[str]:
        """The ranges that quantities have by default, for the header."""
        return self.fitted.sensors.describe_defaults()

    @property
    def oldest(self) -> str:
        """Largest age of a measurement [s]."""
        return write_number(np.float64(self.fitted.sensors.oldest), "double")

    @property
    def age(self) -> str:
        """Largest age of a measurement, for people; empty if any age will do."""
        oldest, periods = self.fitted.sensors.oldest, self.limits.max_age_periods
        return f"{oldest:.6g} s (max_age_periods: {periods:g})" if math.isfinite(oldest) else ""

    @property
    def frozen(self) -> list[tuple[str, slice, int]]:
        """Name, place and largest number of equal steps of the quantities that must not freeze."""
        return self.fitted.sensors.frozen

    def list_arrays(self) -> dict[str, str]:
        """Return the definitions of all constant arrays by name."""
        fitted, sensors, space = self.fitted, self.fitted.sensors, self.fitted.space
        assert isinstance(space, spaces.Box)
        numbers: dict[str, Any] = {
            **self.bounds.list_constants(),
            "safe_command": fitted.safe,
            "step_factor": None if fitted.steps is None else fitted.steps.factor,
            "step_low": None if fitted.steps is None else fitted.steps.low,
            "step_high": None if fitted.steps is None else fitted.steps.high,
            "home": fitted.home,
            "action_low": space.low.ravel().astype(np.float64),
            "action_high": space.high.ravel().astype(np.float64),
            "sensor_low": sensors.low,
            "sensor_high": sensors.high,
        }
        arrays = {name: ("double", values) for name, values in numbers.items() if values is not None}
        if frozen := self.frozen:
            arrays["frozen_first"] = ("int", [part.start for _, part, _ in frozen])
            arrays["frozen_end"] = ("int", [part.stop for _, part, _ in frozen])
            arrays["frozen_steps"] = ("long", [steps for *_, steps in frozen])
        return {
            name: write_array(
                f"static const {kind} {name}",
                [write_number(value, "double" if kind == "double" else "int") for value in values],
            )
            for name, (kind, values) in arrays.items()
        }

    @property
    def described(self) -> str:
        """The limits in words, for the header."""
        named = self.limits.model_dump(exclude_defaults=True, mode="json")
        if not named:
            return "the bounds of the action only; export with --limits limits.yaml to limit positions, speeds and more"
        of_server = {"watchdog_periods": "; only `rlctl serve` uses it"}
        lines = [f"  {key}: {_shorten(value)}{of_server.get(key, '')}" for key, value in named.items()]
        return "\n" + "\n".join(lines)

    @property
    def on_fault_text(self) -> str:
        """What a fault leads to, for the header."""
        if self.on_fault != "hold":
            return f"A fault of the inputs or the policy: {self.on_fault}."
        still = "no motion" if not self.is_value else "the present target, after braking"
        if self.is_value and not self.is_position:
            still = f"action {_shorten(self.limits.safe_action or 0.0)}"
        return f"A fault of the inputs or the policy: {still}, until the fault ends."


def _shorten(value: Any) -> str:
    if isinstance(value, dict):
        return "{" + ", ".join(f"{key}: {_shorten(inner)}" for key, inner in value.items()) + "}"
    if isinstance(value, list):
        return f"[{', '.join(map(_shorten, value))}]"
    return f"{value:.6g}" if isinstance(value, float) and math.isfinite(value) else str(value)
