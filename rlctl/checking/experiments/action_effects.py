"""The experiment `action effects`: changes numbers of the action, for rules about what they do."""

import collections
import dataclasses
from collections.abc import Iterator, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from rlctl.checking import action_trials
from rlctl.checking.action_trials import REPEATED_STEPS, REWARD, ActionNumber, Frame, Trials
from rlctl.checking.episode import EpisodePlayer, zero_action
from rlctl.checking.experiment import INSTANCES, JudgeHook, experiment
from rlctl.checking.instance import Context
from rlctl.checking.records import FIRST_SEED, SECOND_SEED, ChildMessage, Fact
from rlctl.checking.rule import NotJudged
from rlctl.checking.values import Attribute, find_unequal, read_attributes

DELAY_STEPS = 4  # Of episodes whose first action is changed
MOSTLY = 0.6  # part of the pairs
ROUNDING = 1e-9  # up to which rewards may differ where a robot mirrors itself
Changes = Mapping[int, NDArray[np.intp]]
"""The columns of observation and reward that differ, by step."""


@dataclasses.dataclass(frozen=True)
class ActionTrials:
    """Episodes of one instance that repeat exactly, in which single numbers of the action can be changed."""

    trials: Trials
    dimensions: Sequence[ActionNumber]  # All numbers of the action that can be varied
    repeats: Sequence[int]  # Columns of a frame that only repeat a number of the step's action
    earliest: set[int]  # The first steps at which anything else of the observation follows the first action
    rewarded: set[int]  # The first steps at which the reward follows the direction of the first action; 0 for none

    @property
    def is_late(self) -> bool:
        """Whether the observation, but for what repeats the action, always follows the first action at the second step,
        or at the same later one."""
        return len(self.earliest) == 1 and min(self.earliest) > 1


judges_actions = JudgeHook[ActionTrials]()
"""Shows trials, with which the parts play episodes."""


@experiment("action effects", INSTANCES, 60, share=4.0, hooks=(judges_actions,), seeds_globals=True)
def compare_actions(context: Context) -> Iterator[ChildMessage]:
    """Play the same episode with each number of the action at other values."""
    with context.fresh() as instance:
        dimensions = action_trials.find_dimensions(instance.action_leaves)
        if not dimensions:
            raise NotJudged("no element of the action can be varied")
        trials = Trials(instance)
        trials.require_repeatable()
        pairs, opposites = _play_first_actions(trials, dimensions)
        repeats = [column for one in dimensions for column in trials.copies(one, FIRST_SEED, REPEATED_STEPS, 0)]
        first = [_first_changes(pair, repeats) for pair in pairs]
        earliest = {min(steps.values(), default=0) for steps in first}
        shown = ActionTrials(trials, dimensions, repeats, earliest, _find_first_rewards(opposites))
        if not shown.is_late:
            yield from _measure_delays(trials, dimensions, pairs, opposites)
        yield from judges_actions.judge(shown)


def _play_first_actions(
    trials: Trials, dimensions: Sequence[ActionNumber]
) -> tuple[Sequence[Changes], Sequence[Changes]]:
    """Return what changes with the first action: from none to one end of its range, and from one end to the other."""
    pairs, opposites = [], []
    for seed in (FIRST_SEED, SECOND_SEED, SECOND_SEED + 1):
        plain = trials.plain(seed, DELAY_STEPS)
        for end in (0, 1):
            values = {dimension: dimension.ends[end] for dimension in dimensions}
            pairs.append(action_trials.find_differences(plain, trials.with_values(seed, DELAY_STEPS, values, at=0)))
        low, high = _play_opposites(trials, dimensions, seed)
        opposites.append(action_trials.find_differences(low, high, ROUNDING))
    return pairs, opposites


def _measure_delays(
    trials: Trials, dimensions: Sequence[ActionNumber], pairs: Sequence[Changes], opposites: Sequence[Changes]
) -> Iterator[Fact]:
    # Whatever the integrator: an element that answers later, such as a position, may be what the reward depends on.
    # It would answer in every pair in which the reward does; what the robot bumps into answers in a few.
    observed, count = _count_last(pairs).most_common(1)[0]
    if observed and count >= MOSTLY * len(pairs):
        is_late = any(
            _find_first_rewards(group) == {observed + 1} and _count_last(group)[observed] >= MOSTLY * len(group)
            for group in (pairs, opposites)
        )
        steps = {"observation": observed, "reward": observed + 1 if is_late else observed}
        yield Fact("action effects", steps | {"state": _find_last_state(trials, dimensions) if is_late else 0})


def _count_last(pairs: Sequence[Changes]) -> collections.Counter[int]:
    """Count the steps by which everything has changed that the first action changes; 0 where it changes nothing."""
    return collections.Counter(max(_first_changes(pair).values(), default=0) for pair in pairs)


def _play_opposites(trials: Trials, dimensions: Sequence[ActionNumber], seed: int) -> list[list[Frame]]:
    """Play two episodes of zero actions, but for the first ones, which are as far from 0 to one side as to the other: a
    cost of acting, or of changing the action, is the same in both."""
    return [trials.with_first(seed, DELAY_STEPS, values) for values in _list_opposites(dimensions)]


def _list_opposites(dimensions: Sequence[ActionNumber]) -> list[dict[ActionNumber, float]]:
    sizes = {dimension: min(map(abs, dimension.ends)) for dimension in dimensions if min(dimension.ends) < 0}
    return [{dimension: sign * size for dimension, size in sizes.items()} for sign in (-1, 1)]


def _find_last_state(trials: Trials, dimensions: Sequence[ActionNumber]) -> int:
    """Return the step by which the first action has changed all attributes that it changes; 0 where there are none."""
    looks: list[list[Mapping[str, Attribute]]] = []
    nothing = zero_action(trials.instance.env.action_space)
    for values in _list_opposites(dimensions):
        sequence = [trials.change(nothing, values), *[nothing] * (DELAY_STEPS - 1)]
        player = EpisodePlayer(trials.instance, FIRST_SEED, sequence=sequence, max_steps=DELAY_STEPS)
        looks.append([read_attributes(trials.instance.env) for moment in player if moment.step])
    first: dict[tuple[str, int], int] = {}
    for step, (one, two) in enumerate(zip(*looks, strict=False), start=1):
        for name in find_unequal(one, two):
            for place in np.flatnonzero(one[name].numbers != two[name].numbers).tolist():
                first.setdefault((name, place), step)
    return max(first.values(), default=0)


def _find_first_rewards(pairs: Sequence[Changes]) -> set[int]:
    return {min((step for step, columns in pair.items() if REWARD in columns), default=0) for pair in pairs}


def _first_changes(differences: Changes, besides: Sequence[int] = ()) -> dict[int, int]:
    """Return the first step at which each element of the observation differs, by column, with some left out."""
    steps = sorted(differences, reverse=True)
    first = {column: step for step in steps for column in differences[step].tolist() if column < REWARD}
    return {column: step for column, step in first.items() if column not in besides}
