"""Logs of robots in simulation with mistakes in their mapping, made without any code of `rlctl diagnose`."""

from __future__ import annotations

import dataclasses
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from rlctl.engine import Engine
from rlctl.environments.spec import EnvChanges
from rlctl.policy.file import PolicyFile
from rlctl.policy.numpy_actor import NumpyActor
from rlctl.policy.policy import Policy
from rlctl.policy.shipped import find_shipped_policy
from rlctl.task.events import EventSettings, delay

_EPSILON = 1e-8  # that policies add to the variance; it is most of the variance of an element that never changed
MOVES = 1e-3  # standard deviation within an episode, below which an element tells nothing


@dataclasses.dataclass(frozen=True)
class Wrong:
    """A mistake: wrong = factor * right[order] + offset, or a stuck or late value."""

    term: str  # a name, `actions`, `observation` (all), or `policy`
    kind: str
    order: tuple[int, ...] = ()
    factor: tuple[float, ...] = ()
    offset: tuple[float, ...] = ()
    late: int = 0
    stuck: tuple[int, ...] = ()
    turned: bool = False  # from the body's into the world's frame
    in_log: bool = False  # the log alone is wrong, not what the policy got or the robot did

    def __str__(self) -> str:
        place = "log" if self.in_log else "loop"
        shown = {"order": self.order, "factor": self.factor, "offset": self.offset, "stuck": self.stuck}
        detail = ", ".join(f"{key} {np.round(value, 4).tolist()}" for key, value in shown.items() if value)
        return f"{self.term} {self.kind} ({place}) {detail}{f' late {self.late}' if self.late else ''}"


class WrongMapping:
    """Applies mistakes of one term, step by step."""

    def __init__(self, wrongs: Sequence[Wrong]) -> None:
        self._wrongs = wrongs
        self._past: list[deque[Any]] = [deque(maxlen=wrong.late + 1) for wrong in wrongs]
        self._held: list[Any] = [None] * len(wrongs)

    def __call__(self, value: Any, attitude: Any = None) -> Any:
        for number, wrong in enumerate(self._wrongs):
            if wrong.order:
                value = value[list(wrong.order)]
            if wrong.factor:
                value = value * np.array(wrong.factor)
            if wrong.offset:
                value = value + np.array(wrong.offset)
            if wrong.turned:
                from scipy.spatial.transform import Rotation

                value = Rotation.from_euler("xyz", attitude).as_matrix() @ value
            if wrong.late:
                past = self._past[number]
                past.extend([value] * (wrong.late + 1) if not past else [value])
                value = past[0]
            if wrong.stuck:
                if self._held[number] is None:
                    self._held[number] = value.copy()
                value = value.copy()
                value[list(wrong.stuck)] = self._held[number][list(wrong.stuck)]
        return value


@dataclasses.dataclass(frozen=True, eq=False)
class BrokenLog:
    """A log, with a segment per episode."""

    task: str
    observations: Any
    actions: Any
    lengths: tuple[int, ...]
    sizes: Mapping[str, int]


class Robot:
    """A task's simulation and its shipped policy."""

    def __init__(self, task: str, sim: Engine = Engine()) -> None:  # noqa: B008 (it cannot change)
        self.task, self.file = task, find_shipped_policy(task)
        self.policy_file = PolicyFile.read(self.file)
        self.info = self.policy_file.info
        self.spec = self.info.derive_spec(changes=EnvChanges(sim=sim))
        self.env: Any = self.spec.make()
        self.policy = Policy(NumpyActor(self.policy_file))
        self.sizes = dict(self.info.env.observation_sizes)
        self.events = {
            name: {} for name, event in self.env.unwrapped.task.events.items() if event.function is not delay
        }
        ends = np.cumsum(list(self.sizes.values())).tolist()
        self.slices = {name: slice(end - n, end) for (name, n), end in zip(self.sizes.items(), ends, strict=True)}
        tensors = self.policy_file.tensors
        self.mean, self.std = tensors["normalize//mean"], np.sqrt(tensors["normalize//var"] + _EPSILON)
        self.low, self.high = self.env.action_space.low, self.env.action_space.high

    def log(
        self, wrongs: Sequence[Wrong], seconds: float, seed: int, *, randomized: bool, noise: float = 0.0
    ) -> BrokenLog:
        """Record episodes until they last so many seconds; `noise` is in standard deviations of each element."""
        rng = np.random.default_rng(seed)
        unwrapped = self.env.unwrapped
        unwrapped.set_events(EventSettings(False, self.events if randomized else {}))
        rows = round(seconds / self.info.env.control_dt)
        parts: list[Any] = []
        count = 0
        while count < rows:
            part = self._play(wrongs, rng, rows - count, noise)
            if len(part[0]) >= 6:
                parts.append(part)
                count += len(part[0])
            else:
                count += 1
        observations, actions = (np.concatenate(column) for column in zip(*parts, strict=True))
        return BrokenLog(self.task, observations, actions, tuple(len(part[0]) for part in parts), self.sizes)

    def _play(self, wrongs: Sequence[Wrong], rng: Any, most: int, noise: float) -> tuple[Any, Any]:
        loop = [wrong for wrong in wrongs if not wrong.in_log]
        in_log = [wrong for wrong in wrongs if wrong.in_log]
        fed, logged = self._mappings(loop), self._mappings(in_log)
        self.policy.reset()
        observation, _ = self.env.reset(seed=int(rng.integers(2**31)))
        observations, actions = [], []
        last = np.zeros(len(self.low))  # the program remembers what it sent, whatever the robot did with it
        for _ in range(most):
            seen = np.array(observation, np.float64)
            if "last_action" in self.slices:
                seen[self.slices["last_action"]] = last
            if noise:
                # Commands and the last action are no sensors.
                quiet = [self.slices[name] for name in ("command", "last_action") if name in self.slices]
                measured = noise * self.std * rng.standard_normal(len(seen))
                for columns in quiet:
                    measured[columns] = 0.0
                seen += measured
            seen = self._map(seen, fed)
            action = np.array(self.policy.predict(seen.astype(np.float32)), np.float64)
            last = action
            observations.append(self._map(seen, logged))
            actions.append(logged["actions"](action))
            executed = np.clip(fed["actions"](action), self.low, self.high)
            observation, _, terminated, truncated, _ = self.env.step(executed.astype(np.float32))
            if terminated or truncated:
                break
        return np.array(observations), np.array(actions)

    def _mappings(self, wrongs: Sequence[Wrong]) -> dict[str, Callable[..., Any]]:
        names = [*self.sizes, "actions", "observation"]
        return {name: WrongMapping([wrong for wrong in wrongs if wrong.term == name]) for name in names}

    def _map(self, values: Any, mappings: Mapping[str, Callable[..., Any]]) -> Any:
        result = values.copy()
        attitude = values[self.slices["attitude"]] if "attitude" in self.slices else None
        for name, columns in self.slices.items():
            result[columns] = mappings[name](values[columns], attitude)
        return mappings["observation"](result)


