"""Records an episode: everything that an untrusted environment returns."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlctl.checking.episode import EpisodePlayer, Moment
from rlctl.checking.instance import EnvironmentRaised, describe_failure
from rlctl.checking.records import MOST_INFOS, CallFailure, CheckedEpisode, Form, Series
from rlctl.checking.values import find_numbers, flatten_action, name_type
from rlctl.environments.leaves import Leaf, pick
from rlctl.environments.success import OTHER_SUCCESS, SUCCESS, find_success


class Recording:
    """An episode that is recorded while it is played: `advance` while `running`, or `run`."""

    def __init__(self, role: str, episode: EpisodePlayer) -> None:
        """`role` is what it is recorded for."""
        self.role, self.episode = role, episode
        self.budget = episode.instance.context.budget
        self.failure: CallFailure | None = None
        self._moments = iter(episode)
        self._ended = ""
        self._step = 0
        self._rewards: list[float] = []
        self._values: dict[int, tuple[list[int], list[Any]]] = {}
        self._is_number: list[bool] = []
        self._taken: list[NDArray[np.float64]] = []
        self._flags: list[tuple[bool, bool]] = []
        self._forms: dict[tuple[Any, ...], list[int]] = {}
        self._infos: dict[str, tuple[list[int], list[float]]] = {}
        self._previous: dict[tuple[str, Any], tuple[Any, NDArray[Any]]] = {}

    def run(self) -> list[CheckedEpisode | CallFailure]:
        """Play the episode to its end; return what to send: the trajectory, and the failure that ended it, if any."""
        while self.running:
            self.advance()
        return [self.trajectory, *([self.failure] if self.failure else [])]

    def advance(self) -> None:
        """Begin the episode, or take its next step."""
        try:
            moment = next(self._moments)
        except EnvironmentRaised as error:
            self._ended = "raised"
            self.failure = describe_failure(error, self.episode.instance.progress)
            self.budget.failures += 1
            return
        self._add(moment)
        self._ended = self.episode.ended or ("memory" if self.budget.bytes_left <= 0 and moment.step else "")

    @property
    def running(self) -> bool:
        """Whether it has not begun, or there is another step to take."""
        return not self._ended

    def _add(self, moment: Moment) -> None:
        self._step = moment.step
        if moment.form:
            self._count_form("step" if moment.step else "reset", moment.form)
        if moment.changes_action:
            self._count_form("action", "changed")
        if not moment.is_readable:
            return
        if moment.step:
            self._count_form("terminated", name_type(moment.terminated))
            self._count_form("truncated", name_type(moment.truncated))
            self._flags.append(moment.flags)
            self._add_reward(moment.reward)
            self._taken.append(flatten_action(self.episode.instance.action_leaves, moment.action))
        self._add_info(moment.info)
        self._add_observation(moment.observation)

    def _count_form(self, what: str, type_name: str, *more: Any) -> None:
        self._forms.setdefault((what, type_name, *more), [self._step, 0])[1] += 1

    def _add_info(self, info: Any) -> None:
        self._count_form("info", name_type(info))
        if isinstance(info, dict):
            for name, value in find_numbers(_name_success(info)):
                if name in self._infos or len(self._infos) < MOST_INFOS:
                    steps, values = self._infos.setdefault(name, ([], []))
                    steps.append(self._step)
                    values.append(value)
            self._compare_info(info)

    def _compare_info(self, info: dict[Any, Any]) -> None:
        for name, value in info.items():
            if isinstance(value, np.ndarray) and value.shape and value.dtype.kind in "biuf":
                self._compare_memory("info memory", name, value, value.copy())

    def _add_reward(self, reward: Any) -> None:
        self._count_form("reward", name_type(reward))
        try:
            self._rewards.append(float(reward))
            self._is_number.append(True)
        except Exception:  # its type is noted, and is a finding
            self._rewards.append(float("nan"))
            self._is_number.append(False)

    def _add_observation(self, observation: Any) -> None:
        for index, leaf in enumerate(self.episode.instance.leaves):
            try:
                value = pick(observation, leaf.path)
            except (LookupError, TypeError):
                self._count_form("observation", "missing", index, None, None)
                continue
            if leaf.supported:
                self._add_leaf(index, leaf, value)
        keys = {leaf.path[0] for leaf in self.episode.instance.leaves if leaf.path}
        if isinstance(observation, dict) and keys and observation.keys() != keys:
            self._count_form("keys", ", ".join(sorted(map(str, observation))))

    def _add_leaf(self, index: int, leaf: Leaf, value: Any) -> None:
        try:
            array = np.array(value)  # a copy: an environment may write into what it returned
        except Exception:  # a ragged list, or an object of its own kind; its type is noted, and is a finding
            self._count_form("observation", name_type(value), index, None, None)
            return
        self._count_form("observation", name_type(value), index, str(array.dtype), array.shape)
        if isinstance(value, np.ndarray) and value.shape:
            self._compare_memory("memory", index, value, array)
        if array.shape == leaf.shape and array.dtype.kind in "biuf":
            steps, values = self._values.setdefault(index, ([], []))
            steps.append(self._step)
            values.append(array)
            self.budget.bytes_left -= array.nbytes + 100

    def _compare_memory(self, what: str, key: Any, value: NDArray[Any], copy: NDArray[Any]) -> None:
        earlier = self._previous.get((what, key))
        if earlier is not None and np.shares_memory(earlier[0], value) and not np.array_equal(*earlier, equal_nan=True):
            name, leaf = ("shared", key) if what == "memory" else (str(key), None)
            self._count_form(what, name, leaf)
        self._previous[what, key] = value, copy

    @property
    def trajectory(self) -> CheckedEpisode:
        """What was recorded."""
        forms = self._forms.items()
        return CheckedEpisode(
            role=self.role,
            episode=self.episode.number,
            seed=self.episode.seed,
            actions=self.episode.actions,
            ended=self._ended or "steps",
            observations={index: _to_series(*recorded) for index, recorded in self._values.items()},
            rewards=np.array(self._rewards, np.float64),
            reward_is_number=np.array(self._is_number, np.bool_),
            terminated=np.array([flag for flag, _ in self._flags], np.bool_),
            truncated=np.array([flag for _, flag in self._flags], np.bool_),
            infos={name: _to_series(*recorded) for name, recorded in self._infos.items()},
            forms=[Form(what, kind, step, count, *more) for (what, kind, *more), (step, count) in forms],
            taken=np.stack(self._taken) if self._taken else np.zeros((0, 0)),
        )


def _name_success(info: dict[Any, Any]) -> dict[Any, Any]:
    """Return an `info` in which success has the name that the rules know, where it has the other one."""
    success = find_success(info)
    if success is None or info.get(SUCCESS) is not None:
        return info
    others = {name: value for name, value in info.items() if name != OTHER_SUCCESS}
    return {**others, SUCCESS: success}


def _to_series(steps: list[int], values: list[Any]) -> Series:
    return Series(np.array(steps, np.int64), np.array(values))
