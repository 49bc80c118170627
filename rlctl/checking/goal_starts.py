"""Goals that are where an episode starts, and draws of goals that come to nothing."""

import ast
import itertools
import re
import sys
from collections.abc import Iterator, Sequence

import numpy as np

from rlctl.checking.assignments import Assignment, read_key, read_name, read_words
from rlctl.checking.experiments.expressions import NotedEpisodes
from rlctl.checking.expressions import NotedCall, Value
from rlctl.checking.goal_draws import has_draw, is_draw, is_drawn
from rlctl.checking.previous_values import is_goal
from rlctl.checking.source_code import Expression, FaultyCode, Function, walk_own, write_code
from rlctl.checking.stale_values import FIRST_WORDS
from rlctl.checking.term_names import split_name
from rlctl.checking.values import list_own_classes

AIM_WORDS = {"aim", "desired"}
STAYING_WORDS = {
    "balance", "balances", "balancing", "hold", "holds", "holding", "home", "hover", "hovers", "hovering", "keep",
    "keeps", "keeping", "stabilize", "stabilizes", "stabilization", "stand", "stands", "station", "stay", "stays",
}  # fmt: skip
"""What an environment says of itself whose goal is to stay where it starts."""
SAME = 1e-5
MOVED = 1e-3
FEWEST_EPISODES = 3
UNUSED = {"_", "dummy", "unused", "ignored"}


