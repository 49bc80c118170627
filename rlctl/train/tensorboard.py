"""SB3's logger, writing TensorBoard files; a full disk costs the log, not the training."""

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
        # What an earlier process wrote of these steps is not shown twice.
        self.writer = SummaryWriter(log_dir=str(folder), purge_step=first_step or None)
        self._is_closed = False


class _TensorBoard(KVWriter):
    def __init__(self, folder: Path, warn: Callable[[str], None], first_step: int) -> None:
        self._format: TensorBoardOutputFormat | None = _Format(folder, first_step)
        self._warn = warn

    def write(self, key_values: dict[str, Any], key_excluded: Mapping[str, tuple[str, ...]], step: int = 0) -> None:
        if self._format is None:
            return
        try:
            self._format.write(key_values, dict(key_excluded), step)
        except OSError as error:
            self._warn(f"warning: no more TensorBoard logs: {error.strerror or error}")
            self._format = None

    def close(self) -> None:
        if self._format is not None:
            self._format.close()
            self._format = None


@contextlib.contextmanager
def writer_errors(warn: Callable[[str], None]) -> Iterator[None]:
    """Tell `warn` when TensorBoard's own thread cannot write, instead of its traceback."""
    before = threading.excepthook

    def hook(arguments: threading.ExceptHookArgs) -> None:
        if isinstance(arguments.exc_value, OSError):
            warn(f"warning: not saved: TensorBoard log: {arguments.exc_value.strerror}")
        else:
            before(arguments)

    threading.excepthook = hook
    try:
        yield
    finally:
        threading.excepthook = before


def make_logger(folder: Path, warn: Callable[[str], None], first_step: int = 0) -> Logger:
    """Return a logger that writes to a TensorBoard folder from a step on; `warn` is told if it cannot."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        return Logger(str(folder), [_TensorBoard(folder, warn, first_step)])
    except OSError as error:
        warn(f"warning: no TensorBoard logs: {folder}: {error.strerror or error}")
        return Logger(str(folder), [])
