"""`CommandTerm`: a quantity that a person may command while a robot acts."""

from typing import Any, NamedTuple

_VELOCITIES = {"lin_vel_x": "velocity forwards", "lin_vel_y": "velocity to the left", "ang_vel_z": "turning left"}


def name_for_people(name: str) -> str:
    """Return how films and figures write a commanded quantity: `lin_vel_x` is `velocity forwards`."""
    return _VELOCITIES.get(name, name.replace("_", " "))


class CommandTerm(NamedTuple):
    """A commanded quantity of a task, for `Task.commands`: a velocity to walk with, a coordinate of a goal.

    Names of velocities are those of the field: `lin_vel_x`, `lin_vel_y`, `ang_vel_z`.
    """

    value: Any
    """The present value; in a `BatchTask` one per world, shape (worlds,)."""
    low: float
    high: float
    unit: str = ""
    self_centering: bool = False  # whether it returns to 0 when its key or stick is released, as a velocity does
