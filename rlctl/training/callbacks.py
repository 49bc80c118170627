"""Callbacks: the user's classes that are called during a training, see `docs/callbacks.md`. Imports no torch."""

from __future__ import annotations

import collections
import contextlib
import copy
import functools
import inspect
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rlctl.environments.dict_spaces import join
from rlctl.environments.registry import call_plugin
from rlctl.errors import TaskError
from rlctl.play.messages import EpisodeResult
from rlctl.play.shared_arrays import SegmentArrays

if TYPE_CHECKING:
    from rlctl.recipe.recipe import Recipe
    from rlctl.runs.directory import RunDirectory
    from rlctl.training.display import Display
    from rlctl.training.learner import Learner
    from rlctl.training.snapshot import Tensors

_SCHEDULES = {"learning_rate": "lr_schedule", "clip_range": "clip_range"}  # attribute of SB3's model by parameter
_NUMBERS = ("ent_coef", "vf_coef")  # PPO and A2C read them at each update; SAC reads its `ent_coef` only at the start
_REFERENCES = ("model", "locals", "globals", "parent", "pbar")  # attributes of SB3's callbacks that are no state
_WATCHED = ("learning_rate", "lr_schedule", "clip_range", "ent_coef", "vf_coef", "target_kl", "gamma", "tau")
"""Attributes of the model that a callback of SB3 may replace; checkpoints store only those that are plain data."""


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
    def is_at_end(self) -> bool:
        """Whether no step follows: this is the last boundary."""
        return self._learner.is_at_end

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
        """Called when a checkpoint was written. When depends on the clock, so do not change the training here."""

    def on_end(self, training: Training) -> None:
        """Called when the training is done and everything is written."""

    def state_dict(self) -> dict[str, Any]:
        """Return what a checkpoint stores."""
        return {name: value for name, value in vars(self).items() if not name.startswith("_")}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what `state_dict` returned."""
        vars(self).update(state)


class Observer(Callback):
    """A callback of rlctl itself, which changes nothing in the training. Checkpoints do not store it."""

    @contextlib.contextmanager
    def follow(self, run: RunDirectory, recipe: Recipe, display: Display) -> Iterator[None]:
        """Entered when the run folder is ready, before the first step, and left after the last or after an error."""
        yield


def call_callback(name: str, call: Callable[[], Any], doing: str = "") -> Any:
    """Call code of a callback; raises `TaskError` for any exception."""
    try:
        return call_plugin(name, call, doing)
    except TaskError as error:
        raise TaskError(f"callback{str(error).removeprefix('task')}", details=error.details) from error.__cause__


class Callbacks:
    """Calls the callbacks of a training, in the order of the recipe."""

    def __init__(
        self,
        callbacks: Mapping[str, Callback],
        learner: Learner,
        folder: Path,
        warn: Callable[[str], None],
        observers: Sequence[Observer] = (),
    ) -> None:
        self.running = ""  # name and moment of the callback that is running
        self._callbacks = callbacks
        self._observers = observers
        self._training = Training(learner, folder)
        self._progress = learner.progress
        self._warn = functools.cache(warn)  # each warning once

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
        """Call a method of all observers and callbacks, such as `on_end`."""
        for observer in self._observers:
            getattr(observer, moment)(self._training)
        for name, callback in self._callbacks.items():
            self.running = f"callback {name}, {moment}"
            try:
                method = functools.partial(_call_method, callback, moment, self._training)
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
            if unsaved:
                self._warn(f"warning: {problem}; a resume will not be bit-exact; see docs/callbacks.md")
        return tensors, entries

    def restore(self, tensors: Tensors, entries: Sequence[Mapping[str, Any]]) -> list[str]:
        """Restore what `take` returned; return the reasons why the resume is not bit-exact."""
        from rlctl.training.snapshot import unflatten

        for (name, callback), entry in zip(self._callbacks.items(), entries, strict=False):
            state = {key: unflatten(structure, tensors) for key, structure in entry["state"].items()}
            load = functools.partial(_call_method, callback, "load_state_dict", state)
            call_callback(name, load, "load_state_dict: ")
        self._training.apply_parameters()
        return [entry["inexact"] for entry in entries if entry.get("inexact")]


def _call_method(callback: Callback, method: str, argument: Any) -> None:
    getattr(callback, method)(argument)  # looked up here, where errors of the user's class are caught


class Sb3Callback(Callback):
    """Calls a callback of Stable-Baselines3 after each segment and its updates, once per step of all environments."""

    def __init__(self, callback: Any) -> None:
        self._callback = callback
        self._model: Any = None
        self._episodes: collections.deque[dict[str, float]] = collections.deque(maxlen=100)
        self._changed: set[str] = set()

    def on_start(self, training: Training) -> None:
        """Call `on_training_start`."""
        self._model = training.model
        self._callback.init_callback(self._model)
        self._callback.on_training_start({"self": self._model, "total_timesteps": training.recipe.total_timesteps}, {})

    def on_segment(self, training: Training) -> None:
        """Call `on_rollout_start`, `on_step` for each step, and `on_rollout_end`."""
        model, segment = self._model, training.segment
        assert segment is not None  # a segment has just ended
        steps, before = training.steps, {name: vars(model).get(name) for name in _WATCHED}
        kept, model.ep_info_buffer = model.ep_info_buffer, self._episodes
        self._callback.on_rollout_start()
        n_envs, length = segment.reward.shape
        for step in range(length):
            model.num_timesteps = steps - (length - 1 - step) * n_envs
            self._callback.update_locals(self._make_locals(segment, step))
            if not self._callback.on_step():
                training.stop(f"{type(self._callback).__name__} at step {model.num_timesteps:,}")
                break
        model.num_timesteps = steps
        self._callback.on_rollout_end()
        model.ep_info_buffer = kept
        self._changed |= {name for name, value in before.items() if vars(model).get(name) is not value}

    def _make_locals(self, segment: SegmentArrays, step: int) -> dict[str, Any]:
        """Return the variables of SB3's loop that callbacks read; observations and rewards are not normalised."""
        timeouts = segment.truncated[:, step] & ~segment.terminated[:, step]
        infos: list[dict[str, Any]] = [{"TimeLimit.truncated": bool(timeout)} for timeout in timeouts]
        for episode in (episode for episode in segment.ended if episode.row == step):
            final = join({key: rows[episode.env, step] for key, rows in segment.final.items()})
            result = {"r": episode.total_reward, "l": episode.length, "t": 0.0}
            success = {} if episode.success is None else {"is_success": episode.success}
            infos[episode.env] |= {"episode": result, "terminal_observation": final, **success}
            self._episodes.append(result)
        buffer = "rollout_buffer" if hasattr(self._model, "rollout_buffer") else "replay_buffer"
        return {
            "self": self._model,
            "env": self._model.get_env(),
            "n_steps": step,
            "new_obs": join({key: rows[:, step + 1] for key, rows in segment.observation.items()}),
            "actions": segment.stored[:, step],
            "clipped_actions": segment.action[:, step],
            "rewards": segment.reward[:, step],
            "dones": segment.done[:, step],
            "infos": infos,
            buffer: getattr(self._model, buffer),
        }

    def on_end(self, training: Training) -> None:
        """Call `on_training_end`."""
        self._callback.on_training_end()

    def state_dict(self) -> dict[str, Any]:
        """Return the attributes of the callback and of those in it, by their path, and what it changed in the model."""
        state = {f"model.{name}": vars(self._model).get(name) for name in sorted(self._changed)}
        for path, callback in _walk(self._callback, "callback"):
            state |= {
                f"{path}.{name}": value
                for name, value in vars(callback).items()
                if name not in _REFERENCES and not inspect.isroutine(value) and not _list_nested(value)
            }
        return {**state, "episodes": list(self._episodes)}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what `state_dict` returned."""
        self._episodes.extend(state.pop("episodes"))
        owners: dict[str, Any] = dict(_walk(self._callback, "callback"))
        for path, value in state.items():
            owner, _, name = path.rpartition(".")
            if owner == "model" and name in _WATCHED:  # a file must not choose other attributes
                self._changed.add(name)
                setattr(self._model, name, value)
            elif name in vars(owners[owner]):
                setattr(owners[owner], name, value)


def is_of_sb3(cls: type) -> bool:
    """Return whether a class is a callback of Stable-Baselines3, which is not imported for this."""
    return any(base.__module__ == "stable_baselines3.common.callbacks" for base in cls.__mro__)


def _list_nested(value: Any) -> list[Any]:
    return [item for item in (value if isinstance(value, list) else [value]) if is_of_sb3(type(item))]


def _walk(callback: Any, path: str) -> Iterator[tuple[str, Any]]:
    yield path, callback
    for name, value in vars(callback).items():
        if name not in _REFERENCES:
            for number, nested in enumerate(_list_nested(value)):
                yield from _walk(nested, f"{path}.{name}.{number}")
