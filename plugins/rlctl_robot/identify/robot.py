"""Estimates the values of a robot's servos from a log of commands and encoders; needs no task."""

import dataclasses
import math
from collections.abc import Callable, Collection
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlctl.errors import AnswerIsNo, UsageError, check_name
from rlctl.task.mujoco.world import hide_instability
from rlctl_robot.identify.column_checks import check_commands, check_model
from rlctl_robot.identify.first_guess import Regression, differentiate
from rlctl_robot.identify.intervals import CONFIDENCE, WIDEST, explain_unknown, measure_noise
from rlctl_robot.identify.log import Array
from rlctl_robot.identify.motion import ServoLog, check_positions, read_motion
from rlctl_robot.identify.robot_model import (
    ARMATURE,
    BACKLASH,
    BIAS,
    COULOMB,
    DELAY,
    OF_JOINTS,
    STIFFNESS,
    TORQUE,
    VISCOUS,
    RobotModel,
    Values,
    find_robot,
    list_servo_joints,
    read_robot,
    stack_values,
)
from rlctl_robot.identify.unknowns import DEFAULT, QUANTITIES, Unknown, UnknownValues, list_unknowns
from rlctl_robot.identify.window_fit import ENOUGH, WindowFit, WindowFitter
from rlctl_robot.identify.windows import WindowPlayer

Flags = NDArray[np.bool_]

_WINDOW_S = 1.0
_PARTS = 5  # of a log; the end of each is held out
_HELD_OUT = 0.2  # of each part
_LEAST_WINDOWS = 4
_MOST_FITTED_ROWS = 15_000
_FEW = 3  # one in so many windows, to which the values are fitted first
_ENOUGH_OF_FEW = 20.0
_LEAST_MOTION = 0.02  # [rad or m], of a joint that moves
_LARGEST_ERROR = 0.5  # of the difference of target and position, that may stay unexplained in a joint
_NOISE_RATIO = 3.0
_MOST_NOTES = 2
_FINEST = 1e-5  # [rad or m], of the noise of an encoder
_MOST_MISFIT = 3.0
_STILL = 1e6  # armature and damping that hold a joint where it is
_FIRST_BACKLASH = 0.01  # [rad or m]
_FIRST_TORQUE = 0.8  # of the torque that a servo without a limit would have had in the log
_MIN_KNOWN = {BIAS: 0.02, BACKLASH: 0.005, DELAY: 0.004}
"""Half widths of intervals [rad, s] at which values that may be 0 count as known."""
_SMALL_FRICTION = 0.02  # of the torques of a joint: a friction known as well as this is known, even if it is 0


@dataclasses.dataclass(frozen=True)
class RobotValue:
    """A value with its 95 % interval."""

    name: str  # JOINT QUANTITY
    part: str  # joint or link; empty for the delay
    quantity: str
    value: float
    low: float
    high: float
    known: bool
    note: str = ""  # why it is not known


@dataclasses.dataclass(frozen=True)
class RobotIdentification:
    """What a log tells of a robot's servos."""

    robot: Path
    log: Path
    rows: int
    seconds: float
    control_dt: float  # [s]
    values: list[RobotValue]
    held_out_seconds: float
    error_before: float
    """Root mean square of the positions' error in the rows held out [rad or m], with the values of the file."""
    error_after: float
    joint_errors: dict[str, tuple[float, float]]  # the same by joint
    notes: list[str]
    fitted: Values = dataclasses.field(repr=False, default_factory=dict)
    """All values of the robot, those that are not known too, in the order of its joints."""
    joints: tuple[str, ...] = ()
    is_held_out: Flags = dataclasses.field(repr=False, default_factory=lambda: np.zeros(0, bool))
    """Rows to which no value was fitted, shape (rows,)."""

    def find(self, part: str, quantity: str) -> RobotValue | None:
        """Return a value, or None if it was not estimated."""
        return next((value for value in self.values if (value.part, value.quantity) == (part, quantity)), None)


