"""Plays one episode again with some of its actions changed, and compares what comes back bit for bit."""

import dataclasses
import itertools
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlctl.checking.episode import EpisodePlayer, Moment, build_action, draw_actions, zero_action
from rlctl.checking.instance import Instance
from rlctl.checking.records import FIRST_SEED, SECOND_SEED
from rlctl.checking.rule import NotJudged, OutOfTime
from rlctl.checking.values import ArrayNames, flatten, flatten_action, list_parts
from rlctl.environments.leaves import Leaf, name_element, pick

Frame = NDArray[np.float64]
"""What one call of reset or step returned: the observation's numbers, flat, the reward, and the two flags."""

REPEATED_STEPS = 20
STAGES = ((FIRST_SEED, 3), (FIRST_SEED, 20), (SECOND_SEED, 60))  # seeds and steps, until a difference shows
LONGEST_DELAY = 4  # steps; for earlier actions in observations and for penalties on changes
REWARD = -3  # Where the reward is in a frame


@dataclasses.dataclass(frozen=True, eq=False)
class ActionNumber:
    """One number of the action."""

    leaf: Leaf
    index: int  # Flat, in the leaf
    column: int  # Flat, in the whole action

    @property
    def name(self) -> str:
        """How to write it: `action[2]`."""
        return name_element(self.leaf, self.index, "action")

    @property
    def bounds(self) -> tuple[Any, Any]:
        """Lowest and highest value, of the action's type; infinite where there is none."""
        low, high = np.ravel(np.asarray(self.leaf.low)), np.ravel(np.asarray(self.leaf.high))
        return low[self.index].item(), high[self.index].item()

    @property
    def ends(self) -> tuple[Any, Any]:
        """Two values that are far apart and inside the bounds."""
        low, high = self.bounds
        return (low if np.isfinite(low) else min(-1.0, high)), (high if np.isfinite(high) else max(1.0, low))


def find_dimensions(leaves: list[Leaf]) -> list[ActionNumber]:
    """Return the numbers of an action that can be varied."""
    flat = [(leaf, i) for leaf in leaves if leaf.supported for i in range(int(np.prod(leaf.shape)))]
    dimensions = [ActionNumber(leaf, index, column) for column, (leaf, index) in enumerate(flat)]
    return [dimension for dimension in dimensions if dimension.bounds[0] < dimension.bounds[1]]


