"""The first targets that an environment gives its motors, and the limits that its actions cover."""

import math
from collections.abc import Iterator

import numpy as np

from rlctl.checking.motor_commands import CommandSpan
from rlctl.checking.world_logs import LoggedWorld
from rlctl.checking.worlds import JOINTS, Array, JointActuator, MotorTarget

APART = 0.2  # of a target and its own joint's position [rad], [m]
DEGREE = math.pi / 180
ROUNDED = 1e-3  # relative; for what people round


def read_first_targets(world: LoggedWorld) -> Iterator[tuple[str, list[str], Array, list[MotorTarget], Array, float]]:
    """Yield, for each robot, its name, and of each driven joint the name, the mean position at reset, the target that
    the first zero action gives it, the position at that reset, and the error of the means."""
    for log in world.logs:
        for i, body in enumerate(log.world.bodies if log.actions == "zero" and len(log.targets) > 1 else ()):
            first = log.targets[1]
            driven = [j for j, joint in enumerate(body.joints) if (body.id, joint.index) in first]
            if not driven:
                continue
            columns = [JOINTS + j for j in driven]
            sizes = [JOINTS + 2 * len(body.joints)] * len(world.logs)
            starts = [other.states[0][i] for other in world.logs if len(other.states[0]) > i]
            rows = np.array([state[columns] for state, size in zip(starts, sizes, strict=False) if len(state) == size])
            error = 4 * float(rows.std(axis=0).max()) / math.sqrt(len(rows))
            targets = [first[body.id, body.joints[j].index] for j in driven]
            names = [body.joints[j].name for j in driven]
            yield body.name, names, rows.mean(axis=0), targets, log.states[0][i][columns], error


def covers(span: CommandSpan, motor: JointActuator, factor: float = 1.0) -> bool:
    """Say whether a span is the limits of a motor's joint times a factor."""
    joint = motor.joint
    ends = np.array([joint.low, joint.high]) * factor * motor.gear
    return bool(np.abs(np.sort(ends) - [span.low, span.high]).max() <= ROUNDED * np.ptp(ends))
