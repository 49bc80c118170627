"""Reads logs as columns of numbers by name: CSV and NPZ, in bounded memory however long they are."""

import csv
import dataclasses
import io
import itertools
import math
import zipfile
from collections.abc import Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.lib import format as npy

from rlctl.errors import ArtifactError, short_repr
from rlctl.storage import untrusted
from rlctl.storage.csv_text import CsvReader
from rlctl_robot.diagnose.signals import Array

_WHOLE_CSV = 48 * 2**20  # [bytes]; of larger files windows are read
_WHOLE_ROWS = 60_000
_WINDOWS, _WINDOW_ROWS = 40, 500
_LONGEST_LINE = 2**20  # [bytes]
_MOST_COLUMNS = 10_000


@dataclasses.dataclass(frozen=True, eq=False)
class LogTable:
    """Columns of a log; `rows` names each row of a file: its line in a CSV, its index in an NPZ."""

    path: Path
    columns: dict[str, Array]
    rows: Array  # shape (T,)
    windows: tuple[int, ...]  # rows of each part of the file that was read
    row_word: str  # `line` or `row`
    note: str = ""
    has_row_per_action: bool = False  # whatever the time between them is
    limited: Array | None = None  # shape (T,): 1 where a server held the robot or limited the action; None if unknown

    def where(self, index: int) -> str:
        """Return `FILE, line 12` for a row of the table."""
        return f"{self.path}, {self.row_word} {int(self.rows[index])}"


@dataclasses.dataclass(frozen=True)
class TableHeader:
    """Names of the columns of a log, before its numbers are read."""

    path: Path
    names: tuple[str, ...]


def read_header(path: Path) -> TableHeader:
    """Return the names of the columns; those of an array of shape (T, n) are NAME_0 to NAME_n-1.

    Raises `ArtifactError` for a file that is neither CSV nor NPZ.
    """
    if path.suffix.lower() == ".npz":
        with _open_archive(path) as archive:
            names = [name for member in _read_members(path, archive) for name in member.column_names()]
    elif path.suffix.lower() in (".csv", ".txt"):
        with untrusted.open_file(path) as file:
            line = _read_line(path, file)
        names = [name.strip() for name in _split_line(path, CsvReader(line), line, 1)]
        if twice := [name for name in names if names.count(name) > 1]:
            raise ArtifactError(f"{path}, line 1: column {twice[0]!r} is given twice")
    else:
        raise ArtifactError(
            f"{path}: not a log that diagnose reads: give a .csv, .npz or .rrd file, or the folder of a LeRobot dataset"
        )
    if not names:
        raise ArtifactError(f"{path}: it has no columns")
    check_width(path, len(names))
    return TableHeader(path, tuple(names))


def read_table(header: TableHeader, used: Collection[str]) -> LogTable:
    """Read the `used` columns; raises `ArtifactError` that names row and column of what is not a finite number."""
    if header.path.suffix.lower() == ".npz":
        return _read_npz(header.path, used)
    return _read_csv(header, used)


def check_width(path: Path, columns: int) -> None:
    """Raise `ArtifactError` for a log with too many columns."""
    if columns > _MOST_COLUMNS:
        raise ArtifactError(f"{path}: {columns:,} columns, the limit is {_MOST_COLUMNS:,}")


def _read_line(path: Path, file: BinaryIO) -> str:
    line = file.readline(_LONGEST_LINE)
    if len(line) == _LONGEST_LINE:
        raise ArtifactError(f"{path}: a line of more than {_LONGEST_LINE:,} bytes: not a CSV file")
    try:
        return line.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise ArtifactError(f"{path}: not a CSV file: {error}") from None


def _split_line(path: Path, reader: CsvReader, line: str, number: int) -> list[str]:
    try:
        return reader.split(line)
    except csv.Error as error:
        raise ArtifactError(f"{path}, line {number}: {error}") from None