def identify_robot(
    file: str,
    log: Path,
    *,
    columns: Path | None = None,
    fit: Collection[str] = (),
    timestep: float | None = None,
    threads: int = 0,
    report: Callable[[str], None] = lambda _: None,
) -> RobotIdentification:
    """Estimate the servos' values of a robot in a model file from a log of commands and positions.

    `fit` names quantities of `QUANTITIES` (default: all but the masses), `timestep` is the physics step [s]. Raises
    `ArtifactError` for an invalid log, `AnswerIsNo` if columns have another sign, order or unit than the robot, or if
    the log tells none of the values.
    """
    chosen = tuple(fit) or DEFAULT
    for name in chosen:
        check_name(name, QUANTITIES, "--fit: no quantity", UsageError)
    path = find_robot(file)
    motion = read_motion(log, list_servo_joints(path), columns)
    robot = read_robot(path, motion.joints, timestep=timestep)
    check_positions(motion, robot)
    _check_stiffness(robot, chosen)
    moving = _find_moving(motion)
    if not moving:
        raise AnswerIsNo(
            f"{log}: no joint moves by more than {_LEAST_MOTION} rad, so it contains no information about any value; "
            f"to write a motion to record: rlctl identify {file} --excite FILE"
        )
    check_commands(motion, moving)
    is_held_out = _hold_out(motion)
    regression = Regression(robot, motion, np.flatnonzero(~is_held_out))
    check_model(regression, motion, moving)
    start = _guess_start(robot, motion, regression, chosen)
    unknowns = list_unknowns(robot, _hold_still(start, motion, moving), chosen, moving)
    player = _make_player(robot, motion, regression, chosen, threads)
    starts, steps = _choose_windows(motion, is_held_out)
    report(f"{len(unknowns.items)} values, {len(starts)} windows of {steps * motion.control_dt:.2g} s")
    found = _fit(player, unknowns, motion, starts, steps, report)
    after: Values = {name: value[0] for name, value in unknowns.values(found.vector[None]).items()}
    before = _hold_still(_take_nominal(robot, after), motion, moving)
    report("held-out rows")
    errors = play_through(player, motion, [before, after])[:, is_held_out]
    notes = [*motion.notes, *robot.notes]
    if player.is_unstable[0]:
        notes.append(f"{path.name}: the simulation is unstable with the file's values, so its error says little")
    by_joint = np.sqrt(np.square(errors).mean(axis=1))
    bad = _find_unexplained(motion, by_joint, is_held_out, moving, after)
    if len(bad) == len(moving):
        raise AnswerIsNo(
            f"{log}: {path.name} does not explain this log: with the best values the simulated positions of every "
            f"joint are wrong by more than {_LARGEST_ERROR:.0%} of its servo's error, or by more than with the file's: "
            "no values\n"
            "compare the file's axes, masses and gravity with the robot, and what else moves or holds it"
        )
    values = [_describe_value(unknowns, found, index, robot, motion, bad) for index in range(len(unknowns.items))]
    values += _list_still(robot, chosen, moving)
    total = np.sqrt(np.square(by_joint[:, moving]).mean(axis=1))
    if not any(value.known for value in values):
        reasons = list(dict.fromkeys(value.note for value in values))
        more = f", and {len(reasons) - _MOST_NOTES} more notes" if len(reasons) > _MOST_NOTES else ""
        raise AnswerIsNo(
            f"{log}: this log determines none of the values: {'; '.join(reasons[:_MOST_NOTES])}{more}\n"
            f"error held out: {total[0]:.3g} rad with the file's values, {total[1]:.3g} rad with the best"
        )
    return RobotIdentification(
        robot=path,
        log=log,
        rows=len(motion.positions),
        seconds=len(motion.positions) * motion.control_dt,
        control_dt=motion.control_dt,
        values=values,
        held_out_seconds=float(is_held_out.sum() * motion.control_dt),
        error_before=float(total[0]),
        error_after=float(total[1]),
        joint_errors={robot.joints[joint]: (float(by_joint[0, joint]), float(by_joint[1, joint])) for joint in moving},
        notes=notes,
        fitted=after,
        joints=robot.joints,
        is_held_out=is_held_out,
    )


def _guess_start(robot: RobotModel, motion: ServoLog, regression: Regression, chosen: Collection[str]) -> Values:
    """Return a first guess of the chosen quantities, and the file's values of the others."""
    guess = regression.guess("stiffness" in chosen)
    guess[BACKLASH] = np.full(len(robot.joints), _FIRST_BACKLASH)
    largest = guess[STIFFNESS] * np.abs(motion.commands - motion.positions).max(axis=0)
    guess[TORQUE] = np.minimum(robot.nominal[TORQUE], _FIRST_TORQUE * largest)
    return robot.nominal | {QUANTITIES[name]: guess[QUANTITIES[name]] for name in chosen}


