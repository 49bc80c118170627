"""What a server records: its measurements, its event log as rotated JSON lines, and its Rerun recording."""

import collections
import contextlib
import datetime
import json
import logging
import logging.handlers
import os
import resource
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from rlctl.errors import ArtifactError, short_repr
from rlctl.limits.bounds import Intervention, SafetyEvent
from rlctl.play.remote_messages import as_json

_WINDOW = 4096  # requests from which quantiles are computed


class Durations:
    """The most recent durations, for quantiles; count and sum of all."""

    def __init__(self) -> None:
        self._values: collections.deque[float] = collections.deque(maxlen=_WINDOW)
        self.count = 0
        self.sum_s = 0.0

    def add(self, seconds: float) -> None:
        """Add a duration."""
        self._values.append(seconds)
        self.count += 1
        self.sum_s += seconds

    def quantiles(self) -> dict[str, float]:
        """Return the median and the 99 % quantile of the recent durations [s]; zeros if there are none."""
        median, high = np.quantile(list(self._values) or [0.0], (0.5, 0.99)).tolist()
        return {"0.5": median, "0.99": high}


class Measurements:
    """Counts and durations of all clients together."""

    def __init__(self) -> None:
        self.inference, self.request = Durations(), Durations()
        self.errors = self.deadline_misses = self.connections = self.refused = self.policy_changes = 0
        self.control_error = float("nan")
        self.spread: float | None = None

    def format_prometheus(self, states: collections.Counter[str], interventions: collections.Counter[str]) -> str:
        """Return all measurements in Prometheus' text format, with the number of clients per state."""
        lines: list[str] = []

        def add(name: str, kind: str, text: str, *samples: tuple[str, float]) -> None:
            lines.append(f"# HELP rlctl_{name} {text}")
            lines.append(f"# TYPE rlctl_{name} {kind}")
            lines.extend(f"rlctl_{name}{labels} {value:.9g}" for labels, value in samples)

        for name, durations, text in (
            ("inference", self.inference, "Time of a policy's inference."),
            ("request", self.request, "Time from a request's arrival to its answer."),
        ):
            quantiles = [(f'{{quantile="{key}"}}', value) for key, value in durations.quantiles().items()]
            add(f"{name}_seconds", "summary", text, *quantiles)
            lines.append(f"rlctl_{name}_seconds_sum {durations.sum_s:.9g}")
            lines.append(f"rlctl_{name}_seconds_count {durations.count}")
        add("errors_total", "counter", "Requests with an invalid observation.", ("", self.errors))
        add("deadline_misses_total", "counter", "Requests longer than control_dt.", ("", self.deadline_misses))
        add("clients", "gauge", "Connected WebSocket clients.", ("", states.total() - 1))
        add("connections_total", "counter", "Connections so far.", ("", self.connections))
        add("refused_total", "counter", "Refused connections and requests.", ("", self.refused))
        add("policy_changes_total", "counter", "Replacements of the policy.", ("", self.policy_changes))
        states_now = [(f'{{state="{state}"}}', states[state]) for state in ("idle", "running", "holding", "stopped")]
        add("state", "gauge", "Clients by state.", *states_now)
        counts = [(f'{{name="{_escape(name)}"}}', count) for name, count in sorted(interventions.items())]
        add("interventions_total", "counter", "How often each limit and fault occurred.", *counts)
        add("control_error", "gauge", "Largest difference between a joint and its command.", ("", self.control_error))
        if self.spread is not None:
            add("action_spread", "gauge", "Mean standard deviation of the policy's actions.", ("", self.spread))
        add("process_cpu_seconds_total", "counter", "Processor time.", ("", time.process_time()))
        add("process_resident_memory_bytes", "gauge", "Memory.", ("", read_memory()))
        return "\n".join(lines) + "\n"


def _escape(text: str) -> str:
    return text.replace("\\", "\\\\").replace('"', '\\"').replace("\n", " ")


def read_memory() -> int:
    """Return the memory of this process [bytes]; its peak on systems without /proc."""
    try:
        return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    except OSError:
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


_MAX_FILE_SIZE = 10_000_000  # [bytes]
_OLD_FILES = 3
_REPEAT_S = 1.0
_MAX_NAMES = 1000
_MAX_ROWS = 100_000  # that wait for the next `flush`