def measure_motion(log: BrokenLog) -> tuple[Any, Any]:
    """Return the standard deviation of each observation's and action's element within episodes."""
    ends = np.cumsum(log.lengths)[:-1]
    return tuple(
        np.mean([part.std(axis=0) for part in np.split(values, ends)], axis=0)
        for values in (log.observations, log.actions)
    )


class Draws:
    """Draws mistakes that a log can show: of elements that move, in the loop of values that change in an episode."""

    def __init__(self, robot: Robot, allowed_delay: int) -> None:
        self.robot, self._allowed = robot, allowed_delay
        sound = robot.log((), 10.0, 999, randomized=False)
        motion, action_motion = measure_motion(sound)
        self.moving = {
            name: [i for i in range(size) if motion[robot.slices[name]][i] > MOVES]
            for name, size in robot.sizes.items()
        }
        self.moving["actions"] = list(range(len(action_motion)))
        self.terms = [name for name, elements in self.moving.items() if len(elements) == self._size(name)]

    def _size(self, name: str) -> int:
        return self.robot.sizes.get(name, len(self.robot.low))

    def draw(self, rng: Any, not_of: str = "") -> Wrong:
        """Return a random mistake, of another term than `not_of`."""
        while True:
            name = str(rng.choice([*self.terms, "actions"]))
            kind = str(
                rng.choice(
                    ["swap", "order", "sign", "signs", "unit", "scale", "offset", "stuck", "late", "frame", "all"]
                )
            )
            wrong = self._make(rng, name, kind)
            if wrong is not None and (not not_of or wrong.term not in (not_of, "observation")):
                return wrong

    def _make(self, rng: Any, name: str, kind: str) -> Wrong | None:
        size, in_log = self._size(name), bool(rng.integers(2))
        units, joints = self.robot.info.env.observation_units, self.robot.info.env.joints
        is_action = name == "actions"
        ones = np.ones(size)
        if kind == "swap" and size > 1:
            order = list(range(size))
            one, other = rng.choice(size, 2, replace=False)
            order[one], order[other] = order[other], order[one]
            return Wrong(name, kind, order=tuple(int(i) for i in order), in_log=in_log)
        if kind == "order" and size > 2:
            orders = [list(range(size))[::-1]]
            if size % 3 == 0 and size > 3:
                grid = np.arange(size).reshape(-1, 3)
                orders += [grid.T.ravel().tolist(), grid[[1, 0, 3, 2]].ravel().tolist() if size == 12 else orders[0]]
            return Wrong(name, kind, order=tuple(orders[int(rng.integers(len(orders)))]), in_log=in_log)
        if kind == "sign":
            ones[int(rng.integers(size))] = -1
            return Wrong(name, kind, factor=tuple(ones.tolist()), in_log=in_log)
        if kind == "signs" and size > 1:
            return Wrong(name, kind, factor=tuple((-ones).tolist()), in_log=in_log)
        if kind == "unit" and not is_action and units.get(name, "").split("/")[0] in ("rad", "m"):
            factor = 180 / np.pi if units[name].startswith("rad") else 1000.0
            return Wrong(name, kind, factor=tuple((factor * ones).tolist()), in_log=in_log)
        if kind == "scale":
            factor = float(rng.choice([0.25, 0.4, 2.0, 3.0]))
            if is_action and not in_log:
                factor = float(rng.choice([0.25, 0.4, 2.0]))
            return Wrong(name, kind, factor=tuple((factor * ones).tolist()), in_log=in_log)
        if (
            kind == "offset"
            and name == "joint_positions"
            and joints is not None
            and len(joints.default_positions) == size
        ):
            sign = 1.0 if self.robot.task == "walk" else -1.0
            return Wrong(name, kind, offset=tuple(sign * x for x in joints.default_positions), in_log=in_log)
        if kind == "stuck" and not is_action:
            stuck = tuple(range(size)) if rng.integers(2) else (int(rng.integers(size)),)
            return Wrong(name, kind, stuck=stuck, in_log=in_log)
        if kind == "late":
            late = int(rng.integers(1, 4))
            if is_action and not in_log:
                late = self._allowed + int(rng.integers(1, 3))
            return Wrong(name, kind, late=min(late, 4), in_log=in_log)
        if kind == "all" and rng.integers(3) == 0:
            std = self.robot.std
            factor, offset = tuple((1 / std).tolist()), tuple((-self.robot.mean / std).tolist())
            return Wrong("observation", "normalised", factor=factor, offset=offset, in_log=in_log)
        return None
