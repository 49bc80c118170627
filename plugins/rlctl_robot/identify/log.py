"""A recording of a robot: a CSV file with a row per control step, columns by name."""

import csv
import dataclasses
import io
import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rlctl.errors import ArtifactError, UsageError, check_name
from rlctl.storage import files, untrusted
from rlctl.storage.csv_text import CsvReader

Array = NDArray[np.float64]

TIME = "time"
_POSITION, _VELOCITY, _TARGET = "position_", "velocity_", "target_"
_USED = (TIME, "action_", _POSITION, _VELOCITY, _TARGET)
_MAX_PERIODS = 1.5  # a longer time between two rows is a gap; in control periods
_RATE_TOLERANCE = 0.1  # tolerated relative difference between the rows' period and the control period
_MAX_SIZE = 200 * 2**20  # [bytes]
MIN_ROWS = 20


@dataclasses.dataclass(frozen=True)
class Log:
    """Commands of a robot and its joint states when each was commanded: a row per control step."""

    joints: tuple[str, ...]
    actions: Array  # shape (T, actions)
    positions: Array  # [rad or m], shape (T, joints)
    velocities: Array  # [rad/s or m/s], shape (T, joints)
    targets: Array | None = None
    """Last targets before the action [rad or m], where the task's actions are steps of them: shape (T, actions), or
    (1, actions) if only the first ones are known."""


@dataclasses.dataclass(frozen=True)
class Expected:
    """What a log of a task must contain."""

    joints: Mapping[str, tuple[float, float]]
    """Joints of the world with their limits [rad or m]; a pair with low >= high means no limits."""
    driven: tuple[str, ...]  # joints in the order of the action, where the task describes them
    actions: int
    control_dt: float  # [s]
    steps_targets: bool = False  # whether actions are steps of targets that the task remembers

    @property
    def target_columns(self) -> list[str]:
        """Names of the columns of the last targets; none for a task that remembers none."""
        return [f"{_TARGET}{name}" for name in self.driven] if self.steps_targets else []

    @property
    def action_columns(self) -> list[str]:
        """Names of the columns of the action."""
        names = self.driven if len(self.driven) == self.actions else [str(index) for index in range(self.actions)]
        return [f"action_{name}" for name in names]


