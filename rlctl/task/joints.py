"""The joints that a policy's action moves, as plain data: in policies and exports, for whoever drives the robot."""

import dataclasses
import math
from collections.abc import Sequence

from rlctl.errors import TaskError


@dataclasses.dataclass(frozen=True)
class Joints:
    """Joints in the order of the action's elements; every other field has one element per joint, or is empty.

    Positions are in [rad], of sliding joints in [m]; torques in [N m], forces in [N].
    """

    names: Sequence[str]
    default_positions: Sequence[float] = ()
    """Where the robot starts and, with `action_scale`, where action 0 sends it."""
    action_scale: Sequence[float] = ()
    """Only if an action sends the joints to `default_positions + action_scale * action`."""
    stiffness: Sequence[float] = ()
    """Of the position controller that follows the action [N m/rad]."""
    damping: Sequence[float] = ()
    """Of that controller [N m s/rad]."""
    low: Sequence[float] = ()
    """Lower position limits."""
    high: Sequence[float] = ()
    max_speed: Sequence[float] = ()
    """[rad/s or m/s]."""
    max_torque: Sequence[float] = ()

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self)[1:]:
            values = [float(value) for value in getattr(self, field.name)]
            if values and (len(values) != len(self.names) or not all(map(math.isfinite, values))):
                raise TaskError(
                    f"joints: {field.name} has {len(values)} values, or one that is not finite, for "
                    f"{len(self.names)} joints; leave out unknown values"
                )
            object.__setattr__(self, field.name, tuple(values))
        object.__setattr__(self, "names", tuple(self.names))
