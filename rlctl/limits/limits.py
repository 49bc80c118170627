"""`limits.yaml`: limits on the commands of a robot, by the names of its joints. Typed, every key checked."""

from pathlib import Path
from typing import Annotated, Literal

import pydantic
from pydantic import Field

from rlctl.storage import yaml_text
from rlctl.storage.validation import Number, Section

Positive = Annotated[Number, Field(gt=0)]


def _check_order(value: tuple[float, float]) -> tuple[float, float]:
    if value[0] >= value[1]:
        raise ValueError(f"the lower bound {value[0]:g} is not below the upper one, {value[1]:g}; write [low, high]")
    return value


Interval = Annotated[tuple[Number, Number], pydantic.AfterValidator(_check_order)]


class JointLimits(Section):
    """Limits of one joint, or of all."""

    position: Interval | None = None
    """Lowest and highest position [rad or m]; for commands of position, step and speed."""
    speed: Positive | None = None
    """Highest speed [rad/s or m/s]; for commands of position, step and speed."""
    acceleration: Positive | None = None
    """Highest acceleration [rad/s^2 or m/s^2]; for commands of position, step and speed."""
    torque: Positive | None = None
    """Highest torque or force [N m or N]; for commands of torque."""
    rate: Positive | None = None
    """Largest change of the command per second [1/s]; for commands of torque and action."""
    action: Interval | None = None
    """Lowest and highest value of the action itself, whatever it commands."""


class Sensor(Section):
    """Checks of one named observation; every observation must also be finite."""

    range: Interval | None = None
    """Lowest and highest value."""
    frozen_s: Positive | None = None
    """A value that has not changed by a single bit for this time is a fault [s]."""


class Measured(Section):
    """Which observations hold the joints' state, one element per element of the action."""

    position: str | None = None
    """Name of the observation with the joint positions; null: the one that the task names."""


class Limits(Section):
    """Limits on the commands of a robot."""

    _file: Path | None = None

    @property
    def file(self) -> Path | None:
        """The file that the limits were read from."""
        return self._file

    @property
    def kind(self) -> str:
        """What an action commands, or `action` where that is left to the task."""
        return self.command or "action"

    command: Literal["position", "step", "speed", "torque", "action"] | None = None
    """What an action commands: joint positions, steps from the present positions, speeds, torques, or anything. null:
    what the task says, else `action`."""
    scale: Positive | list[Positive] | None = None
    """Command per 1 of the action, in the command's unit; one number, or one per joint. null: the task's, or 1."""
    offset: Number | list[Number] | None = None
    """Command of action 0, for commands of position, torque and action. null: the task's default positions, or 0."""
    joints: list[str] | None = None
    """Names of the joints in the order of the action; null: the task's."""
    limits: dict[str, JointLimits] = {}
    """Limits by joint name; `all` is for every joint; a joint's own limits replace it. Unset limits come from the
    task's model of the robot."""
    lowpass_hz: Positive | None = None
    """Cut-off frequency of the low-pass on the command [Hz]."""
    blend_in_s: Annotated[Number, Field(ge=0)] = 0.0
    """Time in which the policy's command takes over after a start, a hold or an override [s]."""
    measured: Measured = Measured()
    """Which observations hold the joints' state."""
    sensors: dict[str, Sensor] = {}
    """Checks by the name of the observation."""
    max_age_periods: Positive = 3.0
    """An older observation is a fault; in control periods."""
    watchdog_periods: Annotated[Number, Field(ge=0)] = 3.0
    """A server stops after this many control periods without an observation; 0: never."""
    on_fault: Literal["hold", "home", "stop"] = "hold"
    """Reaction to a fault of a sensor or of the policy; `hold` and `home` end with the fault."""
    home: list[Number] | None = None
    """Joint positions to go to."""
    safe_action: list[Number] | None = None
    """Action while holding or stopped, for commands of torque and action; null: zero."""
    control_dt: Positive | None = None
    """Time between two actions [s]; null: the policy's."""


NO_LIMITS = Limits(command="action")
"""Only the bounds of the action."""


def read_limits(path: Path) -> Limits:
    """Read a limits file; raises `ArtifactError` if it cannot be read, `RecipeError` if its content is invalid."""
    limits = yaml_text.read_model(path, Limits)
    limits._file = path
    return limits
