"""CSV files to which a training appends rows."""

import csv
import io
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rlctl.storage import files, untrusted


class Table:
    """A CSV file that rows are appended to. If a write fails, the rows stay in memory for the next `flush`.

    `size` is the number of bytes of complete rows; a checkpoint stores it.
    """

    def __init__(self, path: Path) -> None:
        """Open a table; raises `ArtifactError` if the path is not a regular file, which reading could wait for."""
        if path.exists():
            with untrusted.open_file(path):
                pass
        self.path = path
        self.size = _read_size(path)
        self._pending: list[dict[str, Any]] = []

    def cut_back(self, size: int, sha256: str, steps: int) -> bool:
        """Truncate the file to `size` bytes and return True, if they have this digest.

        Otherwise the file was edited: keep its complete rows up to `steps` (the first column) and return False.
        """
        content = self.path.read_bytes()[:size] if self.size else b""
        intact = len(content) == size and (not size or files.digest(content) == sha256)
        if intact and self.size > size:
            files.truncate(self.path, size)
        elif not intact and self.size:
            size = self._keep_rows(steps)
        self.size = min(size, self.size)
        return intact

    def _keep_rows(self, steps: int) -> int:
        """Rewrite the file with its complete rows up to `steps`; return its size in bytes."""
        header, *rows = self.path.read_text(encoding="utf-8", errors="replace").splitlines() or [""]
        whole = [row for row in rows if row.count(",") == header.count(",")]
        lines = [header, *(row for row in whole if _read_first_number(row) <= steps)]
        content = "".join(f"{line}\n" for line in lines).encode()
        files.write_bytes(self.path, content)
        self.size = len(content)
        return self.size

    def digest(self) -> str:
        """Return the sha256 of the first `size` bytes of the file."""
        return files.digest(self.path.read_bytes()[: self.size] if self.size else b"")

    def add(self, row: Mapping[str, Any]) -> None:
        """Add a row for the next `flush`; None becomes an empty field."""
        self._pending.append({key: "" if value is None else value for key, value in row.items()})

    def flush(self, *, sync: bool = False) -> None:
        """Write all pending rows, or raise `OSError` and write none; `sync` also syncs the file to disk."""
        if self._pending:
            # If a user edits or removes the file during a training, rows are lost, but the training continues.
            size = min(self.size, _read_size(self.path))
            content = self._format_rows(self._read_columns() if size else None).encode()
            files.append(self.path, content, size)
            self.size, self._pending = size + len(content), []
        if sync and self.size:
            files.sync(self.path)

    def _read_columns(self) -> list[str]:
        with self.path.open(encoding="utf-8", errors="replace") as file:
            return next(csv.reader([file.readline()]), [])

    def _format_rows(self, columns: list[str] | None) -> str:
        text = io.StringIO()
        names = columns or list(self._pending[0])
        writer = csv.DictWriter(text, names, restval="", extrasaction="ignore", lineterminator="\n")
        if columns is None:
            writer.writeheader()
        writer.writerows(self._pending)
        return text.getvalue()


def _read_first_number(row: str) -> float:
    try:
        return float(row.partition(",")[0])
    except ValueError:
        return math.inf


def _read_size(path: Path) -> int:
    return path.stat().st_size if path.exists() else 0