class Trials:
    """Plays episodes of one instance, each with a seed and with changed actions; equal ones are played once."""

    def __init__(self, instance: Instance) -> None:
        self.instance = instance
        self.parts: ArrayNames = []
        self._plain: dict[tuple[int, int], list[Frame]] = {}

    def require_repeatable(self) -> None:
        """Raise `NotJudged` unless an episode is the same when it is played again."""
        if not self.instance.accepts_seed:
            raise NotJudged("reset takes no seed (RL202)")
        for _ in range(2):  # an instance's first episode may differ from all others
            before = self.plain(FIRST_SEED, REPEATED_STEPS)
            again = self.play(FIRST_SEED, self.actions(FIRST_SEED, REPEATED_STEPS))
            if not find_differences(before, again):
                return
            self._plain[FIRST_SEED, REPEATED_STEPS] = again
        raise NotJudged("equal seeds and actions give unequal episodes (RL3)")

    def actions(self, seed: int, steps: int) -> list[Any]:
        """Return the actions of an episode before they are changed."""
        chosen = draw_actions(self.instance.env.action_space, "random", seed)
        return self.instance.call("sample", lambda: list(itertools.islice(chosen, steps)))

    def plain(self, seed: int, steps: int) -> list[Frame]:
        """Return an episode with unchanged actions."""
        for (known_seed, known_steps), frames in self._plain.items():
            if known_seed == seed and known_steps >= steps:
                return frames[: steps + 1]
        frames = self._plain[seed, steps] = self.play(seed, self.actions(seed, steps))
        return frames

    def with_values(
        self, seed: int, steps: int, values: Mapping[ActionNumber, Any], at: int | None = None
    ) -> list[Frame]:
        """Play an episode with some numbers of the action set to values, in one step or in all."""

        chosen = self.actions(seed, steps)
        for step in range(len(chosen)) if at is None else [at]:
            chosen[step] = self.change(chosen[step], values)
        return self.play(seed, chosen)

    def with_first(self, seed: int, steps: int, values: Mapping[ActionNumber, Any]) -> list[Frame]:
        """Play an episode of zero actions but for some numbers of the first one."""
        nothing = zero_action(self.instance.env.action_space)
        return self.play(seed, [self.change(nothing, values), *[nothing] * (steps - 1)])

    def change(self, action: Any, values: Mapping[ActionNumber, Any]) -> Any:
        """Return an action with some numbers set to values."""

        def value_of(leaf: Leaf) -> Any:
            part = np.array(pick(action, leaf.path))
            for dimension, value in values.items():
                if dimension.leaf.path == leaf.path:
                    part.flat[dimension.index] = value
            return part

        return build_action(self.instance.env.action_space, value_of)

    def play(self, seed: int, chosen: Sequence[Any], after_reset: Callable[[], None] = lambda: None) -> list[Frame]:
        """Play an episode with given actions, to its end at most; the first frame is that of reset."""
        episode = EpisodePlayer(self.instance, seed, sequence=chosen, max_steps=len(chosen))
        frames = []
        for moment in episode:
            frames.append(_to_frame(moment))
            if moment.step == 0:
                self.parts = list(list_parts(moment.observation))
                after_reset()
        if episode.ended == "time":
            raise OutOfTime("time ran out before the last comparison")
        if episode.ended == "raised":
            raise NotJudged("step does not return observation, reward and flags (RL201)")
        return frames

    def has_same_effect(self, dimension: ActionNumber, one: Any, two: Any, before: Any = None) -> bool:
        """Say whether two values of a number of the action lead to the same, but for its own copies: in all steps, or
        in the second half of them after another value."""
        copies = self.copies(dimension, FIRST_SEED, REPEATED_STEPS, LONGEST_DELAY)
        played = ([self._hold(*stage, dimension, value, before) for value in (one, two)] for stage in STAGES)
        return not any(observations_differ(a, b, copies) for a, b in played)

    def _hold(self, seed: int, steps: int, dimension: ActionNumber, value: Any, before: Any) -> list[Frame]:
        first = 0 if before is None else steps // 2
        values = [before] * first + [value] * (steps - first)
        chosen = zip(self.actions(seed, steps), values, strict=True)
        return self.play(seed, [self.change(action, {dimension: one}) for action, one in chosen])

    def copies(self, dimension: ActionNumber, seed: int, steps: int, longest_delay: int) -> list[int]:
        """Return the columns of a frame that only repeat this number of an earlier action."""
        rows = [frame[:REWARD] for frame in self.plain(seed, steps)[1:]]
        chosen = [flatten_action(self.instance.action_leaves, action) for action in self.actions(seed, len(rows))]
        values = np.array([action[dimension.column] for action in chosen])
        if not rows or len({row.shape for row in rows}) > 1:
            return []
        returned = np.stack(rows)
        is_copy = np.zeros(returned.shape[1], np.bool_)
        for delay in range(min(longest_delay + 1, len(values) // 2)):
            late = values[: len(values) - delay, None]
            is_copy |= ((returned[delay:] == late) | (returned[delay:] == late.astype(np.float32))).all(axis=0)
        return (np.flatnonzero(is_copy) + REWARD - len(is_copy)).tolist()


def _to_frame(moment: Moment) -> Frame:
    try:
        reward = float(moment.reward)
    except Exception:  # its type is another rule's matter
        reward = float("nan")
    return np.concatenate([flatten(moment.observation).astype(np.float64), [reward, *moment.flags]])


def find_differences(one: Sequence[Frame], two: Sequence[Frame], tolerance: float = 0.0) -> dict[int, NDArray[np.intp]]:
    """Return the columns that differ, by step; NaN equals NaN. Columns are counted from the end: -1 and -2 are the
    flags, then `REWARD`, then the elements of the observation."""
    differences = {}
    for step, (a, b) in enumerate(zip(one, two, strict=False)):
        if a.shape != b.shape:
            differences[step] = np.arange(REWARD, 0)
        elif (differ := ~(np.abs(a - b) <= tolerance) & (a != b) & ~(np.isnan(a) & np.isnan(b))).any():
            differences[step] = np.flatnonzero(differ) - len(a)
    return differences


def observations_differ(one: Sequence[Frame], two: Sequence[Frame], besides: Sequence[int] = ()) -> bool:
    """Say whether observations or flags differ, with some columns left out."""
    differing = {column for columns in find_differences(one, two).values() for column in columns.tolist()}
    return bool(differing - {REWARD, *besides})


def find_other_rewards(one: Sequence[Frame], two: Sequence[Frame]) -> list[int]:
    """Return the steps at which the rewards differ."""
    return [step for step, columns in find_differences(one, two).items() if REWARD in columns]
