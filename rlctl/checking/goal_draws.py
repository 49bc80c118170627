"""What is paid in the step in which the source goes on to a new goal, whose branch is forced to be taken, and in the
next one."""

import ast
import dataclasses
import functools
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from rlctl.checking.assignments import Assignment, peel
from rlctl.checking.definitions import Definitions
from rlctl.checking.experiments.expressions import NotedEpisodes
from rlctl.checking.expressions import NotedCall, Value
from rlctl.checking.previous_values import KeptDifference, KeptDifferences, is_goal, is_previous_key
from rlctl.checking.source_code import Expression, Function
from rlctl.checking.timed_expressions import spans_steps

FEW_STEPS = 5
BEFORE = 6  # steps before a new goal comes
JUMP, USUAL = 3.0, 0.95  # times as large as this quantile of the differences in other steps
NEEDED = 2  # episodes in which it jumps
MOST_BRANCHES, MOST_DEEP = 4, 3
DRAWS = {"uniform", "random", "normal", "choice", "integers", "sample", "randint", "standard_normal", "permutation"}
OUTER = {"reset", "__init__", "start"}


@dataclasses.dataclass(frozen=True)
class GoalJump:
    """A difference that counts the change of a goal."""

    difference: KeptDifference
    key: str  # of the goal
    test: str  # the condition under which it changes
    at_once: bool  # in the step in which the goal changes, not in the next one
    jump: float
    usual: float
    episodes: int


@dataclasses.dataclass(frozen=True)
class Branch:
    """How a goal comes to be set in a step: what tests have to be, by their numbers."""

    key: str
    tests: tuple[tuple[int, bool], ...]


