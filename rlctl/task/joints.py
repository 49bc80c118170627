"""`Joints`: the joints that an action moves, as plain data for controllers of real robots."""

import dataclasses
import math
from collections.abc import Sequence
from typing import Any

from rlctl.errors import TaskError, short_repr


@dataclasses.dataclass(frozen=True)
class Joints:
    """Joints in the order of the action's elements; every other field has one element per joint, or is empty.

    Units: [rad] and [N m] for rotating joints, [m] and [N] for sliding joints.
    """

    names: Sequence[str]
    default_positions: Sequence[float] = ()  # start positions; with `action_scale` also the target of action 0
    action_scale: Sequence[float] = ()  # only if the target of an action is `default_positions + action_scale * action`
    stiffness: Sequence[float] = ()  # of the position controller that follows the action [N m/rad]
    damping: Sequence[float] = ()  # of the same controller [N m s/rad]
    low: Sequence[float] = ()  # lower position limits
    high: Sequence[float] = ()
    max_speed: Sequence[float] = ()  # [rad/s or m/s]
    max_torque: Sequence[float] = ()

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self)[1:]:
            values = [float(value) for value in getattr(self, field.name)]
            if values and (len(values) != len(self.names) or not all(map(math.isfinite, values))):
                raise TaskError(
                    f"joints: {field.name} must have {len(self.names)} finite values, one per joint, but is "
                    f"{list(values)}; leave it out if a value is unknown"
                )
            object.__setattr__(self, field.name, tuple(values))
        if odd := [name for name in self.names if not isinstance(name, str)]:
            raise TaskError(f"joints: names must be text, not {odd[0]!r}")
        object.__setattr__(self, "names", tuple(self.names))


def check_joints(task: Any) -> None:
    """Raise `TaskError` if what a task's `describe_joints` returns does not fit its action."""
    joints, count = task.describe_joints(), math.prod(task.action_space.shape or ())
    if joints is not None and (not isinstance(joints, Joints) or len(joints.names) != count):
        given = list(joints.names) if isinstance(joints, Joints) else joints
        raise TaskError(
            f"{type(task).__name__}: describe_joints() returned {short_repr(given)}; "
            f"return body.describe_joints(names) with {count} names, one per element of the action"
        )
