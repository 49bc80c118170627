"""Differences to values that are kept from step to step: `self.prev_dist - dist`, and which of them are wrong."""

import ast
import dataclasses
import itertools
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from rlctl.checking.assignments import Assignment, read_key, read_words
from rlctl.checking.experiments.expressions import NotedEpisodes
from rlctl.checking.expressions import NotedCall, Value
from rlctl.checking.source_code import Expression
from rlctl.checking.term_names import ERROR_WORDS, is_place, split_name

PREVIOUS_WORDS = {"before", "former", "last", "old", "prev", "previous", "prior", "past"}
TIME_NAMES = {"t", "time", "step", "steps", "clock", "count", "counter", "tick", "ticks", "elapsed"}
GOAL_NAMES = {
    "gate", "gates", "command", "commands", "cmd", "index", "idx", "stage", "leg", "checkpoint", "objective",
    "destination", "setpoint", "station", "wp", "next", "current", "which", "active", "reference", "ref", "spot",
    "course", "lap",
}  # fmt: skip
SIZE_WORDS = {
    "angle",
    "bearing",
    "cost",
    "gap",
    "heading",
    "potential",
    "progress",
    "range",
    "reward",
    "score",
    "speed",
}
MOST_REPLACED = 0.1  # part of the steps in which new goals come
FEWEST_CHANGES = 20  # steps in which the new value is another one than before
ZERO = 1e-6  # part of the changes of the new value
FORCED = 0.37  # what a difference is set to, to see whether it is paid


@dataclasses.dataclass(frozen=True, eq=False)
class KeptDifference:
    """A difference between a value and what an attribute has kept of it."""

    whole: Expression
    kept: Expression
    new: Expression
    key: str  # of the attribute
    origin: ast.expr  # where the new value comes from

    def list_values(self, calls: Sequence[NotedCall]) -> list[tuple[Value, Value, Value]]:
        """Return the difference, what was kept, and the new value, each time that they were known."""
        numbers = [self.kept.number, self.new.number]
        return [(whole, *parts) for call in calls for whole, parts in call.pair(self.whole.number, numbers)]  # type: ignore[misc]