def _make_player(
    robot: RobotModel, motion: ServoLog, regression: Regression, chosen: Collection[str], threads: int
) -> WindowPlayer:
    if "backlash" not in chosen:
        return WindowPlayer(robot, motion.commands, motion.control_dt, threads)
    with_play = read_robot(robot.path, robot.joints, timestep=robot.model.opt.timestep, plays=True)
    player = WindowPlayer(with_play, motion.commands, motion.control_dt, threads)
    # Rows without a side, which are held out, have that of the row before.
    nearest = np.searchsorted(regression.rows, np.arange(len(motion.commands)), side="right") - 1
    player.sides = regression.find_sides()[np.maximum(nearest, 0)]
    return player


def _fit(
    player: WindowPlayer,
    unknowns: UnknownValues,
    motion: ServoLog,
    starts: Array,
    steps: int,
    report: Callable[[str], None],
) -> WindowFit:
    """Fit the values to some of the windows, and then to all of them, which needs few steps then."""
    velocities = differentiate(motion).velocities
    vector = unknowns.column("first")
    for every, enough in ((_FEW, _ENOUGH_OF_FEW), (1, ENOUGH)):
        chosen = starts[::every]
        if every > 1 and len(chosen) < _LEAST_WINDOWS:
            continue
        fitter = WindowFitter(player, unknowns, motion.positions, velocities, chosen, steps)
        found = fitter.fit(vector, report, enough)
        vector = found.vector
    return found


def _check_stiffness(robot: RobotModel, chosen: Collection[str]) -> None:
    missing = [name for name, value in zip(robot.joints, robot.nominal[STIFFNESS], strict=True) if np.isnan(value)]
    if missing and "stiffness" not in chosen:
        raise UsageError(
            f"{robot.path}: it has no position servo for {', '.join(missing)}, so the stiffness must be estimated too: "
            "--fit stiffness, or add <position kp=.../> to the file"
        )


def _find_moving(motion: ServoLog) -> list[int]:
    """Return the joints that move."""
    return np.flatnonzero(np.ptp(motion.positions, axis=0) > _LEAST_MOTION).tolist()


def _hold_out(motion: ServoLog) -> Flags:
    """Return which rows no value is fitted to: the end of each fifth of the log, (rows,)."""
    edges = np.linspace(0, len(motion.positions), _PARTS + 1)
    position = np.arange(len(motion.positions))
    part = np.clip(np.searchsorted(edges, position, side="right") - 1, 0, _PARTS - 1)
    share = (position - edges[part]) / np.diff(edges)[part]
    held_out: Flags = share >= 1 - _HELD_OUT
    return held_out


def _choose_windows(motion: ServoLog, is_held_out: Flags) -> tuple[Array, int]:
    """Return the first rows of the windows, and their control steps; raises `AnswerIsNo` if there are too few."""
    steps = max(4, round(_WINDOW_S / motion.control_dt))
    starts: list[int] = []
    for begin, length in zip(motion.starts, motion.lengths, strict=True):
        row = begin
        while row + steps < begin + length:
            inside = is_held_out[row : row + steps + 1]
            if inside.any():
                row += int(np.flatnonzero(inside)[-1]) + 1
            else:
                starts.append(row)
                row += steps
    if len(starts) < _LEAST_WINDOWS:
        raise AnswerIsNo(
            f"{motion.table.path}: {len(starts)} parts of {_WINDOW_S:g} s without a gap, at least {_LEAST_WINDOWS} are "
            "needed: record a minute"
        )
    every = max(1, math.ceil(len(starts) * steps / _MOST_FITTED_ROWS))  # memory is proportional to rows
    return np.array(starts[::every]), steps


def _hold_still(values: Values, motion: ServoLog, moving: Collection[int]) -> Values:
    """Return values with which the joints that do not move stay where they are."""
    still = [joint for joint in range(len(motion.joints)) if joint not in moving]
    changed = {name: np.array(value, np.float64) for name, value in values.items()}
    changed[ARMATURE][still] = changed[VISCOUS][still] = _STILL
    changed[STIFFNESS][still] = 0.0
    return changed


def _take_nominal(robot: RobotModel, after: Values) -> Values:
    """Return the values of the file; a stiffness that it has not is the estimated one."""
    values = dict(robot.nominal)
    values[STIFFNESS] = np.where(np.isnan(values[STIFFNESS]), after[STIFFNESS], values[STIFFNESS])
    return values


