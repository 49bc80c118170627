"""Differences of two directions of the source that are not wrapped: a whole turn more changes the reward."""

import ast
import functools
import math
from collections.abc import Callable, Iterator, Sequence

import numpy as np

from rlctl.checking.assignments import read_key, read_name
from rlctl.checking.definitions import ReadExpression
from rlctl.checking.episode import Moment
from rlctl.checking.experiments.expressions import NotedEpisodes, read_observation, read_reward
from rlctl.checking.expressions import NotedCall, Number, Value
from rlctl.checking.previous_values import list_changes
from rlctl.checking.source_code import Expression
from rlctl.checking.worlds import Array

TURN = 2 * math.pi
SLACK = 1.01  # a wrapped difference may be pi, and a little more by rounding
CIRCULAR = {"sin", "cos", "sincos"}
WRAPPED = {"arctan2", "atan2", "remainder", "angle"}
NEAR_JUMP = 2.0  # of an angle that is wrapped, and jumps at pi [rad]
FEWEST_CALLS = 10  # in which a side of a difference is what a sine is of
SAME = 1e-9
ROUNDED = 1e-6  # a turn less has another sine in its last digits


class UnwrappedAngles:
    """Finds them.

    An angle of which the source takes a sine or a cosine, and one that is wrapped or that `arctan2` returns, is a
    direction: a whole turn more is the same one.
    """

    def __init__(self, notes: NotedEpisodes) -> None:
        self.notes, self.source = notes, notes.source
        self._calls = [call for episode in notes.episodes for call in episode]
        parents = self.source.parents
        self._circular = [
            one
            for one in self.source.expressions
            if isinstance(call := parents.get(one.node), ast.Call)
            and read_name(call.func) in CIRCULAR
            and one.node in call.args
        ]

    def find_paid(self) -> Iterator[tuple[Expression, float]]:
        """Yield differences that are paid, each with the largest one that was noted [rad]; what is wrapped may jump by
        a turn."""
        for one, largest in self._differences:
            if self._matters(one, read_reward):
                yield one, largest

    def find_shown(self) -> Iterator[tuple[Expression, float]]:
        """Yield differences that are observed and were more than half a turn, of directions that turn round: a joint
        with stops has to go the long way."""
        for one, largest in self._differences:
            assert isinstance(one.node, ast.BinOp)
            turn_round = all(map(self._turns_round, (one.node.left, one.node.right)))
            if largest > SLACK * math.pi and turn_round and self._matters(one, read_observation):
                yield one, largest

    @functools.cached_property
    def _differences(self) -> list[tuple[Expression, float]]:
        """Those of two directions that may jump, each with the largest one [rad]."""
        found = []
        for one in self.source.expressions:
            match one.node:
                case ast.BinOp(left=left, op=ast.Sub(), right=right):
                    largest = self._find_largest(one)
                    may_jump = largest > SLACK * math.pi or any(map(self._jumps, (left, right)))
                    if may_jump and all(map(self._is_direction, (left, right))):
                        found.append((one, largest))
        return found

    def _find_largest(self, one: Expression) -> float:
        return max(map(_size, _list_values(one, self._calls)), default=0.0)

    def _turns_round(self, node: ast.expr) -> bool:
        """Say whether an angle is wrapped, by the source or by what it was, or goes on beyond half a turn."""
        side = self.source.find(node)
        if side is None:
            return False
        rows = [
            [call.values[side.number][-1] for call in episode if side.number in call.values]
            for episode in self.notes.episodes
        ]
        changes = [change for row in rows for change in list_changes(row)]
        seen = max([self._find_largest(side), *changes])
        return self._is_wrapped(side) or seen > SLACK * math.pi

    def _jumps(self, node: ast.expr) -> bool:
        """Say whether an angle is wrapped, and may be where it is."""
        side = self.source.find(node)
        return side is not None and self._is_wrapped(side) and self._find_largest(side) > NEAR_JUMP

    def _is_wrapped(self, side: Expression) -> bool:
        assigned = self.notes.definitions.assigned.get(read_key(side.node), ())
        places = [ReadExpression(one.value, one.function) for one in assigned if one.element is None]
        return any(map(self._wraps, places or [ReadExpression(side.node, side.function)]))

    def _wraps(self, place: ReadExpression) -> bool:
        match self.notes.definitions.resolve(place).node:
            case ast.Call(func=function):
                return read_name(function) in WRAPPED
            case (
                ast.BinOp(op=ast.Mod(), right=turn) | ast.BinOp(left=ast.BinOp(op=ast.Mod(), right=turn), op=ast.Sub())
            ):
                return any(sign in ast.unparse(turn) for sign in ("pi", "tau", "6.28"))
        return False

    def _is_direction(self, node: ast.expr) -> bool:
        side = self.source.find(node)
        if side is None:
            return False
        return self._is_wrapped(side) or any(
            other is not side and self._is_same(side, other) for other in self._circular
        )

    def _is_same(self, side: Expression, other: Expression) -> bool:
        """Say whether two expressions were the same angle in all calls that had both, and in different ones."""
        pairs = [
            (call.values[side.number][-1], call.values[other.number][-1])
            for call in self._calls
            if side.number in call.values and other.number in call.values
        ]
        if len(pairs) < FEWEST_CALLS or any(a is None or b is None or np.shape(a) != np.shape(b) for a, b in pairs):
            return False
        a, b = np.array(pairs, np.float64).reshape(len(pairs), 2, -1).transpose(1, 0, 2)
        return bool(np.abs(a - b).max() <= SAME and np.ptp(a, axis=0).min() > 0)

    def _matters(self, one: Expression, read: Callable[[Moment], Array]) -> bool:
        """Say whether a turn less changes something of a step, one with a large difference if there are some."""
        steps = [
            (_size(value), number, call.step, value)
            for number, episode in enumerate(self.notes.episodes)
            for call in episode[1:]
            for value in call.values.get(one.number, ())
        ]
        if not steps:
            return False
        _, number, step, value = max(steps, key=lambda found: found[0])
        if value is None:
            return False
        same, turned = ({one.number: given} for given in (value, _turn_back(value)))
        return bool(self.notes.changes(number, step, same, turned, read=read, tolerance=ROUNDED))


def _list_values(one: Expression, calls: Sequence[NotedCall]) -> list[Value]:
    return [value for call in calls for value in call.values.get(one.number, ())]


def _size(value: Value) -> float:
    return 0.0 if value is None else float(np.max(np.abs(value), initial=0.0))


def _turn_back(value: Number) -> Number:
    turned = value - np.where(np.asarray(value) < 0, -TURN, TURN)
    return turned if isinstance(value, np.ndarray) else float(turned)
