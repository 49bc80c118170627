"""Actions, observations and latency of a server's clients as a Rerun recording."""

from __future__ import annotations

import sys
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np

from rlctl.errors import ArtifactError, short_repr

_MOST_ROWS = 100_000  # that wait for the next `flush`


class RerunLog:
    """Collects rows and writes them together, which costs a thousandth of writing each.

    Raises `ArtifactError` for a file that cannot be written.
    """

    def __init__(self, file: Path) -> None:
        import rerun as rr  # takes a second

        self._rerun = rr
        self._rows: dict[str, list[tuple[float, Any]]] = {}
        self._count = 0
        self._file, self._warned = file, False
        self._lock = threading.Lock()
        self._stream = rr.RecordingStream("rlctl serve")
        try:
            file.parent.mkdir(parents=True, exist_ok=True)
            file.open("ab").close()
            self._stream.save(file)
        except (OSError, RuntimeError) as error:
            reason = getattr(error, "strerror", None) or error
            raise ArtifactError(f"{file}: the recording cannot be written: {reason}") from None

    def add(self, entity: str, values: Any) -> None:
        """Add some numbers of now; what comes faster than it can be written is dropped."""
        with self._lock:
            if self._count < _MOST_ROWS:
                self._count += 1
                self._rows.setdefault(entity, []).append((time.time(), values))

    def flush(self) -> None:
        """Write what was added; may be called in another thread."""
        with self._lock:
            rows, self._rows, self._count = self._rows, {}, 0
        try:
            for entity, each in rows.items():
                times = np.array([second for second, _ in each])
                index = self._rerun.TimeColumn("time", timestamp=times)
                values = np.array([np.ravel(value) for _, value in each], np.float64)
                self._stream.send_columns(entity, [index], self._rerun.Scalars.columns(scalars=values))
            self._stream.flush()
        except RuntimeError as error:  # what Rerun raises when the disk is full
            if not self._warned:
                self._warned = True
                print(f"warning: {self._file}: the recording has gaps: {short_repr(str(error))}", file=sys.stderr)

    def close(self) -> None:
        """Write what is left and close the file."""
        self.flush()
        self._stream.disconnect()
