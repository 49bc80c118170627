"""SB3's logger, writing TensorBoard files; a full disk or a removed file costs that log, not the training."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

from stable_baselines3.common.logger import KVWriter, Logger, TensorBoardOutputFormat
from torch.utils.tensorboard.writer import SummaryWriter


class _Format(TensorBoardOutputFormat):
    def __init__(self, folder: Path, first_step: int) -> None:
        # What was written of these steps before, by an earlier process for example, is not shown twice.
        self.writer = SummaryWriter(log_dir=str(folder), purge_step=first_step or None)
        self._is_closed = False

    @property
    def file(self) -> Path:
        assert self.writer.file_writer is not None  # it is there until the writer is closed
        name: str | bytes = self.writer.file_writer.event_writer._file_name
        return Path(name if isinstance(name, str) else name.decode())


class _TensorBoard(KVWriter):
    """Begins another file whenever the one before is gone or was not written whole."""

    def __init__(self, folder: Path, warn: Callable[[str], None], first_step: int) -> None:
        self._folder = folder
        self._warn = warn
        self._problem = ""
        self._format: _Format | None = None
        self._attempt(lambda: self._open(first_step))

    def _open(self, first_step: int) -> _Format:
        if self._format is None or not self._format.file.exists():
            self.close()
            self._folder.mkdir(parents=True, exist_ok=True)
            self._format = _Format(self._folder, first_step)
        return self._format

    def write(self, key_values: dict[str, Any], key_excluded: Mapping[str, tuple[str, ...]], step: int = 0) -> None:
        self._attempt(lambda: self._open(step).write(key_values, dict(key_excluded), step))

    def _attempt(self, write: Callable[[], object]) -> None:
        try:
            write()
        except OSError as error:
            problem = error.strerror or str(error)
            if problem != self._problem:
                self._warn(f"warning: not saved: TensorBoard log: {problem}; metrics.csv has the same numbers")
            self._problem = problem
            self.close()
        else:
            self._problem = ""

    def close(self) -> None:
        before, self._format = self._format, None
        if before is not None:
            with contextlib.suppress(OSError):  # reported when it happened first
                before.close()


@contextlib.contextmanager
def silence_writer_thread() -> Iterator[None]:
    """Silence errors of TensorBoard's own thread: `write` raises them again, and that is reported."""
    before = threading.excepthook

    def hook(arguments: threading.ExceptHookArgs) -> None:
        if not isinstance(arguments.exc_value, OSError):
            before(arguments)

    threading.excepthook = hook
    try:
        yield
    finally:
        threading.excepthook = before


def make_logger(folder: Path, warn: Callable[[str], None], first_step: int = 0) -> Logger:
    """Return a logger that writes to a TensorBoard folder from a step on; `warn` is called if it cannot."""
    return Logger(str(folder), [_TensorBoard(folder, warn, first_step)])