def write_log(path: Path, log: Log, expected: Expected) -> None:
    """Write a log as CSV, atomically."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    measured = [f"{kind}{joint}" for kind in (_POSITION, _VELOCITY) for joint in log.joints]
    targets = np.empty((len(log.actions), 0)) if log.targets is None else log.targets
    names = [] if log.targets is None else expected.target_columns
    writer.writerow([TIME, *expected.action_columns, *measured, *names])
    for step, row in enumerate(np.hstack([log.actions, log.positions, log.velocities, targets])):
        writer.writerow([f"{step * expected.control_dt:.6f}", *(f"{value:.8g}" for value in row)])
    files.write_text(path, text.getvalue())


def read_log(path: Path, expected: Expected) -> Log:
    """Read and check a log; raises `ArtifactError` that names the line or column, and what to change."""
    columns, lines = _read_columns(path)
    _check_time(path, _take(path, columns, TIME), expected.control_dt, lines)
    measured = [name.removeprefix(_POSITION) for name in columns if name.startswith(_POSITION)]
    joints = tuple(dict.fromkeys([*expected.driven, *measured]))
    for joint in joints:
        no_joint = f"{path}: column {_POSITION + joint!r}: the task has no joint"
        check_name(joint, expected.joints, no_joint, ArtifactError)
    if not joints:
        raise ArtifactError(
            f"{path}: no column with a joint's position, such as {_POSITION}{next(iter(expected.joints))}"
        )
    positions, velocities = (
        np.column_stack([_take(path, columns, f"{kind}{joint}") for joint in joints]) for kind in (_POSITION, _VELOCITY)
    )
    _check_units(path, joints, positions, expected)
    actions = np.column_stack([_take(path, columns, name) for name in expected.action_columns])
    return Log(joints, actions, positions, velocities, _take_targets(path, columns, positions, expected))


def _take_targets(path: Path, columns: Mapping[str, Array], positions: Array, expected: Expected) -> Array | None:
    """Return the last targets; without such columns they begin where the robot is, and follow from the actions."""
    names = expected.target_columns
    if not names:
        return None
    if any(name.startswith(_TARGET) for name in columns):
        return np.column_stack([_take(path, columns, name) for name in names])
    return positions[:1, : len(names)]


def _read_columns(path: Path) -> tuple[dict[str, Array], list[int]]:
    try:
        content = untrusted.read_bytes(path, _MAX_SIZE).decode("utf-8-sig")
        reader = CsvReader(content.partition("\n")[0])
        rows = list(csv.reader(io.StringIO(content), delimiter=reader.delimiter))
    except (UnicodeDecodeError, csv.Error) as error:
        raise ArtifactError(f"{path}: not a CSV file: {error}") from None
    names = [name.strip() for name in rows[0]] if rows else []
    numbered = [(line, row) for line, row in enumerate(rows[1:], start=2) if row]
    if len(numbered) < MIN_ROWS:
        raise ArtifactError(f"{path}: {len(numbered)} rows; a log needs at least {MIN_ROWS}; record a few seconds")
    values = np.array([_read_row(path, reader, line, row, names) for line, row in numbered])
    return dict(zip(names, values.T, strict=True)), [line for line, _ in numbered]


def _read_row(path: Path, reader: CsvReader, line: int, row: list[str], names: list[str]) -> list[float]:
    if len(row) != len(names):
        why = reader.explain_count(len(row), len(names))
        raise ArtifactError(f"{path}, line {line}: {len(row)} values for {len(names)} columns{why}")
    numbers = []
    for name, text in zip(names, row, strict=True):
        if not name.startswith(_USED):  # other columns may hold anything
            numbers.append(math.nan)
            continue
        number = reader.read_number(text)
        if not math.isfinite(number):
            why = reader.explain_number(text)
            raise ArtifactError(f"{path}, line {line}: {name} is {text.strip()!r}, not a finite number{why}")
        numbers.append(number)
    return numbers


def _take(path: Path, columns: Mapping[str, Array], name: str) -> Array:
    check_name(name, columns, f"{path}: no column", ArtifactError)
    return columns[name]


def _check_time(path: Path, time: Array, control_dt: float, lines: list[int]) -> None:
    periods = np.diff(time)
    if (back := np.flatnonzero(periods <= 0)).size:
        raise ArtifactError(
            f"{path}, line {lines[back[0] + 1]}: time does not increase: {time[back[0]]:g} s, then "
            f"{time[back[0] + 1]:g} s"
        )
    usual = float(np.median(periods))
    if abs(usual - control_dt) > _RATE_TOLERANCE * control_dt:
        raise ArtifactError(
            f"{path}: a row every {usual:.4g} s, but the task acts every {control_dt:.4g} s: write a row per action"
        )
    if (gaps := np.flatnonzero(periods > _MAX_PERIODS * control_dt)).size:
        raise ArtifactError(
            f"{path}, line {lines[gaps[0] + 1]}: a gap of {periods[gaps[0]]:.3g} s; cut the log to a part without gaps"
        )


def _check_units(path: Path, joints: Sequence[str], positions: Array, expected: Expected) -> None:
    for joint, values in zip(joints, positions.T, strict=True):
        low, high = expected.joints[joint]
        largest = float(np.abs(values).max())
        if largest > 2 * math.pi and low < high and largest > 1.2 * max(abs(low), abs(high)):
            raise ArtifactError(
                f"{path}: {_POSITION}{joint} reaches {largest:.3g}, but the joint's limit is "
                f"{max(abs(low), abs(high)):.3g} rad; if the log is in degrees, multiply by pi / 180"
            )


def check_actions(log: Log, path: Path, low: Array, high: Array) -> None:
    """Raise `UsageError` for actions far outside the task's bounds: other units, or another controller's commands."""
    outside = np.maximum(low - log.actions, log.actions - high).max(axis=0)
    if (outside > 0.01 * (high - low)).any():
        worst = int(outside.argmax())
        raise UsageError(
            f"{path}: action {worst} reaches {np.abs(log.actions[:, worst]).max():.3g}, its bounds in the task are "
            f"{low[worst]:.3g} and {high[worst]:.3g}: log the policy's action, not the motor's command"
        )