class GoalDraws:
    """The branches that go on to new goals."""

    def __init__(self, noted: NotedEpisodes) -> None:
        self.noted, self.definitions, self.kept = noted, noted.definitions, noted.share(KeptDifferences)

    def find_jumps(self) -> Iterator[GoalJump]:
        """Yield differences that jump with a new goal, and are paid."""
        for one in self.kept.differences:
            is_kept = is_previous_key(one.key) or (
                isinstance(one.whole.node, ast.BinOp) and spans_steps(self.noted.source, one.whole, self.noted.steps)
            )
            for branch in self.list_branches(one) if is_kept else ():
                found = self._try(one, branch)
                if found is not None:
                    yield found
                    break

    def list_branches(self, one: KeptDifference) -> list[Branch]:
        """Return the branches in which a step sets a goal that a difference depends on."""
        keys = sorted(self.definitions.list_reads(one.new.node, one.whole.function) & self.definitions.assigned.keys())
        goals = [(key, assignment) for key in keys for assignment in self.definitions.assigned[key]]
        goals = [(key, assignment) for key, assignment in goals if self.is_new_goal(key, assignment)]
        branches = [Branch(key, tests) for key, assignment in goals for tests in self.list_tests(assignment)]
        if any(self._adds_up(one, key) for key in {branch.key for branch in branches}):
            return []
        return list(dict.fromkeys(branches))[:MOST_BRANCHES]

    def is_new_goal(self, key: str, assignment: Assignment) -> bool:
        """Say whether an assignment sets a goal: by its name, as it is drawn, or as the next one of several."""
        is_next = _counts(assignment) or self._takes_next(assignment)
        return is_goal(key) or is_next or is_drawn(self.definitions, assignment.value, assignment.function)

    def _adds_up(self, one: KeptDifference, key: str) -> bool:
        """Say whether the new value has the rest of the way behind the next goal: it then goes on without a jump."""
        for top, function in self.definitions.list_sources(one.new.node, one.whole.function):
            for node in ast.walk(top):
                match node:
                    case ast.For(iter=steps) | ast.comprehension(iter=steps):
                        parts = [steps]
                    case ast.BinOp(left=left, op=ast.Add(), right=right) if not self._is_index(node):
                        parts = [left, right]
                    case _:
                        continue
                if any(self._reads_plainly(part, function, key) for part in parts):
                    return True
        return False

    def _is_index(self, node: ast.AST) -> bool:
        parents = self.noted.source.parents
        while not isinstance(node, ast.stmt):
            parent = parents[node]
            if isinstance(parent, ast.Subscript) and node is parent.slice:
                return True
            node = parent
        return False

    def _reads_plainly(self, node: ast.expr, function: Function, key: str) -> bool:
        if key not in self.definitions.list_reads(node, function):
            return False
        sources = [top for top, _ in self.definitions.list_sources(node, function)]
        return not any(isinstance(inner, ast.Sub) for top in sources for inner in ast.walk(top))

    def _takes_next(self, assignment: Assignment) -> bool:
        """Say whether an assignment takes from a list what a counter says."""
        match peel(assignment.value):
            case ast.Call(func=ast.Attribute(attr="pop" | "popleft") | ast.Name(id="next")):
                return True
            case ast.Subscript(slice=index):
                keys = self.definitions.list_reads(index, assignment.function)
                return any(_counts(one) for key in keys for one in self.definitions.assigned.get(key, ()))
        return False

    @functools.cached_property
    def _evaluated(self) -> set[int]:
        return {number for call in self.noted.steps for number in call.values}

    def list_tests(self, assignment: Assignment) -> Iterator[tuple[tuple[int, bool], ...]]:
        """Yield what tests have to be for an assignment to be reached in a step; nothing where it always is."""
        for path in self._list_paths(assignment.statement, assignment.function, MOST_DEEP):
            conditions = [*self._list_choices(assignment), *path]
            tests = [(self.noted.source.find(test), is_met) for test, is_met in conditions]
            known = tuple((test.number, is_met) for test, is_met in tests if test is not None)
            if known and len(known) == len(tests) and known[-1][0] in self._evaluated:
                yield known

    def _list_choices(self, assignment: Assignment) -> Iterator[tuple[ast.expr, bool]]:
        """Yield masks of the worlds that an assignment is for: `goal[mask] = ...`, `np.where(mask, ..., goal)`."""
        choices = [assignment.target.slice] if isinstance(assignment.target, ast.Subscript) else []
        choices += [
            node.args[0]
            for node in ast.walk(assignment.value)
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) and node.func.attr == "where"
            if node.args
        ]
        for choice in choices:
            noted = self.noted.source.find(choice)
            if noted is not None and any(self._list_masks(noted)):
                yield choice, True

    def _list_paths(self, node: ast.AST, function: Function, depth: int) -> Iterator[list[tuple[ast.expr, bool]]]:
        """Yield the conditions of a node from the innermost to the outermost, by each way that leads to it."""
        if function.name in OUTER:
            return
        inner = self.definitions.list_conditions(node)
        calls = self.definitions.calls[function.name]
        if not calls or function.name == "step":
            yield inner
        for call, caller in calls if depth else ():
            if caller is not function and function.name != "step":
                yield from (inner + rest for rest in self._list_paths(call, caller, depth - 1))

    def _try(self, one: KeptDifference, branch: Branch) -> GoalJump | None:
        sizes = [size for episode in self.noted.episodes for size in _sizes(one, episode[1:])]
        usual = float(np.quantile(sizes, USUAL)) if sizes else 0.0
        jumps: dict[bool, list[float]] = {True: [], False: []}  # at once, and in the next step
        for number, episode in enumerate(self.noted.episodes):
            step = min(BEFORE, len(episode) - 2)
            if step < 1 or not usual:
                continue
            forced = {step: self.force(branch)}
            played = self.noted.play(number, step + 1, forced)
            if len(played) < step + 2:
                continue
            for at_once, place in ((True, step), (False, step + 1)):
                before, after = (max(_sizes(one, [call]), default=0.0) for call in (episode[place], played[place][0]))
                if after > JUMP * max(usual, before) and self.kept.is_paid_at(one, number, place, forced):
                    jumps[at_once].append(after)
                    break
            for at_once, found in jumps.items():
                if len(found) == NEEDED:
                    met = [test for test, is_met in branch.tests if is_met] or [branch.tests[-1][0]]
                    text = self.noted.source.expressions[met[0]].text
                    return GoalJump(one, branch.key, text, at_once, max(found), usual, len(found))
        return None

    def force(self, branch: Branch) -> dict[int, Any]:
        """Return what expressions are to be worth: the tests, and masks of worlds that these are computed from."""
        forced: dict[int, Any] = {}
        for number, is_met in branch.tests:
            masks = [mask for mask in self._list_masks(self.noted.source.expressions[number]) if is_met]
            forced |= dict(masks) if masks else {number: is_met}
        return forced

    def _list_masks(self, test: Expression) -> Iterator[tuple[int, Any]]:
        for node in ast.walk(test.node):
            if isinstance(node, ast.Name):
                origin = self.definitions.find_origin(node, test.function)
                if isinstance(origin, ast.Call) and origin.args:  # np.flatnonzero(mask)
                    origin = self.definitions.find_origin(peel(origin.args[0]), test.function)
                mask = self.noted.source.find(origin)
                if mask is None:
                    continue
                values = [value for call in self.noted.steps[:FEW_STEPS] for value in call.values.get(mask.number, [])]
                if values and all(_is_mask(value) for value in values):
                    yield mask.number, np.ones(np.shape(np.asarray(values[0])), np.bool_)


def _is_mask(value: Value) -> bool:
    return isinstance(value, np.ndarray) and value.ndim > 0 and bool(np.isin(value, (0.0, 1.0)).all())


def is_draw(node: ast.AST) -> bool:
    """Say whether code calls a random generator."""
    return isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) and node.func.attr in DRAWS


def has_draw(node: ast.AST) -> bool:
    """Say whether there is such a call in some code."""
    return any(map(is_draw, ast.walk(node)))


def is_drawn(definitions: Definitions, node: ast.AST, function: Function) -> bool:
    """Say whether there is one in code, in what its names are given, or in the functions that it calls."""
    return any(has_draw(top) for top, _ in definitions.list_sources(node, function))


def _counts(assignment: Assignment) -> bool:
    """Say whether an assignment counts on by a whole number."""
    match assignment.statement:
        case ast.AugAssign(op=ast.Add(), value=ast.Constant(value=int())):
            return True
    return False


def _sizes(one: KeptDifference, calls: Sequence[NotedCall]) -> list[float]:
    values = [value for call in calls for value in call.values.get(one.whole.number, ()) if value is not None]
    return [float(np.max(np.abs(value), initial=0.0)) for value in values]
