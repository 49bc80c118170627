"""The tables of a run: `metrics.csv` and `evals.csv`, read while a training may still append to them."""

import csv
import io
import math
from collections.abc import Iterable
from pathlib import Path

from rlctl.errors import ArtifactError
from rlctl.storage import untrusted

TableRows = list[dict[str, float | None]]  # of a table, oldest first; an empty field is None
LARGEST = 1e100  # larger numbers are ignored: plots and sums would overflow


def read_table(path: Path) -> TableRows:
    """Return a table's rows with numbers; rows cut short by a killed process or without numbers are left out.

    Infinite and absurdly large values are None. Raises `ArtifactError` for what is not a table.
    """
    if not path.exists():
        return []
    lines = io.StringIO(untrusted.read_bytes(path).decode(errors="replace"), newline="")
    names, *rows = _parse(path, lines) or [[]]
    tables = (dict(zip(names, row, strict=True)) for row in rows if len(row) == len(names))
    return [numbers for row in tables if (numbers := _numbers(row)) is not None and numbers.get("steps") is not None]


def _parse(path: Path, lines: Iterable[str]) -> list[list[str]]:
    try:
        return list(csv.reader(lines))
    except csv.Error as error:  # a field that is too long
        raise ArtifactError(f"{path}: damaged: {error}") from None


def _numbers(row: dict[str, str]) -> dict[str, float | None] | None:
    try:
        numbers = {name: float(value) if value else None for name, value in row.items()}
    except ValueError:
        return None
    return {name: value if value is not None and abs(value) < LARGEST else None for name, value in numbers.items()}


def list_points(rows: TableRows, column: str) -> list[tuple[float, float]]:
    """Return the steps and the values of a column where it has finite ones."""
    pairs = ((row.get("steps"), row.get(column)) for row in rows)
    return [
        (steps, value) for steps, value in pairs if steps is not None and value is not None and math.isfinite(value)
    ]


def last_row(path: Path) -> dict[str, str] | None:
    """Return the last whole row of a table without parsing the others; raises `ArtifactError` as `read_table`."""
    if not path.exists():
        return None
    header, _, rows = untrusted.read_bytes(path).partition(b"\n")
    whole, _, _ = rows.rpartition(b"\n")
    if not whole.strip():
        return None
    names, values = _parse(path, (line.decode(errors="replace") for line in (header, whole.rpartition(b"\n")[2])))
    return dict(zip(names, values, strict=True)) if len(names) == len(values) else None
