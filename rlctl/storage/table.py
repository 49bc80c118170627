"""Tables that grow: CSV files to which a training appends rows."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rlctl.storage import files


class Table:
    """A CSV file that grows by rows. Rows that the disk does not take are kept, and written by a later `flush`.

    `size` is how many bytes of the file are rows of ours, and whole: a checkpoint remembers it.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.size = _read_size(path)
        self._waiting: list[dict[str, Any]] = []

    def cut_back(self, size: int) -> bool:
        """Forget what came after the first `size` bytes; False if the file is shorter than that."""
        if self.size > size:
            files.truncate(self.path, size)
        self.size = min(size, self.size)
        return self.size == size

    def digest(self) -> str:
        """Return the sha256 of the first `size` bytes of the file."""
        return files.digest(self.path.read_bytes()[: self.size] if self.size else b"")

    def add(self, row: Mapping[str, Any]) -> None:
        """Add a row, which the next `flush` writes; None becomes an empty field."""
        self._waiting.append({key: "" if value is None else value for key, value in row.items()})

    def flush(self, *, sync: bool = False) -> None:
        """Write the rows that wait; with `sync` down to the disk itself. All of them, or `OSError` and none."""
        if self._waiting:
            # Whoever edits or removes the file while a training runs loses rows, but no more than that.
            size = min(self.size, _read_size(self.path))
            columns = self._read_columns() if size else None
            if columns is not None and next(iter(self._waiting[0])) not in columns:
                files.set_aside(self.path)
                size, columns = 0, None
            content = self._format_rows(columns).encode()
            files.append(self.path, content, size)
            self.size, self._waiting = size + len(content), []
        if sync and self.size:
            files.sync(self.path)

    def _read_columns(self) -> list[str]:
        with self.path.open(encoding="utf-8", errors="replace") as file:
            return next(csv.reader([file.readline()]), [])

    def _format_rows(self, columns: list[str] | None) -> str:
        text = io.StringIO()
        names = columns or list(self._waiting[0])
        writer = csv.DictWriter(text, names, restval="", extrasaction="ignore", lineterminator="\n")
        if columns is None:
            writer.writeheader()
        writer.writerows(self._waiting)
        return text.getvalue()


def _read_size(path: Path) -> int:
    """Return a file's size in bytes; 0 if it is not there."""
    return path.stat().st_size if path.exists() else 0