def _read_csv(header: TableHeader, used: Collection[str]) -> LogTable:
    path = header.path
    indices = {name: index for index, name in enumerate(header.names) if name in used}
    values: list[list[float]] = []
    rows: list[int] = []
    windows: list[int] = []
    with untrusted.open_file(path) as file:
        reader = CsvReader(_read_line(path, file))
        size = file.seek(0, io.SEEK_END)
        starts = [0] if size <= _WHOLE_CSV else np.linspace(0, size * 0.99, _WINDOWS).astype(int).tolist()
        for start in starts:
            begin = len(values)
            most = None if size <= _WHOLE_CSV else _WINDOW_ROWS
            for number, line in _read_lines(path, file, start, most):
                if line.strip():
                    values.append(_read_row(header, reader, line, number, indices))
                    rows.append(number)
            windows.append(len(values) - begin)
    array = np.array(values, np.float64).reshape(len(values), len(indices))
    note = ""
    if len(starts) > 1:
        note = f"{path}: {len(starts)} parts of {_WINDOW_ROWS} lines are read, spread over the file"
    word = "line" if len(starts) == 1 else "the line at byte"
    return LogTable(path, dict(zip(indices, array.T, strict=True)), np.array(rows), tuple(windows), word, note)


def _read_lines(path: Path, file: BinaryIO, start: int, most: int | None) -> Iterator[tuple[int, str]]:
    """Yield lines with their number, or in a part of a large file with their position."""
    file.seek(start)
    _read_line(path, file)  # the header, or the rest of a line
    for count in itertools.count(2):
        position = file.tell()
        line = _read_line(path, file)
        if not line or (most is not None and count - 2 >= most):
            return
        yield (count if most is None else position), line


def _read_row(header: TableHeader, reader: CsvReader, line: str, number: int, indices: dict[str, int]) -> list[float]:
    path, columns = header.path, len(header.names)
    row = _split_line(path, reader, line, number)
    if len(row) != columns:
        why = reader.explain_count(len(row), columns)
        raise ArtifactError(f"{path}, line {number}: {len(row)} values for {columns} columns{why}")
    numbers = []
    for name, index in indices.items():
        value = reader.read_number(row[index])
        if not math.isfinite(value):
            text, why = short_repr(row[index].strip()), reader.explain_number(row[index])
            raise ArtifactError(f"{path}, line {number}, column {name}: {text!r} is not a finite number{why}")
        numbers.append(value)
    return numbers


@dataclasses.dataclass(frozen=True)
class _Member:
    name: str
    shape: tuple[int, ...]
    fortran: bool
    dtype: np.dtype[Any]

    @property
    def width(self) -> int:
        """Number of columns of a vector or a matrix of numbers; 0 for anything else."""
        if self.dtype.kind not in "biuf" or len(self.shape) not in (1, 2):
            return 0
        return 1 if len(self.shape) == 1 else self.shape[1]

    def column_names(self) -> list[str]:
        """Names of the columns, as many as the width."""
        return [self.name] if len(self.shape) == 1 else [f"{self.name}_{index}" for index in range(self.width)]


def _open_archive(path: Path) -> zipfile.ZipFile:
    with untrusted.open_file(path):
        pass  # a regular file that can be read
    try:
        archive = zipfile.ZipFile(path)
    except untrusted.ZIP_ERRORS as error:
        raise ArtifactError(f"{path}: damaged, or not an .npz file: {error}") from None
    if not all(name.endswith(".npy") for name in archive.namelist()):
        raise ArtifactError(f"{path}: not an .npz file: it holds other files than arrays")
    return archive


def _read_members(path: Path, archive: zipfile.ZipFile) -> list[_Member]:
    """Read what the arrays declare; raises `ArtifactError` before anything of a declared size is made."""
    members = []
    for name in archive.namelist():
        members.append(_read_member_header(path, archive, name))
        check_width(path, sum(member.width for member in members))
    return members


