"""Differences to a value of the step before that are always 0, since that value has been replaced too early."""

import ast
import dataclasses
import functools
import itertools
from collections.abc import Iterator, Sequence
from typing import Any, TypeGuard

import numpy as np

from rlctl.checking.assignments import list_name_words, read_key, read_name
from rlctl.checking.experiments.expressions import NotedEpisodes, read_step
from rlctl.checking.expressions import NotedCall, Value
from rlctl.checking.previous_values import (
    FEWEST_CHANGES,
    FORCED,
    ZERO,
    KeptDifference,
    KeptDifferences,
    is_previous_key,
    list_changes,
    read_sides,
)
from rlctl.checking.source_code import Expression

NO_CHANGES = {
    *("max", "min", "maximum", "minimum", "fmax", "fmin", "clip", "where", "allclose", "isclose", "array_equal"),
    *("subtract", "arange", "range", "print", "zip"),
}
"""Functions of two values that are no change from the one to the other, or are read as such already."""
MOST_STEPS = 80  # that are looked at
LATER = 3  # steps in which what is kept may show


@dataclasses.dataclass(frozen=True, eq=False)
class ZeroUpdate:
    """A statement of a step that computes a value from a difference which is always 0 there."""

    statement: ast.stmt
    value: Expression
    difference: KeptDifference