def play_through(player: WindowPlayer, motion: ServoLog, candidates: list[Values]) -> Array:
    """Return the errors of the positions when each part of the log is played from its first row, measured nowhere else.

    Shape (candidates, rows, joints).
    """
    velocities = differentiate(motion).velocities
    values: Values = {
        name: np.concatenate([stack_values(candidate, 1)[name] for candidate in candidates]) for name in candidates[0]
    }
    count = len(candidates)
    parts, unstable = [], []
    for begin, length in zip(motion.starts, motion.lengths, strict=True):
        first, speed = (np.repeat(rows[begin][None], count, axis=0) for rows in (motion.positions, velocities))
        with hide_instability():
            played = player.play(values, np.full(count, begin), first, speed, length - 1)
        parts.append(played - motion.positions[begin : begin + length])
        unstable.append(player.is_unstable)
    player.is_unstable = np.any(unstable, axis=0)  # in any part
    return np.concatenate(parts, axis=1)


def _find_unexplained(
    motion: ServoLog, errors: Array, is_held_out: Flags, moving: Collection[int], after: Values
) -> list[int]:
    """Return the joints that the simulation does not follow with the best values, or less well than with the file's."""
    late = round(float(after[DELAY]) / motion.control_dt)
    commands = np.roll(motion.commands, late, axis=0)
    differences = np.std((commands - motion.positions)[is_held_out], axis=0)
    noise = _NOISE_RATIO * measure_noise(motion.positions)
    allowed = np.maximum(_LARGEST_ERROR * differences, noise)
    is_worse = errors[1] > np.maximum(errors[0], noise)
    return [joint for joint in moving if is_worse[joint] or not errors[1, joint] <= allowed[joint]]


def _describe_value(
    unknowns: UnknownValues, fit: WindowFit, index: int, robot: RobotModel, motion: ServoLog, bad: Collection[int]
) -> RobotValue:
    item, value = unknowns.items[index], float(fit.vector[index])
    # What the simulation does not explain is alike from row to row, and says less than as much noise would.
    misfit = np.clip(fit.noise / np.maximum(measure_noise(motion.positions), _FINEST), 1.0, _MOST_MISFIT)
    mine = unknowns.affected[:, index] & (np.ptp(motion.positions, axis=0) > _LEAST_MOTION)
    if item.quantity in OF_JOINTS:
        mine = np.arange(len(misfit)) == item.index
    half = CONFIDENCE * float(np.sqrt(fit.covariance[index, index])) * float(np.median(misfit[mine]))
    low, high = max(value - half, item.lowest), value + half
    note = ""
    if item.part and item.quantity in OF_JOINTS and item.index in bad:
        note = "the simulated joint does not follow the log, whatever its values"
    elif half > _find_widest(item, value, robot, motion, fit, unknowns):
        note = _explain(unknowns, fit, index)
    return RobotValue(item.name, item.part, item.quantity, value, low, high, not note, note)


def _find_widest(
    item: Unknown, value: float, robot: RobotModel, motion: ServoLog, fit: WindowFit, unknowns: UnknownValues
) -> float:
    """Return the half width of an interval at which a value counts as known."""
    widest = max(WIDEST * abs(value), _MIN_KNOWN.get(item.quantity, 0.0))
    if item.quantity == COULOMB:
        values = unknowns.values(fit.vector[None])
        difference = float(np.std(motion.commands[:, item.index] - motion.positions[:, item.index]))
        widest = max(widest, _SMALL_FRICTION * float(values[STIFFNESS][0, item.index]) * difference)
    return widest


def _explain(unknowns: UnknownValues, fit: WindowFit, index: int) -> str:
    sizes = unknowns.column("size")
    names = [item.name for item in unknowns.items]
    scaled = fit.information * np.outer(sizes, sizes)
    alone = CONFIDENCE / np.sqrt(max(scaled[index, index], 1e-12))
    if alone > WIDEST:
        return f"this log contains no information about {names[index]}"
    return explain_unknown(names, index, scaled)


def _list_still(robot: RobotModel, chosen: Collection[str], moving: Collection[int]) -> list[RobotValue]:
    values = []
    for joint, name in enumerate(robot.joints):
        if joint in moving:
            continue
        for short in chosen:
            quantity = QUANTITIES[short]
            if quantity in OF_JOINTS:
                note = f"{name} does not move in this log"
                values.append(RobotValue(f"{name} {quantity}", name, quantity, np.nan, np.nan, np.nan, False, note))
    return values


def describe(result: RobotIdentification) -> dict[str, Any]:
    """Return a result as plain data, for JSON; numbers that are not known at all are None."""
    described = dataclasses.asdict(result)
    for name in ("fitted", "joints", "is_held_out"):
        del described[name]
    for value in described["values"]:
        value |= {name: None for name in ("value", "low", "high") if not math.isfinite(value[name])}
    return described
