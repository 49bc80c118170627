"""Elements of the action that the source clips so that a part of their range has no effect."""

import ast
import dataclasses
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from rlctl.checking.action_trials import ActionNumber, Trials, find_dimensions
from rlctl.checking.episode import draw_actions
from rlctl.checking.experiments.expressions import EPISODES, NotedEpisodes
from rlctl.checking.expressions import NotedCall
from rlctl.checking.records import FIRST_SEED
from rlctl.checking.rule import NotJudged
from rlctl.checking.source_code import Expression
from rlctl.checking.values import flatten_action

Array = NDArray[np.float64]

LEAST_DEAD = 0.25  # part of the range
FEWEST, FEWEST_AT_END = 20, 5  # steps in which an expression follows the action, and in which it is clipped
EXACT = 1e-5  # part of the range of the values; actions are float32
MOST_ELEMENTS = 40  # of what is clipped
INSIDE = 0.98  # part of the dead range


@dataclasses.dataclass(frozen=True, eq=False)
class ClippedExpression:
    """An expression one element of which is a linear function of one number of the action, between two limits."""

    expression: Expression
    column: int  # of the action
    dead: tuple[float, float]  # where the action is clipped, from an end of its range on
    limit: float  # what it is worth there
    part: float  # of the range


@dataclasses.dataclass(frozen=True, eq=False)
class ClippedAction:
    """A number of the action, a part of whose range has no effect."""

    dimension: ActionNumber
    followed: ClippedExpression


class ActionFollowers:
    """Finds expressions that follow one number of the action."""

    def __init__(self, notes: NotedEpisodes) -> None:
        self.notes = notes
        self.dimensions = {one.column: one for one in find_dimensions(notes.instance.action_leaves)}
        self.dimensions = {column: one for column, one in self.dimensions.items() if np.isfinite(one.bounds).all()}
        self.steps: list[tuple[NotedCall, Array]] = []
        space, leaves = notes.instance.env.action_space, notes.instance.action_leaves
        for number, (kind, episode) in enumerate(zip(EPISODES, notes.episodes, strict=False)):
            drawn = draw_actions(space, kind, FIRST_SEED + number)
            self.steps += [(call, flatten_action(leaves, next(drawn))) for call in episode[1:]]

    def find_clipped(self) -> Iterator[ClippedAction]:
        """Yield the numbers of the action of which the source clips a large part of the range at one end, where nothing
        that is observed follows that part. What the source compares, as to fire an engine, is meant."""
        if not self.dimensions or len(self.steps) < FEWEST:
            return
        found: dict[int, ClippedExpression] = {}
        for one in self._list_calls():
            for followed in self._follow(one):
                if followed.part > LEAST_DEAD:
                    found.setdefault(followed.column, followed)
        compared = self._list_compared() if found else set()
        for column, followed in found.items():
            if column not in compared and self._is_dead(self.dimensions[column], followed):
                yield ClippedAction(self.dimensions[column], followed)

    def _list_calls(self) -> list[Expression]:
        """Return the calls that steps evaluate, in that order."""
        first: dict[int, None] = {}
        for call, _ in self.steps[:3]:
            first |= dict.fromkeys(number for number, _ in call.events)
        known = (self.notes.source.expressions[number] for number in first)
        return [one for one in known if isinstance(one.node, ast.Call)]

    def _follow(self, one: Expression) -> Iterator[ClippedExpression]:
        """Yield the elements of an expression that follow the action between two limits."""
        noted = [(call.values.get(one.number, [None])[-1], action) for call, action in self.steps]
        known = [(np.ravel(value), action) for value, action in noted if value is not None]
        if len(known) < FEWEST or len({value.size for value, _ in known}) != 1 or known[0][0].size > MOST_ELEMENTS:
            return
        values, actions = (np.array(rows) for rows in zip(*known, strict=True))
        for row in values.T:
            if np.isfinite(row).all() and np.ptp(row) > 0:
                yield from (found for column in self.dimensions if (found := self._fit(one, row, actions, column)))

    def _fit(self, one: Expression, row: Array, actions: Array, column: int) -> ClippedExpression | None:
        low, high, rounding = row.min(), row.max(), EXACT * np.ptp(row)
        inner = (row > low + rounding) & (row < high - rounding)
        given = actions[:, column]
        if inner.sum() < FEWEST or np.ptp(given[inner]) == 0:
            return None
        slope, offset = np.polyfit(given[inner], row[inner], 1)
        if not slope or np.abs(np.clip(offset + slope * given, low, high) - row).max() > rounding:
            return None
        ends = self.dimensions[column].bounds
        whole = ends[1] - ends[0]
        borders = sorted(round(float((limit - offset) / slope), 6) + 0.0 for limit in (low, high))  # no -0.0
        parts = ((borders[0] - ends[0]) / whole, (ends[1] - borders[1]) / whole)
        side = int(parts[1] > parts[0])
        at_end = np.abs(row - row[given.argmax() if side else given.argmin()]) <= rounding
        is_one_sided = parts[1 - side] <= parts[side] / 2 and at_end.sum() >= FEWEST_AT_END
        dead = (borders[1], ends[1]) if side else (ends[0], borders[0])
        return ClippedExpression(one, column, dead, float(row[at_end][0]), parts[side] if is_one_sided else 0.0)

    def _list_compared(self) -> set[int]:
        """Return the numbers of the action that the source compares, where that is true at times."""
        found: set[int] = set()
        for one in self.notes.source.expressions:
            if (
                not isinstance(one.node, ast.Compare)
                or np.unique(self.notes.reward.numbers.list_values(one.node)).size < 2
            ):
                continue
            sides = (self.notes.source.find(side) for side in (one.node.left, *one.node.comparators))
            found |= {followed.column for side in sides if side is not None for followed in self._follow(side)}
        return found

    def _is_dead(self, dimension: ActionNumber, followed: ClippedExpression) -> bool:
        """Say whether the dead part does the same everywhere, and the rest does not."""
        trials = Trials(self.notes.instance)
        low, high = dimension.bounds
        is_high = followed.dead[1] == high
        end, border, other = (high, followed.dead[0], low) if is_high else (low, followed.dead[1], high)
        inside = end + INSIDE * (border - end)
        try:
            trials.require_repeatable()
            alike = trials.has_same_effect(dimension, end, inside) and trials.has_same_effect(
                dimension, end, (end + inside) / 2
            )
            return alike and not trials.has_same_effect(dimension, (border + other) / 2, end)
        except NotJudged:
            return False
