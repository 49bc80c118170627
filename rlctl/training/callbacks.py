"""Callbacks: the user's classes that are called during a training, see `docs/callbacks.md`. Imports no torch."""

from __future__ import annotations

import copy
import functools
import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rlctl.environments.plugin_code import call_plugin
from rlctl.errors import TaskError
from rlctl.rollout.messages import EpisodeResult

if TYPE_CHECKING:
    from rlctl.rollout.shared_arrays import SegmentArrays
    from rlctl.training.learner import Learner
    from rlctl.training.snapshot import Tensors

_SCHEDULES = {"learning_rate": "lr_schedule", "clip_range": "clip_range"}  # attribute of SB3's model by parameter
_NUMBERS = ("ent_coef", "vf_coef")
"""Parameters that PPO and A2C read at each update; SAC reads its `ent_coef` only at the start."""


class Training:
    """What a callback reads and changes. Steps are environment steps, all environments together."""

    def __init__(self, learner: Learner, folder: Path) -> None:
        self.folder = folder  # the run's folder
        self.recipe = learner.recipe
        self.model = learner.model  # the Stable-Baselines3 model
        self.metrics: Mapping[str, Any] = {}  # in `on_segment`: the row of `metrics.csv` that is due, if any
        self.evaluation: Mapping[str, Any] = {}  # in `on_evaluation`: the row of `evals.csv`
        self.episodes: Sequence[EpisodeResult] = ()  # in `on_segment`: training episodes that ended since the last call
        self._learner = learner

    @property
    def steps(self) -> int:
        """Environment steps so far."""
        return self._learner.steps

    @property
    def policy(self) -> Any:
        """The networks, a torch module."""
        return self.model.policy

    @property
    def segment(self) -> SegmentArrays | None:
        """The last segment: arrays of shape (n_envs, steps, ...); None before the first."""
        return self._learner.env.last_segment

    def log(self, name: str, value: float | None) -> None:
        """Write a number as `callback/NAME` into the next row of `metrics.csv`, and to TensorBoard.

        The first row decides which columns the table has: log None until there is a number.
        """
        self._learner.progress.logged[f"callback/{name}"] = None if value is None else float(value)

    def stop(self, reason: str) -> None:
        """End the training at this boundary; the last policy is evaluated and everything is saved."""
        self._learner.progress.stop_reason = reason

    def set_parameter(self, name: str, value: float) -> None:
        """Set `learning_rate` or `clip_range`, for PPO and A2C also `ent_coef` or `vf_coef`, to a number >= 0."""
        numbers = _NUMBERS if hasattr(self.model, "rollout_buffer") else ()
        known = [name for name in (*_SCHEDULES, *numbers) if hasattr(self.model, name)]
        if name not in known or not (math.isfinite(value) and value >= 0):
            raise ValueError(f"set_parameter({name!r}, {value!r}): set one of {', '.join(known)} to a number >= 0")
        self._learner.progress.parameters[name] = float(value)
        self.apply_parameters()

    def apply_parameters(self) -> None:
        """Set the parameters that callbacks have changed; a resume does so too."""
        for name, value in self._learner.progress.parameters.items():
            schedule = _SCHEDULES.get(name)
            setattr(self.model, schedule or name, (lambda _, value=value: value) if schedule else value)


