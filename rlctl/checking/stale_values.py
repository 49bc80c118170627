"""Attributes that a step should set and does not: copies of a goal, and times for which something has to last."""

import ast
import dataclasses
import itertools
from collections.abc import Iterator

import numpy as np

from rlctl.checking.assignments import Assignment, read_key, read_words
from rlctl.checking.experiments.expressions import NotedEpisodes
from rlctl.checking.expressions import NotedCall, Value
from rlctl.checking.goal_draws import BEFORE, Branch, GoalDraws
from rlctl.checking.previous_values import KeptDifferences, is_previous_key
from rlctl.checking.source_code import Expression

FIRST_WORDS = {
    "start", "started", "initial", "init", "first", "default", "nominal", "home", "original", "base", "begin", "origin",
    "0",
}  # fmt: skip
"""What is meant to stay what reset sets."""
LASTING_WORDS = {
    "held", "hold", "holding", "dwell", "stay", "stayed", "settled", "settle", "stable", "streak", "consecutive",
    "still", "lasting",
}  # fmt: skip
SUM_WORDS = {"total", "sum", "all", "ever", "cumulative", "score"}
AFTER = 3  # steps after a new goal
FEW_EPISODES = 5


@dataclasses.dataclass(frozen=True)
class StaleCopy:
    """A copy of a goal that is read after the goal has changed."""

    copy: str
    goal: str
    read: Expression


