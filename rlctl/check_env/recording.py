"""Lives one episode of an environment that is not trusted, and writes down everything that comes back."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Iterable, Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlctl.check_env.actions import actions
from rlctl.check_env.evidence import MOST_INFOS
from rlctl.check_env.failures import EnvironmentRaised, failure
from rlctl.check_env.instance import Budget, Instance
from rlctl.check_env.leaves import Leaf, pick
from rlctl.check_env.returned import flat_action, numbers_in, truth, type_name
from rlctl.check_env.wire import Message


@dataclasses.dataclass(frozen=True)
class Plan:
    """Which episode to live."""

    role: str
    episode: int
    seed: int
    actions: str = "random"
    action_seed: int | None = None
    """The seed of the actions; by default the episode's."""
    max_steps: int = 10_000
    max_s: float = 10.0
    then_unseeded: bool = False
    """Reset with the seed, and then once more without one."""
    given: Iterable[Any] | None = None
    """The actions themselves, at least `max_steps` of them; `actions` is then only their kind's name."""


class Recording:
    """An episode being lived. `reset` and then `step` while `running`; `run` does both to the end."""

    def __init__(self, instance: Instance, plan: Plan, budget: Budget) -> None:
        self.instance = instance
        self.plan = plan
        self.budget = budget
        self.running = False
        self.failure: dict[str, Any] | None = None
        self._ended = "steps"
        self._step = 0
        self._values: dict[int, tuple[list[int], list[Any]]] = {}
        self._rewards: list[float] = []
        self._is_number: list[bool] = []
        self._flags: list[tuple[bool, bool]] = []
        self._forms: dict[tuple[Any, ...], list[int]] = {}
        self._infos: dict[str, tuple[list[int], list[float]]] = {}
        self._acted: list[NDArray[np.float64]] = []
        self._previous: dict[int, tuple[Any, NDArray[Any]]] = {}
        self._step_s = self._reset_s = 0.0

    def run(self) -> list[Message]:
        """Live the episode; return its messages."""
        self.reset()
        while self.running:
            self.step()
        return self.messages()

    def reset(self) -> None:
        """Start the episode."""
        seed = self.plan.seed
        self.instance.progress.episode(self.plan.episode, seed)
        self._deadline = min(time.monotonic() + self.plan.max_s, self.budget.deadline)
        self._actions = self._chosen_actions()
        keywords = {"seed": seed} if self.instance.accepts_seed else {}
        started = time.perf_counter()
        try:
            result = self.instance.call("reset", self.instance.env.reset, **keywords)
            if self.plan.then_unseeded:
                result = self.instance.call("reset", self.instance.env.reset)
        except EnvironmentRaised as error:
            self._fail(error)
            return
        self._reset_s = time.perf_counter() - started
        self.running = self.plan.max_steps > 0
        observation, info = self._unpack_reset(result)
        self._note_info(info)
        self._observe(observation)

    def _chosen_actions(self) -> Iterator[Any]:
        plan = self.plan
        if plan.given is not None:
            return iter(plan.given)
        seed = plan.seed if plan.action_seed is None else plan.action_seed
        return actions(self.instance.env.action_space, plan.actions, seed)

    def _unpack_reset(self, result: Any) -> tuple[Any, Any]:
        if isinstance(result, tuple) and len(result) == 2:
            return result
        size = f" of {len(result)}" if isinstance(result, tuple) else ""
        self._note("reset", type_name(result) + size)
        return result, {}

    def step(self) -> None:
        """Take one step."""
        self._step += 1
        call, env = self.instance.call, self.instance.env
        try:
            action = call("sample", next, self._actions, step=self._step)
            self._acted.append(flat_action(self.instance.action_leaves, action))
            started = time.perf_counter()
            result = call("step", env.step, action, step=self._step)
        except EnvironmentRaised as error:
            self._fail(error)
            return
        self._step_s += time.perf_counter() - started
        unpacked = self._unpack_step(result)
        if unpacked is None:
            self.running = False
            self._ended = "raised"
            return
        observation, reward, terminated, truncated, info = unpacked
        self._note("terminated", type_name(terminated))
        self._note("truncated", type_name(truncated))
        self._note_info(info)
        self._reward(reward)
        flags = (truth(terminated), truth(truncated))
        self._flags.append(flags)
        self._observe(observation)
        self._continue(*flags)

    def _unpack_step(self, result: Any) -> tuple[Any, ...] | None:
        if isinstance(result, tuple) and len(result) == 5:
            return result
        if isinstance(result, tuple) and len(result) == 4:
            self._note("step", "tuple of 4")
            observation, reward, done, info = result
            return observation, reward, done, False, info
        size = f" of {len(result)}" if isinstance(result, tuple) else ""
        self._note("step", type_name(result) + size)
        return None

    def _continue(self, terminated: bool, truncated: bool) -> None:
        if terminated or truncated:
            self._ended = "both" if terminated and truncated else "terminated" if terminated else "truncated"
        elif self._step >= self.plan.max_steps:
            self._ended = "steps"
        elif time.monotonic() > self._deadline:
            self._ended = "time"
        elif self.budget.bytes_left <= 0:
            self._ended = "memory"
        else:
            return
        self.running = False

    def _fail(self, error: EnvironmentRaised) -> None:
        self.running = False
        self._ended = "raised"
        self.failure = failure(error, self.instance.progress)

    def _note(self, what: str, type_name: str, *more: Any) -> None:
        seen = self._forms.setdefault((what, type_name, *more), [self._step, 0])
        seen[1] += 1

    def _note_info(self, info: Any) -> None:
        self._note("info", type_name(info))
        if isinstance(info, dict):
            for name, value in numbers_in(info):
                if name in self._infos or len(self._infos) < MOST_INFOS:
                    steps, values = self._infos.setdefault(name, ([], []))
                    steps.append(self._step)
                    values.append(value)

    def _reward(self, reward: Any) -> None:
        self._note("reward", type_name(reward))
        try:
            self._rewards.append(float(reward))
            self._is_number.append(True)
        except Exception:  # its type is noted, and is a finding
            self._rewards.append(float("nan"))
            self._is_number.append(False)

    def _observe(self, observation: Any) -> None:
        for index, leaf in enumerate(self.instance.leaves):
            try:
                value = pick(observation, leaf.path)
            except (LookupError, TypeError):
                self._note("observation", "missing", index, None, None)
                continue
            if leaf.supported:
                self._store(index, leaf, value)
        keys = {leaf.path[0] for leaf in self.instance.leaves if leaf.path}
        if isinstance(observation, dict) and keys and observation.keys() != keys:
            self._note("keys", ", ".join(sorted(map(str, observation))))

    def _store(self, index: int, leaf: Leaf, value: Any) -> None:
        try:
            array = np.array(value)  # a copy: an environment may write into what it returned
        except Exception:  # a ragged list, or an object of its own kind; its type is noted, and is a finding
            self._note("observation", type_name(value), index, None, None)
            return
        self._note("observation", type_name(value), index, str(array.dtype), array.shape)
        self._compare_memory(index, value, array)
        if array.shape != leaf.shape or array.dtype.kind not in "biuf":
            return
        steps, values = self._values.setdefault(index, ([], []))
        steps.append(self._step)
        values.append(array)
        self.budget.bytes_left -= array.nbytes + 100

    def _compare_memory(self, index: int, value: Any, copy: NDArray[Any]) -> None:
        """Note an observation that a later step has changed: both are one memory."""
        if not isinstance(value, np.ndarray) or not value.shape:
            return
        earlier = self._previous.get(index)
        if earlier is not None and np.shares_memory(earlier[0], value) and not np.array_equal(*earlier, equal_nan=True):
            self._note("memory", "shared", index)
        self._previous[index] = value, copy

    @property
    def steps(self) -> int:
        """How many steps were taken."""
        return len(self._rewards)

    @property
    def was_cut(self) -> bool:
        """Whether the episode was left before its end, for steps or time."""
        return self._ended in ("steps", "time")

    def messages(self) -> list[Message]:
        """Return what to send: the trajectory, and the failure that ended it, if one did."""
        arrays = {
            "rewards": np.array(self._rewards, np.float64),
            "reward_is_number": np.array(self._is_number, np.bool_),
            "terminated": np.array([flag for flag, _ in self._flags], np.bool_),
            "truncated": np.array([flag for _, flag in self._flags], np.bool_),
        }
        if self._acted:
            arrays["actions"] = np.stack(self._acted)
        for index, (steps, numbers) in enumerate(self._infos.values()):
            arrays[f"info/{index}/steps"] = np.array(steps, np.int64)
            arrays[f"info/{index}/values"] = np.array(numbers, np.float64)
        for index, (steps, values) in self._values.items():
            arrays[f"steps/{index}"] = np.array(steps, np.int64)
            arrays[f"values/{index}"] = np.stack(values)
        header: dict[str, Any] = {
            "type": "trajectory",
            "role": self.plan.role,
            "episode": self.plan.episode,
            "seed": self.plan.seed,
            "actions": self.plan.actions,
            "ended": self._ended,
            "recorded": list(self._values),
            "infos": list(self._infos),
            "forms": [_form(key, step, count) for key, (step, count) in self._forms.items()],
            "step_s": self._step_s,
            "reset_s": self._reset_s,
        }
        failed: list[Message] = [(self.failure, {})] if self.failure else []
        return [(header, arrays), *failed]


def _form(key: tuple[Any, ...], step: int, count: int) -> dict[str, Any]:
    names = ("what", "type", "leaf", "dtype", "shape")
    return {**dict.fromkeys(names), **dict(zip(names, key, strict=False)), "step": step, "count": count}
