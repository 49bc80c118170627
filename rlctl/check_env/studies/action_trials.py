"""Living one episode again with one number of its actions changed, and comparing what comes back bit for bit."""

from __future__ import annotations

import copy
import dataclasses
import itertools
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlctl.check_env.actions import actions
from rlctl.check_env.instance import Budget, Instance
from rlctl.check_env.leaves import Leaf, leaf_name, pick
from rlctl.check_env.returned import flat_action

ALWAYS = -1
"""Instead of a step: at every step."""


class OutOfTime(Exception):
    """Raised where a study's time is over in the middle of a comparison."""


@dataclasses.dataclass(frozen=True)
class Dimension:
    """One number of the action."""

    leaf: Leaf
    index: int
    """Flat, in the leaf."""
    place: int
    """Flat, in the whole action."""

    @property
    def name(self) -> str:
        """How to write it: `action[2]`."""
        where = "action" + leaf_name(self.leaf).removeprefix("observation")
        if not self.leaf.shape:
            return where
        position = np.unravel_index(self.index, self.leaf.shape)
        return f"{where}[{', '.join(str(int(i)) for i in position)}]"

    @property
    def bounds(self) -> tuple[float, float]:
        """Lowest and highest value; infinite where there is none."""
        low, high = np.ravel(np.asarray(self.leaf.low)), np.ravel(np.asarray(self.leaf.high))
        return float(low[self.index]), float(high[self.index])

    @property
    def ends(self) -> tuple[float, float]:
        """Two values that are far apart and inside the bounds."""
        low, high = self.bounds
        return (low if np.isfinite(low) else min(-1.0, high)), (high if np.isfinite(high) else max(1.0, low))

    @property
    def is_continuous(self) -> bool:
        """Whether it is a number with finite bounds of which every part counts."""
        return self.leaf.kind == "Box" and self.leaf.dtype.startswith("float") and bool(np.isfinite(self.bounds).all())

    def put(self, action: Any, value: float) -> Any:
        """Return the action with this number in it; may change the one it is given."""
        return _put(action, self.leaf.path, self.index, value)


def _put(action: Any, path: Sequence[str | int], index: int, value: float) -> Any:
    if path:
        inner = _put(action[path[0]], path[1:], index, value)
        if isinstance(action, tuple):
            return tuple(inner if place == path[0] else each for place, each in enumerate(action))
        return {**action, path[0]: inner}
    if isinstance(action, np.ndarray):
        action.flat[index] = value
        return action
    return type(action)(value)


def dimensions(leaves: list[Leaf]) -> list[Dimension]:
    """Return the numbers of an action that can be varied."""
    found, place = [], 0
    for leaf in leaves:
        if not leaf.supported:
            continue
        for index in range(int(np.prod(leaf.shape))):
            dimension = Dimension(leaf, index, place)
            place += 1
            if dimension.bounds[0] < dimension.bounds[1]:
                found.append(dimension)
    return found


@dataclasses.dataclass(frozen=True)
class Edit:
    """A number of the action set to a value."""

    dimension: Dimension
    value: float
    step: int = ALWAYS


@dataclasses.dataclass(frozen=True)
class Frame:
    """What one call of reset or step gave."""

    observation: NDArray[Any]
    """Its numbers, flat."""
    reward: float
    ended: tuple[bool, bool]
    """`terminated` and `truncated`."""


@dataclasses.dataclass(frozen=True)
class Comparison:
    """Where two lives differ."""

    observations: bool
    """Whether an observation, or the end, does."""
    rewards: list[int]
    """The steps whose rewards do."""


