"""From the columns of a log to segments of signals: time, rate, gaps and episodes are checked."""

import dataclasses
from pathlib import Path

import numpy as np

from rlctl.environments.info import EnvInfo
from rlctl.errors import ArtifactError
from rlctl.storage.lerobot import is_lerobot_dataset
from rlctl_robot.diagnose.columns import ColumnAssignment, assign_columns
from rlctl_robot.diagnose.dataset import read_dataset, read_dataset_header
from rlctl_robot.diagnose.inputs import ControllerInputs
from rlctl_robot.diagnose.recording import read_recording
from rlctl_robot.diagnose.signals import Array, LoggedSignals
from rlctl_robot.diagnose.table import LogTable, TableHeader, read_header, read_table

_RATE_TOLERANCE = 0.05  # relative difference of the rows' period and the control period
_GAP = 1.5  # control periods
_SHORT = 0.6  # control periods
_SHORT_SHARE = 0.02  # of the rows that may be nearer to each other, by jitter
_LEAST_SEGMENT = 4
_LEAST_ROWS = 60


@dataclasses.dataclass(frozen=True, eq=False)
class RobotLog:
    """The signals of a log, and what a user should know about how they were read."""

    signals: LoggedSignals
    table: LogTable
    notes: tuple[str, ...]
    kept: Array  # rows of the table that became rows of the signals
    limited: Array | None = None  # shape (T,): the server held the robot or limited the action; None if unknown
    inputs: ControllerInputs | None = None  # where it holds what a controller takes, not what the policy observes

    def row(self, index: int) -> int:
        """Return the line or row of the file for a row of the signals."""
        return int(self.table.rows[self.kept[index]])


def read_robot_log(path: Path, info: EnvInfo, columns: Path | None = None) -> RobotLog:
    """Read a log; raises `ArtifactError` that names the row and the column, and what to change."""
    shape = info.spaces()[0].shape or ()
    is_dataset = is_lerobot_dataset(path)
    recording = read_recording(path) if path.suffix.lower() == ".rrd" else None
    if is_dataset:
        header = read_dataset_header(path)
    elif recording is not None:
        header = TableHeader(path, tuple(recording.columns))
    else:
        header = read_header(path)
    size = int(np.prod(shape))
    assigned = assign_columns(path, header.names, info, size, columns)
    if is_dataset:
        table = read_dataset(path, assigned.used)
    elif recording is not None:
        table = recording
    else:
        table = read_table(header, assigned.used)
    if len(table.rows) < 2:
        count = f"{len(table.rows)} row{'' if len(table.rows) == 1 else 's'}"
        raise ArtifactError(f"{path}: {count} after the header; diagnose needs {_LEAST_ROWS} or more")
    lengths, notes = split_segments(table, assigned, info.control_dt)
    observations, actions = assigned.stack(table.columns)
    sizes = {name: len(some) for name, some in assigned.observations.items()}
    keep = np.repeat(np.array(lengths) >= _LEAST_SEGMENT, lengths)
    kept_lengths = tuple(length for length in lengths if length >= _LEAST_SEGMENT)
    observations, actions, inputs = observations[keep], actions[keep], None
    if assigned.is_of_controller and len(observations):
        inputs = ControllerInputs(info, sizes, observations, actions, kept_lengths)
        observations, sizes = inputs.compute_observations(), dict(info.observation_sizes)
    signals = LoggedSignals(observations, actions, kept_lengths, sizes)
    if sum(kept_lengths) < _LEAST_ROWS:
        gap = f", the first gap is before {table.row_word} {table.rows[lengths[0]]}" if len(lengths) > 1 else ""
        raise ArtifactError(
            f"{path}: {sum(kept_lengths)} rows in parts without gaps{gap}; diagnose needs {_LEAST_ROWS} or more"
        )
    limited = None if table.limited is None else table.limited[keep] > 0
    if limited is not None and limited.any():
        notes.append(
            f"{path}: in {limited.sum():,} of {len(limited):,} rows the server held the robot or limited the action; "
            "they are not compared with the policy's actions"
        )
    all_notes = [*([table.note] if table.note else []), *assigned.notes, *notes]
    return RobotLog(signals, table, tuple(all_notes), np.flatnonzero(keep), limited, inputs)


def split_segments(
    table: LogTable, assigned: ColumnAssignment, control_dt: float | None
) -> tuple[list[int], list[str]]:
    """Return the lengths of the segments, and notes about gaps.

    Raises `ArtifactError` for another rate than `control_dt` [s], mixed rates and decreasing time.
    """
    notes = []
    breaks = np.zeros(len(table.rows), bool)
    breaks[np.cumsum((0, *table.windows[:-1]))[np.array(table.windows) > 0]] = True
    if assigned.episode is not None:
        breaks[1:] |= np.diff(table.columns[assigned.episode]) != 0
    if assigned.time is None:
        notes.append(f"{table.path}: no column with the time, so each row counts as a control step")
    elif (
        control_dt is not None and table.has_row_per_action and not _has_rate(table, assigned.time, breaks, control_dt)
    ):
        notes.append(
            f"{table.path}: the client did not act every {control_dt:.4g} s; each row counts as a control step"
        )
    elif control_dt is not None:
        gaps = _find_gaps(table, table.columns[assigned.time], breaks, control_dt)
        new = np.setdiff1d(gaps, np.flatnonzero(breaks))
        if new.size and assigned.episode is None:
            more = f" and {new.size - 1} more" if new.size > 1 else ""
            notes.append(f"{table.where(int(new[0]))}: a gap in the time{more}; the rows after it are a new part")
        breaks[new] = True
    starts = np.flatnonzero(breaks)
    return np.diff([*starts, len(breaks)]).tolist(), notes


def _has_rate(table: LogTable, name: str, breaks: Array, control_dt: float) -> bool:
    """Return whether the rows are as far apart as control steps: those of a simulated robot may be nearer."""
    periods = np.diff(table.columns[name])[~breaks[1:]]
    return not len(periods) or abs(float(np.median(periods)) - control_dt) <= _RATE_TOLERANCE * control_dt


def _find_gaps(table: LogTable, time: Array, breaks: Array, control_dt: float) -> Array:
    """Return the rows after a gap; raises `ArtifactError` for another rate, mixed rates or decreasing time."""
    periods = np.diff(time)
    inside = ~breaks[1:]
    if (back := np.flatnonzero((periods <= 0) & inside)).size:
        row = int(back[0]) + 1
        raise ArtifactError(
            f"{table.where(row)}: time does not increase: {time[row - 1]:g} s, then {time[row]:g} s; if a new episode "
            "begins there, add a column `episode`"
        )
    usual = float(np.median(periods[inside])) if inside.any() else control_dt
    if abs(usual - control_dt) > _RATE_TOLERANCE * control_dt:
        raise ArtifactError(
            f"{table.path}: a row every {usual:.4g} s, but the policy acts every {control_dt:.4g} s; "
            "log a row per action"
        )
    short = np.flatnonzero((periods < _SHORT * control_dt) & inside)
    if short.size > _SHORT_SHARE * len(periods) and not table.has_row_per_action:
        row = int(short[0]) + 1
        raise ArtifactError(
            f"{table.where(row)}: mixed rates: a row after {periods[row - 1]:.4g} s, most after {usual:.4g} s; "
            "log a row per action"
        )
    return np.flatnonzero((periods > _GAP * control_dt) & inside) + 1