class KeptDifferences:
    """Those of a source, and the judgements of them."""

    def __init__(self, noted: NotedEpisodes) -> None:
        self.noted, self.definitions = noted, noted.definitions
        self.differences = [one for expression in noted.source.expressions for one in self._read(expression)]
        self._flags = [
            one
            for whole in noted.source.expressions
            if (sides := _read_flags(whole.node)) is not None
            for one in self.read_pair(whole, sides)
        ]

    def _read(self, whole: Expression) -> Iterator[KeptDifference]:
        if (sides := read_sides(whole.node)) is not None:
            yield from self.read_pair(whole, sides)

    def read_pair(self, whole: Expression, sides: tuple[ast.expr, ast.expr]) -> Iterator[KeptDifference]:
        """Yield an expression of two sides as one of what an attribute has kept and of another value."""
        for one, other in (sides, sides[::-1]):
            kept, new = self.noted.source.find(one), self.noted.source.find(other)
            origin = self.definitions.find_origin(one, whole.function)
            if kept is None or new is None or not (key := read_key(origin)) or key not in self.definitions.assigned:
                continue
            new_origin = self.definitions.find_origin(other, whole.function)
            if ast.unparse(new_origin) != ast.unparse(origin):
                yield KeptDifference(whole, kept, new, key, new_origin)

    def find_never_replaced(self) -> Iterator[KeptDifference]:
        """Yield differences whose kept value stays what reset has set, although steps subtract it."""
        for one in (*self.differences, *self._flags):
            if not is_previous_key(one.key) or self._may_be_replaced(one):
                continue
            episodes = [one.list_values(episode[1:]) for episode in self.noted.episodes]
            replaced = [
                change > 0 for episode in episodes for change in list_changes([values[1] for values in episode])
            ]
            if not replaced or np.mean(replaced) > MOST_REPLACED:
                continue
            changes = [change for episode in episodes for change in list_changes([values[2] for values in episode])]
            moving = np.array([change for change in changes if change > 0])
            is_clock = one not in self._flags and moving.size and np.ptp(moving) < ZERO * moving.max()
            if len(moving) < FEWEST_CHANGES or is_clock:
                continue
            if not {*read_words(one.key)} & TIME_NAMES and self.is_paid(one):
                yield one

    def _may_be_replaced(self, one: KeptDifference) -> bool:
        """Say whether code of a step replaces what is kept, other than where a new goal comes."""
        return any(
            assignment.function in self.noted.of_steps and not self.comes_with_goal(assignment)
            for assignment in self.definitions.assigned[one.key]
        )

    def comes_with_goal(self, assignment: Assignment) -> bool:
        """Say whether an assignment stands under an `if`, or in a function besides `step`, that also sets a goal."""
        conditions = self.definitions.list_conditions(assignment.statement)
        if not conditions and assignment.function is self.definitions.find_function("step"):
            return False
        blocks: list[Sequence[ast.AST]] = [] if conditions else [assignment.function.body]
        for test, is_met in conditions:
            branch = self.noted.source.parents[test]
            assert isinstance(branch, ast.If | ast.IfExp)
            side = branch.body if is_met else branch.orelse
            blocks.append(side if isinstance(side, list) else [side])
        return any(is_goal(key) for block in blocks for node in block for key in self.definitions.list_sets(node))

    def is_paid(self, one: KeptDifference) -> bool:
        """Say whether another difference in one step changes the reward of this step."""
        for number, episode in enumerate(self.noted.episodes):
            steps = [call.step for call in episode[1:] if one.whole.number in call.values]
            if steps:
                return self.is_paid_at(one, number, steps[len(steps) // 2], {})
        return False

    def is_paid_at(self, one: KeptDifference, number: int, step: int, forced: Mapping[int, Mapping[int, Any]]) -> bool:
        """Say whether another difference in a step of an episode changes the reward of this step."""
        value = next(iter(self.noted.episodes[number][step].values.get(one.whole.number, [0.0])))
        zero, large = (
            {one.whole.number: np.full(np.shape(value), size) if isinstance(value, np.ndarray) else size}
            for size in (0.0, FORCED)
        )
        return bool(self.noted.changes(number, step, zero, large, forced=forced))


def is_previous_key(key: str) -> bool:
    """Say whether a key names what was before. The last goal is the end of a course; the last distance to it is not."""
    return any({*split_name(name)} & PREVIOUS_WORDS and not _is_goal_itself(name) for name in key.split("."))


def is_goal(key: str) -> bool:
    """Say whether a key names a goal, or which one it is."""
    return bool({*split_name(key)} & GOAL_NAMES or _is_goal_itself(key)) and not is_previous_key(key)


def _is_goal_itself(name: str) -> bool:
    return is_place(name) and not {*split_name(name)} & (ERROR_WORDS | SIZE_WORDS)


def read_sides(node: ast.expr) -> tuple[ast.expr, ast.expr] | None:
    """Return what is subtracted from each other; None for other expressions."""
    match node:
        case ast.BinOp(left=left, op=ast.Sub(), right=right):
            return left, right
        case ast.Call(func=ast.Attribute(attr="subtract" | "change" | "difference"), args=[left, right]):
            return left, right
    return None


def _read_flags(node: ast.expr) -> tuple[ast.expr, ast.expr] | None:
    """Return two flags of which it is asked whether both hold, or whether they are the same."""
    match node:
        case ast.BinOp(left=left, op=ast.BitAnd() | ast.BitXor(), right=right):
            return left, right
        case ast.Compare(left=left, ops=[ast.Eq() | ast.NotEq()], comparators=[right]):
            return left, right
        case ast.Call(func=ast.Attribute(attr="logical_and" | "logical_xor"), args=[left, right]):
            return left, right
    return None


def list_changes(values: Sequence[Value]) -> list[float]:
    """Return how far values are from those before; 0 where they are the same."""
    found = []
    for before, after in itertools.pairwise(values):
        if before is None or after is None or np.shape(before) != np.shape(after):
            found.append(0.0)
        else:
            found.append(float(np.max(np.abs(np.subtract(after, before)), initial=0.0)))
    return found