class EventLog:
    """Writes events as JSON lines; without a file it writes nothing.

    A repeated limit or fault of a client is written at most once per second, with its count since the last line.
    Raises `ArtifactError` for a file that cannot be written.
    """

    def __init__(self, file: Path | None, *, max_file_size: int = _MAX_FILE_SIZE) -> None:
        self._handler: logging.Handler = logging.NullHandler()
        self._repeated: dict[tuple[int, str], tuple[float, int]] = {}
        if file is None:
            return
        try:
            file.parent.mkdir(parents=True, exist_ok=True)
            self._handler = _Handler(file, maxBytes=max_file_size, backupCount=_OLD_FILES, encoding="utf-8")
        except OSError as error:
            raise ArtifactError(f"{file}: the log cannot be written: {error.strerror or error}") from None

    def write(self, kind: str, client: int | None = None, *, time_s: float | None = None, **fields: Any) -> None:
        """Write an event with its time, `time_s` [s since 1970] or now."""
        at = datetime.datetime.fromtimestamp(time.time() if time_s is None else time_s, datetime.UTC)
        line = {"time": at.isoformat(timespec="milliseconds"), "kind": kind, "client": client, **fields}
        text = json.dumps(as_json({key: value for key, value in line.items() if value not in (None, "")}))
        self._handler.emit(logging.LogRecord("rlctl", logging.INFO, "", 0, text, None, None))

    def write_event(self, client: int, event: SafetyEvent | Intervention) -> None:
        """Write the events of a safety filter."""
        counts = dict.fromkeys(event.names, 1) if event.kind == "state" else self._count(client, event.names)
        if counts:
            for record in event.list_events():
                if (count := counts.get(record.name)) is not None:
                    fields = {"name": record.name, "value": record.value, "limit": record.limit}
                    self.write(record.kind, client, time_s=record.time_s, **fields, count=count)

    def _count(self, client: int, names: Sequence[str]) -> dict[str, int]:
        """Return the events to write now, with their counts since they were last written."""
        due, now = {}, time.monotonic()
        for name in names:
            written, waiting = self._repeated.get((client, name), (-_REPEAT_S, 0))
            if now - written < _REPEAT_S:
                self._repeated[client, name] = written, waiting + 1
                continue
            if len(self._repeated) >= _MAX_NAMES:
                self._repeated.clear()
            self._repeated[client, name] = now, 0
            due[name] = waiting + 1
        return due

    def close(self) -> None:
        """Close the file."""
        self._handler.close()


class _Handler(logging.handlers.RotatingFileHandler):
    _warned = False

    def handleError(self, record: logging.LogRecord) -> None:
        # On a full disk the server continues and warns once.
        if not self._warned:
            self._warned = True
            print(f"warning: {self.baseFilename}: cannot write to the log: {sys.exception()}", file=sys.stderr)


class RerunLog:
    """Writes rows in batches, which costs a thousandth; raises `ArtifactError` if the file cannot be written."""

    def __init__(self, file: Path) -> None:
        import rerun as rr  # takes a second

        self._rerun = rr
        self._rows: collections.deque[tuple[str, float, Any]] = collections.deque(maxlen=_MAX_ROWS)
        self._file, self._warned = file, False
        self._stream = rr.RecordingStream("rlctl serve")
        try:
            file.parent.mkdir(parents=True, exist_ok=True)
            file.open("ab").close()
            self._stream.save(file)
        except (OSError, RuntimeError) as error:
            reason = getattr(error, "strerror", None) or error
            raise ArtifactError(f"{file}: the recording cannot be written: {reason}") from None

    def add(self, entity: str, values: Any, time_s: float) -> None:
        """Add numbers at a time [s since 1970]; the oldest are dropped if too many rows wait for `flush`."""
        self._rows.append((entity, time_s, values))

    def flush(self) -> None:
        """Write the collected rows; any thread may call this."""
        rows = collections.defaultdict[str, list[tuple[float, Any]]](list)
        with contextlib.suppress(IndexError):  # nothing is left
            while True:
                entity, second, values = self._rows.popleft()
                rows[entity].append((second, np.ravel(values)))
        try:
            for entity, samples in rows.items():
                times, columns = (np.array(column, np.float64) for column in zip(*samples, strict=True))
                index = self._rerun.TimeColumn("time", timestamp=times)
                self._stream.send_columns(entity, [index], self._rerun.Scalars.columns(scalars=columns))
            self._stream.flush()
        except RuntimeError as error:  # what Rerun raises when the disk is full
            if not self._warned:
                self._warned = True
                print(f"warning: {self._file}: the recording has gaps: {short_repr(str(error))}", file=sys.stderr)

    def close(self) -> None:
        """Write the remaining rows and close the file."""
        self.flush()
        self._stream.disconnect()
