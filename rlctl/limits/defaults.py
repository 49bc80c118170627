"""What limits leave out and the policy knows: what an action commands, and which observation has the positions."""

import math

from rlctl.environments.info import AnyTerm, EnvInfo
from rlctl.limits.limits import Limits, Measured
from rlctl.limits.observation import ObservationReader
from rlctl.task.terms import Scaled

_USE_POSITIONS = ("position", "step", "speed")


def fill_in(limits: Limits, info: EnvInfo, reader: ObservationReader) -> Limits:
    """Return the limits with the command and the measured positions that the task describes, where they have none."""
    joints, (_, space) = info.joints, info.spaces()
    is_described = joints is not None and len(joints.names) == math.prod(space.shape or ())
    described = joints.command[0] if joints is not None and is_described else ""
    if described == "correction":
        described = ""  # what it corrects moves, so the filter sees actions only
    command = limits.command or described or "action"
    position = limits.measured.position
    if position is None and command in _USE_POSITIONS:
        position = find_positions(info, reader)
    changes = {"command": command, "measured": Measured(position=position)}
    filled = limits.model_copy(update=changes)
    filled._file = limits.file
    return filled


def find_positions(info: EnvInfo, reader: ObservationReader) -> str | None:
    """Return the observation with the positions of the joints, themselves or scaled; None if the task names none."""
    joints, count = info.joints, math.prod(info.spaces()[1].shape or ())
    if joints is None or not joints.measured or len(joints.names) != count:
        return None
    quantity = joints.measured
    for name, part in reader.layout.columns.items():
        term = info.observation_terms.get(name)
        has_it = name == quantity if term is None else _is_scaled(term, quantity)
        if has_it and part.stop - part.start == count:
            return name
    return None


def _is_scaled(term: AnyTerm, quantity: str) -> bool:
    return isinstance(term, Scaled) and term.quantity == quantity and 0.0 not in term.scale