def _read_member_header(path: Path, archive: zipfile.ZipFile, name: str) -> _Member:
    try:
        with archive.open(name) as file:
            return _parse_header(name, file)
    except untrusted.ZIP_ERRORS as error:
        raise ArtifactError(f"{path}: {name}: damaged: {error}") from None


def _parse_header(name: str, file: Any) -> _Member:
    version = npy.read_magic(file)
    read = npy.read_array_header_1_0 if version == (1, 0) else npy.read_array_header_2_0
    shape, fortran, dtype = read(file)
    if min(shape, default=0) < 0:
        raise ValueError(f"an array of shape {shape}")
    return _Member(name.removesuffix(".npy"), tuple(shape), fortran, dtype)


def _read_npz(path: Path, used: Collection[str]) -> LogTable:
    columns: dict[str, Array] = {}
    with _open_archive(path) as archive:
        members = _read_members(path, archive)
        members = [one for one in members if any(name in used for name in one.column_names())]
        count = min((one.shape[0] for one in members), default=0)
        for one in members:
            if not count <= one.shape[0] <= count + 1:  # an episode has an observation more than actions
                raise ArtifactError(f"{path}: {one.name} has {one.shape[0]:,} rows, another array {count:,}")
        starts, length = choose_windows(count)
        for one in members:
            part = _read_rows(path, archive, one, starts, length)
            columns |= {name: part[:, index] for index, name in enumerate(one.column_names()) if name in used}
    rows = (np.array(starts)[:, None] + np.arange(length)).ravel()
    check_finite(path, rows, columns)
    note = f"{path}: {len(starts)} parts of {length} of {count:,} rows are read" if len(starts) > 1 else ""
    return LogTable(path, columns, rows, (length,) * len(starts), "row", note)


def check_finite(path: Path, rows: Array, columns: Mapping[str, Array]) -> None:
    """Raise `ArtifactError` for the first value of a column that is not finite; `rows` are its rows' numbers."""
    for name, values in columns.items():
        bad = np.flatnonzero(~np.isfinite(values))
        if bad.size:
            raise ArtifactError(f"{path}, row {rows[bad[0]]}, column {name}: {values[bad[0]]} is not a finite number")


def choose_windows(count: int) -> tuple[Sequence[int], int]:
    """Return the first rows of the parts to read, and their length."""
    if count <= _WHOLE_ROWS:
        return [0], count
    return np.linspace(0, count - _WINDOW_ROWS, _WINDOWS).astype(int).tolist(), _WINDOW_ROWS


def _read_rows(path: Path, archive: zipfile.ZipFile, one: _Member, starts: Sequence[int], length: int) -> Array:
    """Read parts of an array, shape (rows, columns), without holding the rest in memory."""
    width = one.shape[1] if len(one.shape) == 2 else 1
    if one.fortran and width > 1 and one.shape[0] > _WHOLE_ROWS:
        raise ArtifactError(f"{path}: {one.name} is stored by column and too large; save it as np.ascontiguousarray")
    row_bytes = width * one.dtype.itemsize
    untrusted.check_size(path, len(starts) * length * row_bytes, "unpacked ")
    parts = []
    try:
        with archive.open(f"{one.name}.npy") as file:
            _parse_header(one.name, file)
            position = 0
            if one.fortran and width > 1:
                content = file.read(one.shape[0] * row_bytes)
                return np.frombuffer(content, one.dtype).reshape(width, -1).T[:length].astype(np.float64)
            for start in starts:
                _skip(file, (start - position) * row_bytes)
                parts.append(np.frombuffer(file.read(length * row_bytes), one.dtype).reshape(length, width))
                position = start + length
    except untrusted.ZIP_ERRORS as error:
        raise ArtifactError(f"{path}: {one.name}: damaged: {error}") from None
    return np.concatenate(parts).astype(np.float64)


def _skip(file: Any, count: int) -> None:
    while count > 0 and (read := len(file.read(min(count, 2**20)))):
        count -= read
