"""Callbacks written for Stable-Baselines3: `on_step` is called for every step of a segment that was played."""

import collections
import inspect
from collections.abc import Iterator
from typing import Any

from rlctl.environments.dict_spaces import join
from rlctl.rollout.shared_arrays import SegmentArrays
from rlctl.training.callbacks import Callback, Training

_REFERENCES = ("model", "locals", "globals", "parent", "pbar")  # attributes that are no state
_WATCHED = ("learning_rate", "lr_schedule", "clip_range", "ent_coef", "vf_coef", "target_kl", "gamma", "tau")
"""Attributes of the model that a callback may replace; checkpoints store only those that are plain data."""


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
        total = training.recipe.total_timesteps
        self._callback.on_training_start({"self": self._model, "total_timesteps": total}, {})

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