class StaleValues:
    """What no step sets, though it should."""

    def __init__(self, noted: NotedEpisodes) -> None:
        self.noted, self.definitions = noted, noted.definitions
        self.draws, self.kept = noted.share(GoalDraws), noted.share(KeptDifferences)

    def find_stale_copies(self) -> Iterator[StaleCopy]:
        """Yield copies that no step makes, of goals that steps change: afterwards both are read."""
        for key, assignments in self.definitions.assigned.items():
            goals = {self._read_copied(one) for one in assignments}
            goal = goals.pop() if len(goals) == 1 else ""
            is_meant = {*read_words(key)} & FIRST_WORDS or is_previous_key(key) or key[-1].isdigit()
            is_set = any(one.function in self.noted.of_steps for one in assignments)
            if not goal or goal == key or is_meant or is_set:
                continue
            for one in self.definitions.assigned.get(goal, ()):
                if self.draws.is_new_goal(goal, one) and key not in self.definitions.list_reads(
                    one.value, one.function
                ):
                    for tests in self.draws.list_tests(one):
                        read = self._find_difference(key, goal, Branch(goal, tests))
                        if read is not None:
                            yield StaleCopy(key, goal, read)
                            return

    def _read_copied(self, assignment: Assignment) -> str:
        origin = self.definitions.find_origin(assignment.value, assignment.function)
        return read_key(origin) if isinstance(origin, ast.Attribute) else ""

    def _find_difference(self, copy: str, goal: str, branch: Branch) -> Expression | None:
        """Return where a copy is read that is another one than the goal, after this has been made to change."""
        number, episode = 0, self.noted.episodes[0]
        step = min(BEFORE, len(episode) - 1 - AFTER)
        if step < 1:
            return None
        played = self.noted.play(number, step + AFTER, {step: self.draws.force(branch)})
        if len(played) < step + AFTER:
            return None
        before, after = played[step - 1][0], played[-1][0]
        changed = [self._list_changed(key, before, after) for key in (copy, goal)]
        if not changed[0] or any(changed[0].values()) or not any(changed[1].values()):
            return None
        return next(iter(changed[0]))

    def _list_changed(self, key: str, before: NotedCall, after: NotedCall) -> dict[Expression, bool]:
        """Return where an attribute is read in both calls, and whether it has changed."""
        reads = [one for one in self.noted.source.expressions if read_key(one.node) == key]
        values = {one: (before.values.get(one.number), after.values.get(one.number)) for one in reads}
        return {one: not _is_same(old[0], new[0]) for one, (old, new) in values.items() if old and new}

    def find_first_only(self) -> Iterator[StaleCopy]:
        """Yield attributes that only the first reset sets, from others that each reset sets."""
        for key, assignments in self.definitions.assigned.items():
            of_episodes = [one for one in assignments if one.function in self.noted.of_resets]
            if len(of_episodes) != 1 or not self._is_once(of_episodes[0], key):
                continue
            (one,) = of_episodes
            for name in sorted(self.definitions.list_reads(one.value, one.function) - {key}):
                read = self._find_kept(key, name)
                if read is not None:
                    yield StaleCopy(key, name, read)
                    return

    def _is_once(self, assignment: Assignment, key: str) -> bool:
        """Say whether an assignment, or a call of its function, stands under `if self.goal is None`, or the like, and
        no step runs it."""
        calls = [
            call for call, caller in self.definitions.calls[assignment.function.name] if caller in self.noted.of_resets
        ]
        places = [assignment.statement, *calls[: len(calls) == 1]]
        for test, is_met in [pair for place in places for pair in self.definitions.list_conditions(place)]:
            match test:
                case ast.Compare(left=left, ops=[ast.Is() | ast.IsNot() as operator], comparators=[ast.Constant(None)]):
                    is_missing = is_met == isinstance(operator, ast.Is)
                case ast.UnaryOp(
                    op=ast.Not(), operand=ast.Call(func=ast.Name(id="hasattr"), args=[_, ast.Constant(name)])
                ):
                    return is_met and name == key and assignment.function not in self.noted.of_steps
                case _:
                    continue
            if is_missing and read_key(left) == key:
                return assignment.function not in self.noted.of_steps
        return False

    def _find_kept(self, key: str, name: str) -> Expression | None:
        """Return where an attribute is read that stays the same in all episodes, while another one, from which it was
        computed, is another one in each."""
        kept, drawn = (
            [
                (one, [episode[1].values[one.number][0] for episode in self.noted.episodes[:FEW_EPISODES]])
                for one in self.noted.source.expressions
                if read_key(one.node) == which
                and all(len(episode) > 1 and one.number in episode[1].values for episode in self.noted.episodes)
            ]
            for which in (key, name)
        )
        is_drawn = any(
            not _is_same(before, after) for _, values in drawn for before, after in itertools.pairwise(values)
        )
        same = (one for one, values in kept if all(_is_same(values[0], value) for value in values))
        return next(same, None) if is_drawn else None

    def find_never_set_back(self) -> Iterator[Assignment]:
        """Yield where a time goes on that has to last without a break: no step sets it back where its condition does
        not hold."""
        for key, assignments in self.definitions.assigned.items():
            words = {*read_words(key)}
            if not words & LASTING_WORDS or words & SUM_WORDS or not self._is_required(key):
                continue
            of_steps = [one for one in assignments if one.function in self.noted.of_steps]
            counting = [one for one in of_steps if self._counts_under_condition(one, key)]
            others = [one for one in of_steps if one not in counting and not self.kept.comes_with_goal(one)]
            if len(counting) == 1 and not others:
                yield counting[0]

    def _is_required(self, key: str) -> bool:
        """Say whether an attribute has to be at least something."""
        comparisons = [one.node for one in self.noted.source.expressions if isinstance(one.node, ast.Compare)]
        return any(
            read_key(node.left) == key
            and isinstance(node.ops[0], ast.GtE | ast.Gt | ast.Eq)
            and not (isinstance(node.comparators[0], ast.Constant) and node.comparators[0].value == 0)
            for node in comparisons
        )

    def _counts_under_condition(self, assignment: Assignment, key: str) -> bool:
        """Say whether an assignment adds where a condition holds, and otherwise leaves everything as it is."""
        added: ast.expr | None = None
        match assignment.statement:
            case ast.AugAssign(op=ast.Add(), value=value):
                added = value
            case ast.Assign(value=ast.BinOp(left=left, op=ast.Add(), right=right)):
                others = [other for side, other in ((left, right), (right, left)) if read_key(side) == key]
                added = others[0] if others else None
        if added is None:
            return False
        conditions = self.definitions.list_conditions(assignment.statement)
        if conditions:
            branch = self.noted.source.parents[conditions[0][0]]
            return isinstance(branch, ast.If) and not branch.orelse
        origins = [
            node for top, _ in self.definitions.list_sources(added, assignment.function) for node in ast.walk(top)
        ]
        return any(isinstance(node, ast.Compare | ast.BoolOp | ast.IfExp) for node in origins)


def _is_same(one: Value, other: Value) -> bool:
    if one is None or other is None or np.shape(one) != np.shape(other):
        return False
    return bool(np.allclose(one, other, rtol=1e-5, atol=1e-7))
