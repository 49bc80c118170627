"""A log of what happened, JSON lines, bounded: files are rotated, and what repeats is counted."""

from __future__ import annotations

import datetime
import json
import logging
import logging.handlers
import sys
import time
from pathlib import Path
from typing import Any

from rlctl.deploy.messages import as_json
from rlctl.errors import ArtifactError

_LARGEST = 10_000_000  # [bytes] of one file
_KEPT = 3
_REPEAT_S = 1.0
_MOST_NAMES = 1000


class EventLog:
    """Writes events as JSON lines; without a file nowhere.

    The same limit or fault of a client is written at most once a second, with the number of times since.
    Raises `ArtifactError` for a file that cannot be written.
    """

    def __init__(self, file: Path | None, *, largest: int = _LARGEST) -> None:
        self._handler: _Handler | None = None
        self._repeated: dict[tuple[int, str], tuple[float, int]] = {}
        if file is None:
            return
        try:
            file.parent.mkdir(parents=True, exist_ok=True)
            self._handler = _Handler(file, maxBytes=largest, backupCount=_KEPT, encoding="utf-8")
        except OSError as error:
            raise ArtifactError(f"{file}: the log cannot be written: {error.strerror or error}") from None

    def write(self, kind: str, client: int | None = None, **fields: Any) -> None:
        """Write an event."""
        if self._handler is None:
            return
        count = self._count_repeated(client, fields["name"]) if kind in ("limit", "fault") else 1
        if count == 0:
            return
        now = datetime.datetime.now(datetime.UTC).isoformat(timespec="milliseconds")
        line = {"time": now, "kind": kind, "client": client, **fields, "count": count}
        text = json.dumps(as_json({key: value for key, value in line.items() if value not in (None, "")}))
        self._handler.emit(logging.LogRecord("rlctl", logging.INFO, "", 0, text, None, None))

    def _count_repeated(self, client: int | None, name: str) -> int:
        """Return how often an event occurred since it was written; 0 if it is not to be written again yet."""
        key, now = (client or 0, name), time.monotonic()
        written, waiting = self._repeated.get(key, (-_REPEAT_S, 0))
        if now - written < _REPEAT_S:
            self._repeated[key] = written, waiting + 1
            return 0
        if len(self._repeated) >= _MOST_NAMES:
            self._repeated.clear()
        self._repeated[key] = now, 0
        return waiting + 1

    def close(self) -> None:
        """Close the file."""
        if self._handler is not None:
            self._handler.close()


class _Handler(logging.handlers.RotatingFileHandler):
    _warned = False

    def handleError(self, record: logging.LogRecord) -> None:
        # A full disk does not end a server, nor does it fill the terminal.
        if not self._warned:
            self._warned = True
            error = sys.exception()
            print(f"warning: {self.baseFilename}: the log cannot be written any more: {error}", file=sys.stderr)
