"""Tables that grow: CSV files to which a training appends rows."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rlctl.run import files


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
            size = self._count_whole_rows()
            columns = self._read_columns() if size else None
            if size and columns is None:
                files.set_aside(self.path)
                size = 0
            content = self._format_rows(columns).encode()
            files.append(self.path, content, size)
            self.size, self._waiting = size + len(content), []
        if sync and self.size:
            files.sync(self.path)

    def _count_whole_rows(self) -> int:
        """Return how many bytes of the file are rows of ours: fewer than `size` if somebody has cut or edited it."""
        size = min(self.size, _read_size(self.path))
        if not size:
            return 0
        with self.path.open("rb") as file:
            file.seek(size - 1)
            if file.read(1) == b"\n":
                return size
            file.seek(0)
            return file.read(size).rfind(b"\n") + 1

    def _read_columns(self) -> list[str] | None:
        """Return the file's header; None if it is not the one of these rows any more."""
        with self.path.open(newline="", encoding="utf-8", errors="replace") as file:
            try:
                columns = next(csv.reader(file), [])
            except csv.Error:
                return None
        return columns if next(iter(self._waiting[0])) in columns else None

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
    try:
        return path.stat().st_size
    except FileNotFoundError:
        return 0
