"""The rows of `metrics.csv`, and the same numbers for TensorBoard and the display."""

import contextlib
import functools
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

from rlctl.play.messages import EpisodeResult
from rlctl.recipe.recipe import ON_POLICY, Recipe
from rlctl.training import measurements
from rlctl.training.checkpoints import Checkpoints
from rlctl.training.display import Display
from rlctl.training.learner import Learner
from rlctl.training.snapshot import check_finite

_OFF_POLICY_ROWS = 200  # approximate number of rows: off-policy updates come at every step


class Metrics:
    """Collects finished training episodes, and writes a row about them and the updates."""

    def __init__(self, learner: Learner, checkpoints: Checkpoints, display: Display) -> None:
        self._learner = learner
        self._checkpoints = checkpoints
        self._display = display
        self._last_row_s, self._last_row_steps = time.monotonic(), learner.steps

    def collect_finished_episodes(self) -> list[EpisodeResult]:
        """Take finished episodes from the environments and return them; count observations outside their space."""
        env, progress = self._learner.env, self._learner.progress
        finished, env.ended = env.ended, []
        progress.recent += finished
        self._learner.curriculum.count(finished)
        if env.outside and not progress.observations_outside:
            self._display.message(f"warning: {env.outside_message}; such observations are counted and used unchanged")
        progress.observations_outside += env.outside
        env.outside = 0
        return finished

    def is_due(self) -> bool:
        """Return whether to write a row: after every rollout of an on-policy algorithm, else at intervals."""
        return self._learner.recipe.algo in ON_POLICY or self._learner.steps >= self._learner.progress.next_row

    def measure(self) -> dict[str, Any]:
        """Return the row about the steps since the last one; empty if there were none."""
        learner, progress = self._learner, self._learner.progress
        steps, logger, env = learner.steps, learner.model.logger, learner.env
        if steps <= progress.last_row:
            return {}
        check_finite(learner.model, self._checkpoints.run.path)
        now = time.monotonic()
        elapsed_s = max(now - self._last_row_s, 1e-9)
        recent, progress.recent = progress.recent, []
        row = {
            "steps": steps,
            "seconds": round(learner.seconds, 3),
            "fps": round((steps - self._last_row_steps) / elapsed_s, 1),
            "playing": round(env.waited_s / elapsed_s, 3),
            **learner.curriculum.columns(),
            **({"level": round(float(env.levels.mean()), 4)} if learner.curriculum.has_levels else {}),
            **measurements.training_row(recent, env.workers.info.reward_weights, logger.name_to_value),
            **measurements.measure(learner.model, env, progress.last_row, learner.recipe.total_timesteps),
        }
        self._last_row_s, self._last_row_steps, env.waited_s = now, steps, 0.0
        return row

    def write(self, row: dict[str, Any]) -> None:
        """Write a row of `measure`, and what callbacks have logged, to `metrics.csv` and TensorBoard."""
        learner, progress, logger = self._learner, self._learner.progress, self._learner.model.logger
        logged, progress.logged = progress.logged, {}
        row |= logged
        self._checkpoints.row(self._checkpoints.metrics, row)
        for name, value in (measurements.tensorboard_values(row) | logged).items():
            logger.record(name, value)
        learner.model.dump_logs()
        self._display.metrics(row)
        progress.last_row = learner.steps
        progress.next_row = learner.steps + max(1, learner.recipe.total_timesteps // _OFF_POLICY_ROWS)

    def exclude(self, seconds: float) -> None:
        """Exclude the time of an evaluation from the training rate."""
        self._last_row_s += seconds


_BINS = 40
_COMPARED = ("eval/success_rate", "eval/mean_reward", "eval/mean_ep_length")


class _EventFile(TensorBoardOutputFormat):
    """Writes each event at once: errors of TensorBoard's own thread cannot be caught. Then it starts a new file."""

    def __init__(self, folder: Path, warn: Callable[[str], None]) -> None:
        self._folder = folder
        self._warn = functools.cache(warn)  # each warning once
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
            self._warn(f"warning: not saved: TensorBoard log: {problem}; metrics.csv has the same numbers")
            self.close()

    def _open(self) -> RecordWriter:
        self._folder.mkdir(parents=True, exist_ok=True)
        # TensorBoard reads the files of a folder in the order of their names.
        name = f"events.out.tfevents.{time.time():017.6f}.{platform.node()}.{os.getpid()}"
        file = RecordWriter((self._folder / name).open("wb"))
        file.write(Event(wall_time=time.time(), file_version="brain.Event:2").SerializeToString())
        return file

    def close(self) -> None:
        """Close the file."""
        with contextlib.suppress(OSError):  # already reported
            if self._file is not None:
                self._file.close()
        self._file = None


def make_logger(
    folder: Path, warn: Callable[[str], None], resumed_at: int | None = None, recipe: Recipe | None = None
) -> Logger:
    """Return a logger that writes to a TensorBoard folder; `warn` is called if it cannot.

    TensorBoard hides what was written after the step `resumed_at`; its HPARAMS table has values of the recipe.
    """
    events = _EventFile(folder, warn)
    if resumed_at is not None:
        events.add(Event(step=resumed_at + 1, session_log=SessionLog(status=SessionLog.START)))
    elif recipe is not None:
        names = ("algo", "seed", "n_envs", "total_timesteps")
        values = {name: getattr(recipe, name) for name in names} | recipe.algo_kwargs
        parameters = {name: value for name, value in values.items() if isinstance(value, bool | str | int | float)}
        for summary in hparams(parameters, dict.fromkeys(_COMPARED, 0.0)):  # type: ignore[no-untyped-call]
            events.add(Event(summary=summary))
    return Logger(str(folder), [events])
