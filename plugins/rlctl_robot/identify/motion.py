"""A recording of a robot's servos: commanded and measured positions, a row per command."""

import csv
import dataclasses
import io
import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from rlctl.errors import ArtifactError
from rlctl.storage import files, yaml_text
from rlctl_robot.diagnose.columns import (
    EPISODES,
    JOINT_POSITIONS,
    JOINT_TARGETS,
    TIMES,
    ColumnAssignment,
    ColumnFinder,
    ColumnMap,
    read_units,
    refuse_shared,
)
from rlctl_robot.diagnose.log import split_segments
from rlctl_robot.diagnose.signals import ACTIONS
from rlctl_robot.diagnose.table import LogTable, TableHeader, read_header, read_table
from rlctl_robot.identify.log import Array
from rlctl_robot.identify.robot_model import RobotModel

_LEAST_ROWS = 100
_MOST_ROWS = 60_000
_SLOWEST_ROWS = 0.2  # [s] between two rows; joints move in between
_FASTEST_ROWS = 0.0005
_WRAP = 0.75  # of a turn, by which an encoder jumps when it wraps
_BEYOND = 1.2  # times its limit, where a joint cannot be


@dataclasses.dataclass(frozen=True, eq=False)
class ServoLog:
    """What servos were told and what their encoders read, in the frame of the encoders."""

    joints: tuple[str, ...]
    commands: Array  # [rad or m], shape (rows, joints)
    positions: Array  # measured when the command of the row was given
    control_dt: float  # [s]
    lengths: tuple[int, ...]  # rows of each part without gaps
    table: LogTable
    columns: tuple[str, ...]  # of the positions
    command_columns: tuple[str, ...]
    notes: tuple[str, ...] = ()

    @property
    def starts(self) -> list[int]:
        """First row of each part."""
        return [0, *np.cumsum(self.lengths)[:-1].tolist()]


def read_motion(path: Path, joints: Sequence[str], given: Path | None = None) -> ServoLog:
    """Read a log of some or all of `joints`; raises `ArtifactError` that names row and column, and what to change."""
    header = read_header(path)
    assigned, found = _assign(header, joints, given)
    table = read_table(header, assigned.used)
    if len(table.rows) < _LEAST_ROWS:
        raise ArtifactError(f"{path}: {len(table.rows)} rows; identify needs {_LEAST_ROWS} or more: record a minute")
    if len(table.rows) > _MOST_ROWS or len(table.windows) > 1:
        raise ArtifactError(f"{path}: more than {_MOST_ROWS:,} rows; a minute or two of motion is enough: cut it")
    control_dt = _find_period(table, assigned)
    lengths, notes = split_segments(table, assigned, control_dt)
    positions, commands = assigned.stack(table.columns)
    return ServoLog(
        joints=found,
        commands=commands,
        positions=positions,
        control_dt=control_dt,
        lengths=tuple(lengths),
        table=table,
        columns=assigned.observations[JOINT_POSITIONS],
        command_columns=assigned.actions,
        notes=(*assigned.notes, *notes),
    )


def write_motion(path: Path, joints: Sequence[str], commands: Array, positions: Array, control_dt: float) -> None:
    """Write targets and positions as CSV, atomically, with the columns that `read_motion` reads."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["time", *(f"target_{name}" for name in joints), *(f"position_{name}" for name in joints)])
    for step, row in enumerate(np.hstack([commands, positions])):
        writer.writerow([f"{step * control_dt:.6f}", *(f"{value:.8g}" for value in row)])
    files.write_text(path, text.getvalue())


def _assign(header: TableHeader, joints: Sequence[str], given: Path | None) -> tuple[ColumnAssignment, tuple[str, ...]]:
    path, names = header.path, header.names
    column_map = ColumnMap() if given is None else yaml_text.read_model(given, ColumnMap)
    finder = ColumnFinder(path, names, joints)
    found = finder.find_joints(JOINT_POSITIONS) or tuple(joints)
    if len(found) < len(joints):
        finder = ColumnFinder(path, names, found)
    positions: tuple[str, ...] = tuple(column_map.observations.get(JOINT_POSITIONS, ()))
    if positions:
        positions = finder.check(given or path, JOINT_POSITIONS, positions, len(found))
    else:
        positions = finder.find(JOINT_POSITIONS, len(found))
    if column_map.actions:
        commands = finder.check(given or path, ACTIONS, column_map.actions, len(found))
    else:
        commands = finder.find(JOINT_TARGETS, len(found))
    refuse_shared(path, {JOINT_POSITIONS: positions, JOINT_TARGETS: commands})
    time = column_map.time or finder.find_one(TIMES)
    if time is None:
        raise ArtifactError(f"{path}: no column with the time [s]: call it `time`, or name it with --columns FILE")
    units = read_units(given, column_map, {JOINT_POSITIONS: len(found), ACTIONS: len(found)})
    episode = column_map.episode or finder.find_one(EPISODES)
    is_own = all(
        f"_{name}" in column for columns in (positions, commands) for name, column in zip(found, columns, strict=True)
    )
    notes = () if is_own else tuple(finder.notes)
    return ColumnAssignment({JOINT_POSITIONS: positions}, commands, time, episode, notes, units=units), found


def _find_period(table: LogTable, assigned: ColumnAssignment) -> float:
    """Return the time between two rows [s]; raises `ArtifactError` for one that is none."""
    assert assigned.time is not None
    periods = np.diff(table.columns[assigned.time])
    usual = float(np.median(periods))
    if usual <= 0:
        row = int(np.flatnonzero(periods <= 0)[0]) + 1
        raise ArtifactError(
            f"{table.where(row)}, column {assigned.time}: the time does not increase; if two robots write into one "
            "log, give each a file"
        )
    if not _FASTEST_ROWS <= usual <= _SLOWEST_ROWS:
        unit = "; is the time in milliseconds?" if usual > 1 else ""
        raise ArtifactError(
            f"{table.path}, column {assigned.time}: a row every {usual:.4g} s; identify reads logs with 5 to 2000 rows "
            f"per second{unit}"
        )
    return usual


def check_positions(motion: ServoLog, robot: RobotModel) -> None:
    """Raise `ArtifactError` for an encoder that wraps and for degrees."""
    where = motion.table.where
    for values, names in ((motion.positions, motion.columns), (motion.commands, motion.command_columns)):
        for joint, column in enumerate(names):
            if not robot.is_turning[joint]:
                continue
            largest = int(np.abs(values[:, joint]).argmax())
            limit = max(abs(robot.low[joint]), abs(robot.high[joint]))
            reached = abs(values[largest, joint])
            if reached > 2 * math.pi and reached > _BEYOND * limit:
                raise ArtifactError(
                    f"{where(largest)}, column {column}: {values[largest, joint]:.4g}, but the limit of "
                    f"{robot.joints[joint]} is {limit:.3g} rad; if the column is in degrees, give its scale, "
                    "0.0174533, in --columns FILE"
                )
    inner = np.ones(len(motion.positions), bool)
    inner[motion.starts] = False
    for joint, column in enumerate(motion.columns):
        jumps = np.abs(np.diff(motion.positions[:, joint], prepend=motion.positions[0, joint])) * inner
        row = int(jumps.argmax())
        if robot.is_turning[joint] and jumps[row] > _WRAP * 2 * math.pi:
            raise ArtifactError(
                f"{where(row)}, column {column}: the encoder wraps: from {motion.positions[row - 1, joint]:.3g} to "
                f"{motion.positions[row, joint]:.3g} rad in one row; unwrap it, as numpy.unwrap does"
            )
