"""Plays one episode again with some of its actions changed, and compares what comes back bit for bit."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlctl.check_env.actions import actions, build_action
from rlctl.check_env.context import Context
from rlctl.check_env.episode import Episode, Moment
from rlctl.check_env.finding import NotJudged
from rlctl.check_env.instance import Instance
from rlctl.check_env.leaves import Leaf, leaf_name, pick
from rlctl.check_env.messages import FIRST_SEED
from rlctl.check_env.returned import flat_action

REPEATED_STEPS = 20


class OutOfTime(Exception):
    """Raised where an experiment's time is over in the middle of a comparison."""


@dataclasses.dataclass(frozen=True)
class Dimension:
    """One number of the action."""

    leaf: Leaf
    index: int
    """Flat, in the leaf."""
    column: int
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
        return is_float_box(self.leaf) and bool(np.isfinite(self.bounds).all())


def is_float_box(leaf: Leaf) -> bool:
    """Say whether a leaf of the action space is continuous."""
    return leaf.kind == "Box" and leaf.dtype.startswith("float")


def dimensions(leaves: list[Leaf]) -> list[Dimension]:
    """Return the numbers of an action that can be varied."""
    flat = [(leaf, i) for leaf in leaves if leaf.supported for i in range(int(np.prod(leaf.shape)))]
    found = [Dimension(leaf, index, column) for column, (leaf, index) in enumerate(flat)]
    return [each for each in found if each.bounds[0] < each.bounds[1]]


@dataclasses.dataclass(frozen=True)
class Frame:
    """What one call of reset or step returned."""

    observation: NDArray[Any]
    """Its numbers, flat."""
    reward: float
    ended: tuple[bool, bool]
    """`terminated` and `truncated`."""


class Trials:
    """Plays episodes of one instance, each with a seed and with changed actions; equal ones are played once."""

    def __init__(self, context: Context, instance: Instance, kind: str = "random") -> None:
        self.instance = instance
        self.deadline = context.budget.deadline
        self.kind = kind
        self._plain: dict[tuple[int, int], list[Frame]] = {}

    def require_repeatable(self) -> None:
        """Raise `NotJudged` unless an episode is the same when it is played again."""
        if not self.instance.accepts_seed:
            raise NotJudged("reset takes no seed (RL202)")
        try:
            for _ in range(2):  # an instance's first episode may differ from all others
                before = self.plain(FIRST_SEED, REPEATED_STEPS)
                again = self.play(FIRST_SEED, self.actions(FIRST_SEED, REPEATED_STEPS))
                if not observations_differ(before, again) and not steps_of_other_rewards(before, again):
                    return
                self._plain[FIRST_SEED, REPEATED_STEPS] = again
        except OutOfTime:
            raise NotJudged("playing one episode twice took all the time there is for it") from None
        raise NotJudged("equal seeds and actions give unequal episodes (RL3)")

    def actions(self, seed: int, steps: int) -> list[Any]:
        """Return the actions of an episode before they are changed."""
        chosen = actions(self.instance.env.action_space, self.kind, seed)
        return self.instance.call("sample", lambda: list(itertools.islice(chosen, steps)))  # type: ignore[no-any-return]

    def plain(self, seed: int, steps: int) -> list[Frame]:
        """Return an episode with unchanged actions."""
        for (known_seed, known_steps), frames in self._plain.items():
            if known_seed == seed and known_steps >= steps:
                return frames[: steps + 1]
        frames = self._plain[seed, steps] = self.play(seed, self.actions(seed, steps))
        return frames

    def with_value(
        self, seed: int, steps: int, dimension: Dimension, value: float, at: int | None = None
    ) -> list[Frame]:
        """Play an episode with one number of the action set to a value, in one step or in all."""

        def change(part: Any, leaf: Leaf) -> Any:
            if leaf.path == dimension.leaf.path:
                part = np.array(part)
                part.flat[dimension.index] = value
            return part

        chosen = self.actions(seed, steps)
        changed = [self.change(each, change) if at in (None, step) else each for step, each in enumerate(chosen)]
        return self.play(seed, changed)

    def change(self, action: Any, change: Callable[[Any, Leaf], Any]) -> Any:
        """Return an action whose leaves went through a function of the part and the leaf."""
        return build_action(self.instance.env.action_space, lambda leaf: change(pick(action, leaf.path), leaf))

    def play(self, seed: int, chosen: Sequence[Any]) -> list[Frame]:
        """Play an episode with given actions, to its end at most; the first frame is that of reset."""
        episode = Episode(self.instance, seed, given=chosen, max_steps=len(chosen), deadline=self.deadline)
        frames = [to_frame(moment) for moment in episode]
        if episode.ended == "time":
            raise OutOfTime
        return frames

    def copies(self, dimension: Dimension, seed: int, steps: int, longest_delay: int) -> NDArray[np.intp]:
        """Return the elements of the observation that only repeat this number of an earlier action."""
        rows = [frame.observation for frame in self.plain(seed, steps)[1:]]
        given = [flat_action(self.instance.action_leaves, each) for each in self.actions(seed, len(rows))]
        values = np.array([each[dimension.column] for each in given])
        if not rows or len({row.shape for row in rows}) > 1:
            return np.zeros(0, np.intp)
        returned = np.stack(rows).astype(np.float64)
        is_copy = np.zeros(returned.shape[1], np.bool_)
        for delay in range(min(longest_delay + 1, len(values) // 2)):
            late = values[: len(values) - delay, None]
            is_copy |= ((returned[delay:] == late) | (returned[delay:] == late.astype(np.float32))).all(axis=0)
        return np.flatnonzero(is_copy)


def to_frame(moment: Moment) -> Frame:
    """Return the numbers of what a call returned."""
    try:
        reward = float(moment.reward)
    except Exception:  # its type is another rule's matter
        reward = float("nan")
    return Frame(_flatten(moment.observation), reward, moment.flags)


def _flatten(observation: Any) -> NDArray[Any]:
    """Return a copy of all numbers of an observation."""
    if isinstance(observation, dict):
        observation = tuple(observation.values())
    if isinstance(observation, (tuple, list)) and any(isinstance(each, (np.ndarray, dict)) for each in observation):
        parts = [_flatten(value) for value in observation]
        return np.concatenate(parts) if parts else np.zeros(0)
    try:
        array = np.array(observation)
    except Exception:  # a ragged list, or an object of its own kind
        array = np.zeros(0)
    return array.ravel() if array.dtype.kind in "biuf" else np.zeros(0)


def observations_differ(one: list[Frame], two: list[Frame], besides: NDArray[np.intp] | None = None) -> bool:
    """Say whether observations or ends differ, as far as both go, with some elements left out; NaN equals NaN."""
    left_out = np.zeros(0, np.intp) if besides is None else besides

    def differ(a: NDArray[Any], b: NDArray[Any]) -> bool:
        if a.shape != b.shape:
            return True
        is_float = a.dtype.kind == "f" and b.dtype.kind == "f"
        return not np.array_equal(np.delete(a, left_out), np.delete(b, left_out), equal_nan=is_float)

    return any(a.ended != b.ended or differ(a.observation, b.observation) for a, b in zip(one, two, strict=False))


def steps_of_other_rewards(one: list[Frame], two: list[Frame]) -> list[int]:
    """Return the steps at which the rewards differ, as far as both go; NaN equals NaN."""
    rewards = [(a.reward, b.reward) for a, b in zip(one, two, strict=False)]
    return [step for step, (a, b) in enumerate(rewards) if a != b and not (np.isnan(a) and np.isnan(b))]