class Callback:
    """Base class of a user's callback; it overrides the moments that it needs.

    Its attributes are its state. Checkpoints store them, except those whose name begins with `_`, as plain data:
    numbers, texts, arrays, tensors, lists and dicts of these. For others override `state_dict` and `load_state_dict`.
    """

    def on_start(self, training: Training) -> None:
        """Called before the first step, and again after a resume, which then restores the state."""

    def on_segment(self, training: Training) -> None:
        """Called after every segment of steps and its updates, before its row of metrics is written."""

    def on_evaluation(self, training: Training) -> None:
        """Called after every evaluation."""

    def on_checkpoint(self, training: Training) -> None:
        """Called when a checkpoint was written. The clock decides when, so nothing that matters may change here."""

    def on_end(self, training: Training) -> None:
        """Called when the training is done and everything is written."""

    def state_dict(self) -> dict[str, Any]:
        """Return what a checkpoint stores."""
        return {name: value for name, value in vars(self).items() if not name.startswith("_")}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what `state_dict` returned."""
        vars(self).update(state)


def call_callback(name: str, call: Callable[[], Any], doing: str = "") -> Any:
    """Call code of a callback; raises `TaskError` for any exception."""
    try:
        return call_plugin(name, call, doing)
    except TaskError as error:
        raise TaskError(f"callback{str(error).removeprefix('task')}", details=error.details) from error.__cause__


class Callbacks:
    """Calls the callbacks of a training, in the order of the recipe."""

    def __init__(
        self, callbacks: Mapping[str, Callback], learner: Learner, folder: Path, warn: Callable[[str], None]
    ) -> None:
        self.running = ""  # name and moment of the callback that is running
        self._callbacks = callbacks
        self._training = Training(learner, folder)
        self._progress = learner.progress
        self._warn = warn
        self._reported: set[str] = set()

    def start(self, resumed_at: int | None = None) -> None:
        """Call `on_start`; a checkpoint of the step `resumed_at` is restored afterwards."""
        restored = copy.deepcopy(vars(self._progress))
        self._training.model.num_timesteps = resumed_at or 0
        self.call("on_start")
        if resumed_at is not None:
            vars(self._progress).update(restored)

    def finish_segment(self, row: Mapping[str, Any], episodes: Sequence[EpisodeResult]) -> None:
        """Call `on_segment`; `row` is the row of metrics that is due."""
        if self._training.steps > self._progress.last_segment:
            self._training.metrics, self._training.episodes = row, episodes
            self.call("on_segment")
            self._progress.last_segment = self._training.steps

    def finish_evaluation(self, row: Mapping[str, Any]) -> None:
        """Call `on_evaluation` with the row of `evals.csv`."""
        self._training.evaluation = row
        self.call("on_evaluation")

    def call(self, moment: str) -> None:
        """Call a method of all callbacks, such as `on_end`."""
        for name, callback in self._callbacks.items():
            self.running = f"callback {name}, {moment}"
            try:
                method = functools.partial(getattr(callback, moment), self._training)
                call_callback(name, method, f"{moment} at step {self._training.steps:,}: ")
            finally:
                self.running = ""

    def take(self) -> tuple[Tensors, list[dict[str, Any]]]:
        """Return the state of all callbacks; what is not plain data is left out, with a warning."""
        from rlctl.training.snapshot import flatten

        tensors: Tensors = {}
        entries: list[dict[str, Any]] = []
        for number, (name, callback) in enumerate(self._callbacks.items()):
            structure, unsaved = {}, []
            for key, value in call_callback(name, callback.state_dict, "state_dict: ").items():
                try:
                    arrays, structure[key] = flatten(value, f"callbacks/{number}/{key}")
                    tensors |= arrays
                except TypeError:
                    unsaved.append(f"{key} is a {type(value).__name__}")
            problem = f"callback {name}: its {', its '.join(unsaved)}, which a checkpoint does not store"
            entries.append({"state": structure, "inexact": problem if unsaved else ""})
            if unsaved and problem not in self._reported:
                self._reported.add(problem)
                self._warn(f"warning: {problem}; a resume will not be bit-exact; see docs/callbacks.md")
        return tensors, entries

    def restore(self, tensors: Tensors, entries: Sequence[Mapping[str, Any]]) -> list[str]:
        """Restore what `take` returned; return the reasons why the resume is not bit-exact."""
        from rlctl.training.snapshot import unflatten

        for (name, callback), entry in zip(self._callbacks.items(), entries, strict=False):
            state = {key: unflatten(structure, tensors) for key, structure in entry["state"].items()}
            call_callback(name, functools.partial(callback.load_state_dict, state), "load_state_dict: ")
        self._training.apply_parameters()
        return [entry["inexact"] for entry in entries if entry.get("inexact")]