class Trials:
    """Lives episodes of one instance, each from a seed and with edited actions; equal ones are lived once."""

    def __init__(self, instance: Instance, budget: Budget, kind: str = "random") -> None:
        self.instance = instance
        self.budget = budget
        self.kind = kind
        self._plain: dict[tuple[int, int], list[Frame]] = {}

    def actions(self, seed: int, steps: int) -> list[Any]:
        """Return the actions of an episode before they are edited."""
        chosen = actions(self.instance.env.action_space, self.kind, seed)
        return self.instance.call("sample", lambda: list(itertools.islice(chosen, steps)))  # type: ignore[no-any-return]

    def plain(self, seed: int, steps: int) -> list[Frame]:
        """Return an episode without edits."""
        for (known_seed, known_steps), frames in self._plain.items():
            if known_seed == seed and known_steps >= steps:
                return frames[: steps + 1]
        frames = self.live(seed, self.actions(seed, steps))
        self._plain[seed, steps] = frames
        return frames

    def edited(self, seed: int, steps: int, *edits: Edit) -> list[Frame]:
        """Live an episode with edits of its actions."""
        chosen = copy.deepcopy(self.actions(seed, steps))
        for edit in edits:
            for step in range(steps) if edit.step == ALWAYS else [edit.step]:
                chosen[step] = edit.dimension.put(chosen[step], edit.value)
        return self.live(seed, chosen)

    def live(self, seed: int, chosen: Sequence[Any]) -> list[Frame]:
        """Live an episode with given actions, to its end at most; the first frame is that of reset."""
        return list(self.frames(seed, chosen))

    def frames(self, seed: int, chosen: Sequence[Any]) -> Iterator[Frame]:
        """Yield an episode's frames as they are lived."""
        env, call = self.instance.env, self.instance.call
        self.instance.progress.episode(0, seed)
        keywords = {"seed": seed} if self.instance.accepts_seed else {}
        started = call("reset", env.reset, **keywords)
        yield Frame(flat(started[0] if isinstance(started, tuple) else started), 0.0, (False, False))
        for step, action in enumerate(chosen, start=1):
            if self.budget.seconds_left < 0:
                raise OutOfTime
            frame = _frame(call("step", env.step, action, step=step))
            yield frame
            if any(frame.ended):
                return

    def is_repeatable(self, seed: int, steps: int) -> bool:
        """Say whether an episode is the same when it is lived again; an instance's first may differ from all others."""
        for _ in range(2):
            before = self.plain(seed, steps)
            again = self.live(seed, self.actions(seed, steps))
            difference = compare(before, again)
            if not difference.observations and not difference.rewards:
                return True
            self._plain[seed, steps] = again
        return False

    def copies(self, dimension: Dimension, seed: int, steps: int, longest_delay: int) -> NDArray[np.intp]:
        """Return the elements of the observation that are nothing but this number of an earlier action."""
        rows = [frame.observation for frame in self.plain(seed, steps)[1:]]
        given = [flat_action(self.instance.action_leaves, each) for each in self.actions(seed, len(rows))]
        values = np.array([each[dimension.place] for each in given])
        if not rows or len({row.shape for row in rows}) > 1:
            return np.zeros(0, np.intp)
        seen = np.stack(rows).astype(np.float64)
        is_copy = np.zeros(seen.shape[1], np.bool_)
        for delay in range(min(longest_delay + 1, len(values) // 2)):
            late = values[: len(values) - delay, None]
            is_copy |= ((seen[delay:] == late) | (seen[delay:] == late.astype(np.float32))).all(axis=0)
        return np.flatnonzero(is_copy)


def flat(observation: Any) -> NDArray[Any]:
    """Return a copy of all numbers of an observation."""
    if isinstance(observation, dict):
        parts = [flat(value) for value in observation.values()]
    elif isinstance(observation, (tuple, list)) and any(isinstance(each, np.ndarray) for each in observation):
        parts = [flat(value) for value in observation]
    else:
        try:
            array = np.array(observation)
        except Exception:  # a ragged list, or an object of its own kind
            array = np.zeros(0)
        return array.ravel() if array.dtype.kind in "biuf" else np.zeros(0)
    return np.concatenate(parts) if parts else np.zeros(0)


def _frame(returned: Any) -> Frame:
    observation, reward, *rest = returned if isinstance(returned, tuple) and len(returned) > 3 else (0, 0, 0, 0)
    try:
        number = float(reward)
    except Exception:  # its type is another rule's matter
        number = float("nan")
    terminated, truncated = (rest[0], rest[1]) if len(rest) == 3 else (rest[0], False)
    return Frame(flat(observation), number, (bool(np.any(terminated)), bool(np.any(truncated))))


def compare(one: list[Frame], two: list[Frame], besides: NDArray[np.intp] | None = None) -> Comparison:
    """Compare two lives as far as both go, some elements of the observations left out; NaN equals NaN."""
    pairs = list(zip(one, two, strict=False))
    rewards = [
        step for step, (a, b) in enumerate(pairs) if a.reward != b.reward and not (a.reward != a.reward != b.reward)
    ]
    left_out = np.zeros(0, np.intp) if besides is None else besides
    differ = any(a.ended != b.ended or _differ(a.observation, b.observation, left_out) for a, b in pairs)
    return Comparison(differ, rewards)


def _differ(a: NDArray[Any], b: NDArray[Any], besides: NDArray[np.intp]) -> bool:
    if a.shape != b.shape:
        return True
    if besides.size:
        a, b = np.delete(a, besides), np.delete(b, besides)
    return not np.array_equal(a, b, equal_nan=a.dtype.kind == "f" and b.dtype.kind == "f")


def replaced(action: Any, leaves: list[Leaf], change: Any) -> Any:
    """Return an action whose continuous parts went through `change(part, leaf)`."""
    for leaf in leaves:
        if leaf.kind == "Box" and leaf.dtype.startswith("float"):
            new = change(np.asarray(pick(action, leaf.path)), leaf).astype(leaf.dtype)
            action = _exchange(action, leaf.path, new)
    return action


def _exchange(action: Any, path: Sequence[str | int], new: NDArray[Any]) -> Any:
    if not path:
        return new
    inner = _exchange(action[path[0]], path[1:], new)
    if isinstance(action, tuple):
        return tuple(inner if place == path[0] else each for place, each in enumerate(action))
    return {**action, path[0]: inner}