class GoalStarts:
    """Finds them."""

    def __init__(self, noted: NotedEpisodes) -> None:
        self.noted, self.definitions, self.source = noted, noted.definitions, noted.source
        self.resets = [episode[0] for episode in noted.episodes]

    def _make(self, node: ast.stmt | ast.expr, what: str) -> FaultyCode:
        return FaultyCode(node, f"{write_code(node)}: {what}", self.source.find_place(node))

    def _list_goals(self) -> Iterator[tuple[str, list[Assignment]]]:
        """Yield the attributes that are goals, and where resets set them; not what steps set."""
        for key, assignments in self.definitions.assigned.items():
            of_resets = [one for one in assignments if one.function in self.noted.of_resets]
            of_steps = [one for one in assignments if one.function in self.noted.of_steps]
            words = {*read_words(key)}
            if of_resets and not of_steps and (is_goal(key) or words & AIM_WORDS) and not words & FIRST_WORDS:
                yield key, of_resets

    def find_at_start(self) -> Iterator[FaultyCode]:
        """Yield goals that are, at each start, what they are compared with."""
        if len(self.noted.episodes) < FEWEST_EPISODES or self._is_to_stay():
            return
        for key, assignments in self._list_goals():
            goal = self._read_goal(key)
            for state in self._list_compared(key) if goal is not None else ():
                if self._is_same(state, goal):
                    what = f"at each of {len(self.resets)} starts this is {state.text}, with which it is compared: the"
                    what += " goal is always where the robot starts"
                    yield self._make(assignments[-1].statement, what)
                    break

    def _is_to_stay(self) -> bool:
        said: list[str] = []
        for cls in list_own_classes(self.source.author):
            module = sys.modules.get(cls.__module__)
            classes = [one for one in vars(module).values() if isinstance(one, type)] if module is not None else []
            is_alone = [one for one in classes if one.__module__ == cls.__module__] == [cls]
            texts = [cls.__doc__, module.__doc__ if module is not None and is_alone else None]
            said += [*split_name(cls.__name__), *(word for text in texts for word in re.split(r"\W+", text or ""))]
        return bool({word.lower() for word in said} & STAYING_WORDS)

    def _read_goal(self, key: str) -> list[Value] | None:
        """Return the value of a goal at the end of each reset; None unless it is another one in each."""
        several = [one for one in self.source.expressions if read_key(one.node) == key]
        numbers = {one.number for one in several if isinstance(one.node, ast.Attribute)}
        values = [
            next((value for number, value in reversed(call.events) if number in numbers), None) for call in self.resets
        ]
        is_known = all(value is not None for value in values)
        return values if is_known and all(not _equal(values[0], other) for other in values[1:]) else None

    def _list_compared(self, key: str) -> Iterator[Expression]:
        """Yield what is subtracted from a goal, or the other way round, and what that is computed from."""
        for one in self.source.expressions:
            if not isinstance(one.node, ast.BinOp) or not isinstance(one.node.op, ast.Sub):
                continue
            for side, other in ((one.node.left, one.node.right), (one.node.right, one.node.left)):
                if read_key(self.definitions.find_origin(side, one.function)) != key:
                    continue
                for top, _ in self.definitions.list_sources(other, one.function):
                    for node in ast.walk(top):
                        found = self.source.find(node)
                        if found is not None and key not in self.definitions.list_reads(node, found.function):
                            yield found

    def _is_same(self, state: Expression, goal: list[Value] | None) -> bool:
        values = [_read_last(call, state.number) for call in self.resets]
        if goal is None or not all(_equal(one, other) for one, other in zip(values, goal, strict=True)):
            return False
        later = [value for call in self.noted.episodes[0][1:] for value in call.values.get(state.number, ())]
        return any(value is not None and not _equal(value, values[0], MOVED) for value in later)

    def find_vain_draws(self) -> Iterator[FaultyCode]:
        """Yield goals that resets draw and that are then replaced, or never used, or that have no choice."""
        for function in self.noted.of_resets:
            if not isinstance(function, Function) or function in self.noted.of_steps:
                continue
            for text, several in self.definitions.list_assigned(function).items():
                first = several[0]
                if self._is_unused(first, function):
                    yield self._make(first.statement, "it is drawn, and nothing reads it")
                for one, other in itertools.pairwise(several):
                    if is_goal(read_key(one.target)) and self._replaces(one, other, text, function):
                        what = f"it is drawn, and replaced at once by {write_code(other.value)}"
                        yield self._make(one.statement, what)

    def find_first_draws(self) -> Iterator[FaultyCode]:
        """Yield goals that only the first reset draws, as long as the environment lasts."""
        for _, assignments in self._list_goals():
            drawn = [one for one in assignments if is_drawn(self.definitions, one.value, one.function)]
            if any(self._is_of_later_reset(one.value) for one in drawn):
                continue  # a draw again, where the first was too near to something
            for one in drawn:
                draw = self._find_draw(one)
                draws: list[ast.AST] = [node for node in ast.walk(draw) if is_draw(node)]
                if self._is_of_first_reset([one.value]) or self._is_of_first_reset(draws):
                    yield self._make(one.statement, "only the first reset draws this goal, and later ones keep it")

    def _is_of_later_reset(self, node: ast.AST) -> bool:
        found = self.source.find(node)
        return found is not None and any(found.number in call.values for call in self.resets[1:])

    def _is_of_first_reset(self, nodes: Sequence[ast.AST]) -> bool:
        """Say whether the first reset evaluates some of these expressions, and no later one does."""
        numbers = [found.number for node in nodes if (found := self.source.find(node)) is not None]
        times = [any(number in call.values for number in numbers) for call in self.resets]
        return len(times) > 1 and times[0] and not any(times[1:])

    def _find_draw(self, one: Assignment) -> ast.expr:
        for node in ast.walk(one.value):
            if isinstance(node, ast.Name):
                origin = self.definitions.find_origin(node, one.function)
                if is_draw(origin):
                    return origin
        return one.value

    def _is_unused(self, one: Assignment, function: Function) -> bool:
        """Say whether a local goal is drawn and never read."""
        if not isinstance(one.target, ast.Name) or one.element is not None or not has_draw(one.value):
            return False
        name = one.target.id
        reads = [node for node in ast.walk(function) if isinstance(node, ast.Name) and node.id == name]
        is_read = any(isinstance(node.ctx, ast.Load) for node in reads)
        is_outer = any(isinstance(node, ast.Global | ast.Nonlocal) for node in walk_own(function))
        return not is_read and not is_outer and is_goal(name) and name not in UNUSED

    def _replaces(self, one: Assignment, other: Assignment, text: str, function: Function) -> bool:
        """Say whether a draw is replaced, in the same lines, by what has nothing to do with it."""
        parents = self.source.parents
        is_plain = parents[one.statement] is parents[other.statement] and one.statement is not other.statement
        is_plain &= not isinstance(other.statement, ast.AugAssign)
        if not is_plain or not has_draw(one.value) or one.added or other.added or one.element is not None:
            return False
        first, last = one.statement.end_lineno or 0, other.statement.end_lineno or 0
        between = [node for node in walk_own(function) if first < getattr(node, "lineno", 0) <= last]
        key, target = read_key(one.target), read_name(one.target)
        is_read = any(
            isinstance(node, ast.expr)
            and isinstance(getattr(node, "ctx", None), ast.Load)
            and (read_key(node) == key or read_name(node) == target)
            for node in between
        )
        calls = [
            node
            for node in between
            if isinstance(node, ast.Call) and read_name(node.func) in self.definitions.functions
        ]
        if is_read or any(key in self.definitions.list_reads(call, function) for call in calls):
            return False
        return not isinstance(one.target, ast.Subscript) and not has_draw(other.value)


def _read_last(call: NotedCall, number: int) -> Value:
    values = call.values.get(number, ())
    return values[-1] if values else None


def _equal(one: Value, other: Value, tolerance: float = SAME) -> bool:
    if one is None or other is None or np.size(one) != np.size(other):
        return False
    return bool(np.allclose(np.ravel(one), np.ravel(other), rtol=tolerance, atol=tolerance))
