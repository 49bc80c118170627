"""Columns of a log with another sign, order or unit than the robot's joints: named, not fitted."""

import dataclasses
import itertools
import math
from collections.abc import Sequence

import numpy as np

from rlctl.errors import AnswerIsNo
from rlctl_robot.identify.first_guess import Regression
from rlctl_robot.identify.log import Array
from rlctl_robot.identify.motion import ServoLog

_LATEST_S = 0.2  # by which a position may follow its command late
_WEAK, _CLEAR = 0.5, 0.8  # correlations of a position with its own command, and with that of another joint
_DEGREES = (30.0, 110.0)  # factor between a command and its position, where one of them is in degrees
_CLEARER = math.log(3.0)
"""By so much another sign or order must explain more for each joint that it changes: a third of the rest remains."""
_MOST_CHANGED = 2
_LEAST_SHARE = 1e-4


def check_commands(motion: ServoLog, moving: Sequence[int]) -> None:
    """Raise `AnswerIsNo` if positions follow the commands of other joints, or with another sign or unit."""
    correlations = _correlate(motion)
    for joint in moving:
        own = correlations[joint, joint]
        position, command = motion.columns[joint], motion.command_columns[joint]
        if own < -_CLEAR:
            raise AnswerIsNo(
                f"{motion.table.path}: column {position} moves against {command}: one of them has the wrong sign "
                f"(correlation {own:.2f}); give its scale, -1, in --columns FILE"
            )
        other = int(np.abs(correlations[joint]).argmax())
        if abs(own) < _WEAK and abs(correlations[joint, other]) > _CLEAR:
            raise AnswerIsNo(
                f"{motion.table.path}: column {position} follows {motion.command_columns[other]}, not {command}: the "
                f"order of the columns is wrong (correlation {correlations[joint, other]:.2f} and {own:.2f})"
            )
        if own > _CLEAR:
            _check_unit(motion, joint)


def _check_unit(motion: ServoLog, joint: int) -> None:
    """Raise `AnswerIsNo` if a command and its position differ by the factor of degrees."""
    factor = float(motion.positions[:, joint].std() / max(motion.commands[:, joint].std(), 1e-12))
    position, command = motion.columns[joint], motion.command_columns[joint]
    for one, other, size in ((position, command, factor), (command, position, 1 / factor)):
        if _DEGREES[0] < size < _DEGREES[1]:
            raise AnswerIsNo(
                f"{motion.table.path}: column {one} moves {size:.3g} times as far as {other}: it is in degrees, "
                f"a factor of {180 / math.pi:.4g}; give its scale, 0.0174533, in --columns FILE"
            )


def _correlate(motion: ServoLog) -> Array:
    """Return the correlation of each position with each command, at the delay where it is largest, (joints,) * 2."""
    positions, commands = _standardise(motion.positions), _standardise(motion.commands)
    steps = max(1, round(_LATEST_S / motion.control_dt))
    delays = sorted({0, *np.linspace(0, steps, min(steps, 10) + 1).astype(int).tolist()})
    best = np.zeros((positions.shape[1],) * 2)
    for delay in delays:
        rows = len(positions) - delay
        found = positions[delay:].T @ commands[:rows] / rows
        best = np.where(np.abs(found) > np.abs(best), found, best)
    return best


def _standardise(values: Array) -> Array:
    centered = values - values.mean(axis=0)
    scaled: Array = centered / np.maximum(centered.std(axis=0), 1e-9)
    return scaled


def check_model(regression: Regression, motion: ServoLog, moving: Sequence[int]) -> None:
    """Raise `AnswerIsNo` if gravity and inertia fit far better when joints of the log have another sign or order."""
    robot = regression.robot
    count = len(robot.joints)
    straight = list(range(count))
    alternatives = [_Alternative("", np.ones(count), straight, 0)]
    for joint in moving:
        signs = np.ones(count)
        signs[joint] = -1
        text = f"of {robot.joints[joint]} have another sign than in {robot.path.name}: give their scale, -1,"
        alternatives.append(_Alternative(text, signs, straight, 1))
    text = f"of all joints have another sign than in {robot.path.name}: give their scale, -1,"
    alternatives.append(_Alternative(text, -np.ones(count), straight, _MOST_CHANGED))
    for one, other in itertools.combinations(moving, 2):
        order = list(straight)
        order[one], order[other] = other, one
        text = f"of {robot.joints[one]} and {robot.joints[other]} are exchanged: give them"
        alternatives.append(_Alternative(text, np.ones(count), order, 2))
    shares = [regression.unexplained(each.signs, each.order)[list(moving)] for each in alternatives]
    scores = np.array([np.log(np.maximum(share, _LEAST_SHARE)).sum() for share in shares])
    gains = scores[0] - scores - _CLEARER * np.array([each.changed for each in alternatives])
    best = int(gains.argmax())
    if best > 0 and gains[best] > 0:
        raise AnswerIsNo(
            f"{motion.table.path}: the columns {alternatives[best].text} in --columns FILE (of the difference between "
            f"targets and positions, gravity, inertia and friction leave {np.exp(scores[0] / len(moving)):.1%} "
            f"unexplained as they are, and {np.exp(scores[best] / len(moving)):.1%} then)"
        )


@dataclasses.dataclass(frozen=True, eq=False)
class _Alternative:
    text: str
    signs: Array
    order: Sequence[int]
    changed: int  # joints, for each of which it must explain more