class ZeroDifferences:
    """Those of a source."""

    def __init__(self, noted: NotedEpisodes) -> None:
        self.noted, self.definitions = noted, noted.definitions
        self._kept = noted.share(KeptDifferences)
        self._candidates = [*self._kept.differences, *self._list_local(), *self._list_given()]
        self._candidates = [one for one in self._candidates if is_previous_key(one.key) or self._is_copied(one)]
        self._always = [one for one in self._candidates if self._is_zero([list(noted.steps)], one)]

    def find_paid(self) -> Iterator[KeptDifference]:
        """Yield differences that are 0 in each step, and that the reward of the step is computed from."""
        copied = [one for one in self._candidates if one not in self._always and self._has_just_been_copied(one)]
        return (one for one in (*self._always, *copied) if self._kept.is_paid(one))

    def _has_just_been_copied(self, one: KeptDifference) -> bool:
        """Say whether a step without conditions copies the new value right before it subtracts it: then the difference
        is 0 whether or not that value has ever changed."""
        wholes = [whole for whole, _, _ in one.list_values(self.noted.steps)]
        if not wholes or any(whole is None or np.any(whole) for whole in wholes):
            return False
        function, source = one.whole.function, self.noted.source
        body = function.body
        places = [order for order, node in enumerate(body) if source.find_statement(one.whole.node) in ast.walk(node)]
        for copy in self.definitions.assigned[one.key]:
            if copy.statement in body and copy.function is function and places:
                between = body[body.index(copy.statement) + 1 : places[0]]
                origin = self.definitions.find_origin(copy.value, function)
                is_same = ast.unparse(origin) == ast.unparse(one.origin) and isinstance(
                    origin, ast.Name | ast.Attribute
                )
                is_before = body.index(copy.statement) < places[0]
                changed = {key for node in between for key in self.definitions.list_sets(node)}
                changed |= {part.id for node in between for part in ast.walk(node) if _is_set(part)}
                if is_same and is_before and not {read_key(origin) or read_name(origin), one.key} & changed:
                    return True
        return False

    def find_same_sides(self) -> Iterator[Expression]:
        """Yield paid differences of an expression and itself."""
        for one in self.noted.source.expressions:
            match one.node:
                case ast.BinOp(left=left, op=ast.Sub(), right=right) if ast.dump(left) == ast.dump(right):
                    is_drawn = bool(list_name_words(left) & {"random", "rng", "noise", "normal", "uniform"})
                    if not is_drawn and one.node in self._walked:
                        yield one

    @functools.cached_property
    def _walked(self) -> set[ast.expr]:
        summands, definitions = self.noted.reward.summands, self.noted.reward.definitions
        return {place.node for summand in summands for place in definitions.walk(summand.place)}

    def find_observed(self) -> Iterator[KeptDifference]:
        """Yield differences that are 0 in each step, and that only the observation is computed from."""
        for one in self._always:
            if not self._kept.is_paid(one) and self._shows(one.whole):
                yield one

    def find_updates(self) -> Iterator[ZeroUpdate]:
        """Yield values that a step keeps, such as filtered ones, of differences that are 0 whenever they are computed
        for them, and not elsewhere."""
        others = [one for one in self._candidates if one not in self._always]
        steps = self.noted.steps[:: max(1, len(self.noted.steps) // MOST_STEPS)] if others else []
        for key, assignments in self.definitions.assigned.items():
            for one in assignments:
                value = self.noted.source.find(one.value)
                if value is None or not others or one.function not in self.noted.of_steps or is_previous_key(key):
                    continue
                runs = [list(_list_runs(self.noted, call, value)) for call in steps]
                found = [difference for difference in others if self._is_zero(runs, difference)]
                if found and key not in {difference.key for difference in others} and self._shows(value):
                    yield ZeroUpdate(one.statement, value, found[0])

    def _list_local(self) -> Iterator[KeptDifference]:
        """Yield differences to what a local variable of the step has kept."""
        for whole in self.noted.source.expressions:
            sides = read_sides(whole.node)
            for one, other in (sides, sides[::-1]) if sides else ():
                kept, new = self.noted.source.find(one), self.noted.source.find(other)
                is_local = isinstance(one, ast.Name) and one.id in self.definitions.list_assigned(whole.function)
                is_local &= whole.function in self.noted.of_steps
                if is_local and is_previous_key(read_name(one)) and kept is not None and new is not None:
                    yield KeptDifference(whole, kept, new, read_name(one), other)

    def _list_given(self) -> Iterator[KeptDifference]:
        """Yield calls of functions that are given what is kept and the new value: rate(self.place, self.last_place)."""
        for whole in self.noted.source.expressions:
            match whole.node:
                case ast.Call(func=function, args=[left, right, *_]) if read_name(function) not in NO_CHANGES:
                    yield from self._kept.read_pair(whole, (left, right))

    def _is_copied(self, one: KeptDifference) -> bool:
        """Say whether a step replaces what is kept by a copy of the new value, or adds one to a list of them."""
        copies = [(assigned.value, assigned.function) for assigned in self.definitions.assigned[one.key]]
        for call, function in self.definitions.calls["append"] + self.definitions.calls["appendleft"]:
            if isinstance(call.func, ast.Attribute) and call.args and read_key(call.func.value) == one.key:
                copies.append((call.args[0], function))
        origins = [
            self.definitions.find_origin(value, function)
            for value, function in copies
            if function in self.noted.of_steps
        ]
        return any(ast.unparse(origin) == ast.unparse(one.origin) for origin in origins)

    def _is_zero(self, runs: Sequence[Sequence[NotedCall]], one: KeptDifference) -> bool:
        """Say whether a difference is 0 in all of these pieces of steps, although the new value changes between
        them."""
        triples = [triple for run in runs for triple in one.list_values(run)]
        if len(triples) < FEWEST_CHANGES:
            return False
        moving = [change for change in list_changes([new for _, _, new in triples]) if change > 0]
        if len(moving) < FEWEST_CHANGES or any(whole is None for whole, _, _ in triples):
            return False
        largest = max(float(np.max(np.abs(whole), initial=0.0)) for whole, _, _ in triples)  # type: ignore[arg-type]
        return largest <= ZERO * float(np.median(moving))

    def _shows(self, value: Expression) -> bool:
        """Say whether another value of an expression in one step changes what is seen of the steps soon after."""
        for number, episode in enumerate(self.noted.episodes):
            steps = [call.step for call in episode[1:] if value.number in call.values]
            if not steps:
                continue
            step = steps[len(steps) // 2]
            before = episode[step].values[value.number][0]
            if before is None:
                return False
            moved = {value.number: _move(before)}
            return bool(self.noted.changes(number, step, {}, moved, read=read_step, later=LATER))
        return False


def _is_set(node: ast.AST) -> TypeGuard[ast.Name]:
    return isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store)


def _move(value: Value) -> Any:
    moved = np.asarray(value) + FORCED
    return moved if isinstance(value, np.ndarray) else float(moved)


def _list_runs(noted: NotedEpisodes, call: NotedCall, value: Expression) -> Iterator[NotedCall]:
    """Yield what was evaluated for an expression, each time that it was."""
    inside = {noted.source.find(node) for node in ast.walk(value.node)}
    expressions = noted.source.expressions
    for end, (number, _) in enumerate(call.events):
        if number == value.number:
            run = itertools.takewhile(
                lambda event: expressions[event[0]] in inside or expressions[event[0]].function is not value.function,
                reversed(call.events[:end]),
            )
            yield NotedCall(call.step, [*run][::-1])
