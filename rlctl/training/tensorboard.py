"""SB3's logger, which writes TensorBoard's event files; if it cannot write, the training continues."""

import contextlib
import os
import platform
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from stable_baselines3.common.logger import Logger, TensorBoardOutputFormat
from tensorboard.compat.proto.event_pb2 import Event, SessionLog
from tensorboard.compat.proto.summary_pb2 import Summary
from tensorboard.summary.writer.record_writer import RecordWriter
from torch.utils.tensorboard.summary import histogram, hparams

from rlctl.recipe.recipe import Recipe

_BINS = 40
_COMPARED = ("eval/success_rate", "eval/mean_reward", "eval/mean_ep_length")


class _EventFile(TensorBoardOutputFormat):
    """Writes each event immediately; errors of TensorBoard's own writer, which uses a thread, cannot be caught.

    After a write that failed it starts a new file.
    """

    def __init__(self, folder: Path, warn: Callable[[str], None]) -> None:
        self._folder = folder
        self._warn = warn
        self._problem = ""
        self._file: RecordWriter | None = None

    def write(self, key_values: dict[str, Any], key_excluded: Mapping[str, tuple[str, ...]], step: int = 0) -> None:
        """Write the numbers of a step, and histograms of its tensors."""
        summary = Summary()
        for tag, value in key_values.items():
            if "tensorboard" in (key_excluded.get(tag) or ()):
                continue
            if isinstance(value, torch.Tensor):
                summary.MergeFrom(histogram(tag, value, _BINS))  # type: ignore[no-untyped-call]
            elif isinstance(value, int | float | np.number):
                summary.value.add(tag=tag, simple_value=float(value))
        self.add(Event(step=step, summary=summary))

    def add(self, event: Event) -> None:
        """Write an event; a warning is shown if it cannot be written."""
        event.wall_time = time.time()
        try:
            if self._file is None:
                self._file = self._open()
            self._file.write(event.SerializeToString())
            self._file.flush()
        except OSError as error:
            problem = error.strerror or str(error)
            if problem != self._problem:
                self._warn(f"warning: not saved: TensorBoard log: {problem}; metrics.csv has the same numbers")
            self._problem = problem
            self.close()
        else:
            self._problem = ""

    def _open(self) -> RecordWriter:
        self._folder.mkdir(parents=True, exist_ok=True)
        # TensorBoard reads the files of a folder in the order of their names.
        name = f"events.out.tfevents.{time.time():017.6f}.{platform.node()}.{os.getpid()}"
        file = RecordWriter((self._folder / name).open("wb"))
        file.write(Event(wall_time=time.time(), file_version="brain.Event:2").SerializeToString())
        return file

    def close(self) -> None:
        """Close the file."""
        before, self._file = self._file, None
        if before is not None:
            with contextlib.suppress(OSError):  # already reported
                before.close()


def make_logger(
    folder: Path,
    warn: Callable[[str], None],
    resumed_at: int | None = None,
    parameters: Mapping[str, bool | str | float] | None = None,
) -> Logger:
    """Return a logger that writes to a TensorBoard folder; `warn` is called if it cannot.

    TensorBoard hides what was written after the step `resumed_at`. `parameters` are the hyperparameters of its HPARAMS
    table, which compares runs.
    """
    events = _EventFile(folder, warn)
    if resumed_at is not None:
        events.add(Event(step=resumed_at + 1, session_log=SessionLog(status=SessionLog.START)))
    elif parameters:
        for summary in hparams(dict(parameters), dict.fromkeys(_COMPARED, 0.0)):  # type: ignore[no-untyped-call]
            events.add(Event(summary=summary))
    return Logger(str(folder), [events])


def list_parameters(recipe: Recipe) -> dict[str, bool | str | float]:
    """Return the hyperparameters for TensorBoard: the algorithm, its parameters, seed and size of the training."""
    values: dict[str, Any] = {
        "algo": recipe.algo,
        "seed": recipe.seed,
        "n_envs": recipe.n_envs,
        "total_timesteps": recipe.total_timesteps,
        **recipe.algo_kwargs,
    }
    return {name: value for name, value in values.items() if isinstance(value, bool | str | int | float)}
