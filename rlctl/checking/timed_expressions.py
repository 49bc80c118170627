"""Where the source adds up times, or divides by them: by which time, and how often in a step."""

import ast
import collections
import contextlib
import dataclasses
import enum
import itertools
import math
from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from rlctl.checking.experiments.attributes import AttributeLog
from rlctl.checking.expressions import NotedCall, Value
from rlctl.checking.named_times import (
    extend_constants,
    find_constants,
    list_factors,
    list_factors_that_stay,
    list_summands,
    multiply_counts,
    read_rate,
    read_time,
)
from rlctl.checking.records import Records
from rlctl.checking.rule import NotApplicable
from rlctl.checking.source_code import Expression, Function, SourceCode
from rlctl.checking.step_times import StepTimes, require_step_times

FEWEST, SPANS = 10, 0.8  # steps; part of them in which a difference spans a whole step
EXACT = 1e-6
LONGEST_S = 1.0
FULL_TURN = (1, 2, 1.0, 2.0)  # numbers in products that scale no time: 2 pi
MOST_VALUES = 2  # in a step, of what does not change with each of its substeps
FEWEST_ALIKE = 2  # lines that agree on how long a step takes
TIMED = "timed expressions"
"""The fact with what `find_timed_expressions` returns."""


class Use(enum.StrEnum):
    """What is done with a time."""

    COUNTED = "counted"  # added as it is, or times what never changes: a clock, a timer, or a phase
    INTEGRATED = "integrated"  # a rate times the time is added
    DIVIDED = "divided"  # a difference between two steps is divided by it


@dataclasses.dataclass(frozen=True)
class TimedExpression:
    """A line of the source in which a time is used."""

    use: Use
    target: str  # what is added to, or the difference that is divided
    text: str  # the expression
    seconds: float  # the time
    most: int  # how often it is evaluated in a step, at most
    where: tuple[str, int]
    factors: tuple[float, ...] = ()  # what else it is multiplied by, of what never changes

    @property
    def total_s(self) -> float:
        """For how long it counts a step [s]."""
        return self.seconds * self.most

    def is_wrong(self, times: StepTimes) -> bool:
        """Say whether it counts a step for too short or too long by the number of its substeps."""
        if self.most == 1:
            # The number of substeps may have any name.
            is_multiplied = any(math.isclose(factor, times.substeps, rel_tol=EXACT) for factor in self.factors)
            return math.isclose(self.total_s, times.physics_s, rel_tol=EXACT) and not is_multiplied
        too_long = times.control_s * times.substeps
        return self.most == times.substeps and math.isclose(self.total_s, too_long, rel_tol=EXACT)


def find_wrong_time(records: Records, use: Use) -> Iterator[tuple[TimedExpression, StepTimes]]:
    """Yield the first line that uses a wrong time, and the right times; nothing where no line is known to."""
    timed: list[TimedExpression] = records.facts.get(TIMED, [])
    log: AttributeLog | None = records.facts.get("attributes")
    times = find_majority(timed)
    if log is not None:
        with contextlib.suppress(NotApplicable):
            times = require_step_times(log)
    if times is None:
        return
    for one in timed:
        if one.use == use and one.is_wrong(times):
            yield one, times
            return


def find_majority(timed: Sequence[TimedExpression]) -> StepTimes | None:
    """Return the times on which most lines agree: how often a line is evaluated in a step, times its time."""
    substeps = max((one.most for one in timed), default=1)
    totals = [one.total_s for one in timed]
    same = [sum(math.isclose(total, other, rel_tol=EXACT) for other in totals) for total in totals]
    if substeps == 1 or max(same) < FEWEST_ALIKE or 2 * max(same) <= len(same):
        return None
    control_s = totals[same.index(max(same))]
    return StepTimes(control_s, control_s / substeps, f"{max(same)} lines of the source")


def find_timed_expressions(source: SourceCode, episodes: Sequence[Sequence[NotedCall]]) -> list[TimedExpression]:
    """Return where times are used that do not change."""
    steps = [call for episode in episodes for call in episode[1:]]
    constants = find_constants(source, [call for episode in episodes for call in episode])
    found = [*_find_added(source, steps, extend_constants(source, constants))]
    found += [*_find_multiplied(source, steps, constants), *_find_divided(source, steps, constants)]
    return [one for one in found if one.seconds <= LONGEST_S]


def _find_added(
    source: SourceCode, steps: Sequence[NotedCall], constants: Mapping[ast.expr, float]
) -> Iterator[TimedExpression]:
    for one in source.expressions:
        statement = source.parents.get(one.node)
        if isinstance(statement, ast.AugAssign) and isinstance(statement.op, ast.Add | ast.Sub):
            target: ast.expr = statement.target
            added = one.node
        else:
            found = _read_sum(source, one.node)
            if found is None:
                continue
            target, added = found
        if _is_of_loop(target, one):
            continue
        for summand in list_summands(added):
            factors = list_factors(summand, one)
            times = [seconds for factor, _ in factors if (seconds := read_time(factor, one, constants)) is not None]
            if len(times) == 1:
                is_clock = all(factor in constants or isinstance(factor, ast.Constant) for factor, _ in factors)
                is_clock &= not isinstance(source.parents[summand], ast.Call)  # a limit of a change
                use = Use.COUNTED if is_clock else Use.INTEGRATED
                most = _count(source, one, target, steps) or _count_conditions(source, one, steps)
                seconds = times[0] * multiply_counts(factors, one, constants)
                if most:
                    others = list_factors_that_stay(factors, constants)
                    yield TimedExpression(use, ast.unparse(target), one.text, seconds, most, one.where, others)


def _read_sum(source: SourceCode, node: ast.expr) -> tuple[ast.expr, ast.expr] | None:
    """Return what a sum adds to, and what it adds, where the statement assigns to the same name."""
    if not isinstance(node, ast.BinOp) or not isinstance(node.op, ast.Add | ast.Sub):
        return None
    statement = source.find_statement(node)
    targets = statement.targets if isinstance(statement, ast.Assign) else []
    for target in targets:
        if ast.unparse(target) == ast.unparse(node.left):
            return target, node.right
        if ast.unparse(target) == ast.unparse(node.right) and isinstance(node.op, ast.Add):
            return target, node.left
    return None


def _is_of_loop(target: ast.expr, one: Expression) -> bool:
    """Say whether a target belongs to what a loop goes through: each is added to once."""
    match target:
        case ast.Attribute(value=owner) | ast.Subscript(value=owner):
            return _is_of_loop(owner, one)
        case ast.Name(id=name):
            loops = [node for node in ast.walk(one.function) if isinstance(node, ast.For)]
            parts = [part for loop in loops for part in ast.walk(loop.target)]
            return any(isinstance(part, ast.Name) and part.id == name for part in parts)
    return False


def _count(source: SourceCode, one: Expression, target: ast.expr, steps: Sequence[NotedCall]) -> int:
    """Return how often an expression is evaluated in a step at most, for each entry that it is added to."""
    index = source.find(target.slice) if isinstance(target, ast.Subscript) else None
    most = 0
    for call in steps:
        if index is None:
            most = max(most, len(call.values.get(one.number, ())))
        else:
            entries = [repr(parts[0]) for _, parts in call.pair(one.number, [index.number])]
            most = max([most, *collections.Counter(entries).values()])
    return most


def _count_conditions(source: SourceCode, one: Expression, steps: Sequence[NotedCall]) -> int:
    """Return how often the condition is asked in a step, at most, under which an expression stands that no step has
    reached."""
    node: ast.AST = one.node
    while not isinstance(node, Function):
        node = source.parents[node]
        if isinstance(node, ast.If | ast.IfExp) and (test := source.find(node.test)) is not None:
            return max((len(call.values.get(test.number, ())) for call in steps), default=0)
    return 0


def _list_products(source: SourceCode) -> Iterator[tuple[Expression, list[tuple[ast.expr, int]]]]:
    """Yield the products and quotients that are no part of another one, and their factors."""
    for one in source.expressions:
        above = source.parents.get(one.node)
        if _is_product(one.node) and not (above is not None and _is_product(above)):
            yield one, list_factors(one.node, one)


def _is_product(node: ast.AST) -> bool:
    return isinstance(node, ast.BinOp) and isinstance(node.op, ast.Mult | ast.Div)


def _find_multiplied(
    source: SourceCode, steps: Sequence[NotedCall], constants: Mapping[ast.expr, float]
) -> Iterator[TimedExpression]:
    """Yield a count of steps times a time."""
    for one, factors in _list_products(source):
        times = [
            seconds for node, by in factors if by == 1 and (seconds := read_time(node, one, constants)) is not None
        ]
        counters = [node for node, by in factors if by == 1 and _counts_steps(source, node, steps)]
        is_scaled = any(isinstance(node, ast.Constant) and node.value not in FULL_TURN for node, _ in factors)
        if len(times) == 1 and len(counters) == 1 and not is_scaled:
            seconds = times[0] * multiply_counts(factors, one, constants)
            others = list_factors_that_stay(factors, constants)
            yield TimedExpression(Use.COUNTED, ast.unparse(counters[0]), one.text, seconds, 1, one.where, others)


def _counts_steps(source: SourceCode, node: ast.expr, steps: Sequence[NotedCall]) -> bool:
    """Say whether a number is the same in all of a step, and grows by 1 from step to step, or begins again."""
    found = source.find(node)
    values = [call.values.get(found.number, []) for call in steps] if found is not None else []
    if any(len({repr(value) for value in one}) > 1 or not all(isinstance(v, float) for v in one) for one in values):
        return False
    numbers = [one[0] for one in values if one]
    changes = [after - before for before, after in itertools.pairwise(numbers)]  # type: ignore[operator]
    return sum(change == 1 for change in changes) >= FEWEST and all(change == 1 or change <= 0 for change in changes)


def _find_divided(
    source: SourceCode, steps: Sequence[NotedCall], constants: Mapping[ast.expr, float]
) -> Iterator[TimedExpression]:
    for one, factors in _list_products(source):
        times = [
            seconds for node, by in factors if by == -1 and (seconds := read_time(node, one, constants)) is not None
        ]
        times += [seconds for node, by in factors if by == 1 and (seconds := read_rate(node, constants)) is not None]
        tops = [node for node, by in factors if by == 1]
        differences = [source.find(node) for top in tops for node in ast.walk(top) if _is_difference(node)]
        if len(times) != 1 or not differences or not _is_once(one, steps):
            continue
        seconds = times[0] / multiply_counts(factors, one, constants)
        for difference in differences:
            if difference is not None and spans_steps(source, difference, steps):
                others = list_factors_that_stay(factors, constants, -1)
                yield TimedExpression(Use.DIVIDED, difference.text, one.text, seconds, 1, one.where, others)
                break


def _is_once(one: Expression, steps: Sequence[NotedCall]) -> bool:
    """Say whether an expression is worth the same each time in a step, or another number only where it is evaluated
    before the robot moves."""
    runs = [call.values[one.number] for call in steps if one.number in call.values]
    return bool(runs) and all(len({repr(value) for value in run}) <= MOST_VALUES for run in runs)


def _is_difference(node: ast.AST) -> bool:
    return isinstance(node, ast.BinOp) and isinstance(node.op, ast.Sub)


def spans_steps(source: SourceCode, difference: Expression, steps: Sequence[NotedCall]) -> bool:
    """Say whether a difference is that between a value and what it was in the step before."""
    assert isinstance(difference.node, ast.BinOp)
    parts = [source.find(node) for node in (difference.node.left, difference.node.right)]
    if None in parts:
        return False
    numbers = [part.number for part in parts if part is not None]
    rows = [[call.values.get(number, [None])[0] for number in numbers] for call in steps]
    for new, old in ((0, 1), (1, 0)):
        same, moving = 0, 0
        for before, row in itertools.pairwise(rows):
            if _differ(row[new], row[old]):
                moving += 1
                same += not _differ(before[new], row[old])
        if moving >= FEWEST and same >= SPANS * moving:
            return True
    return False


def _differ(one: Value, other: Value) -> bool:
    if one is None or other is None or np.shape(one) != np.shape(other):
        return True
    return not np.allclose(one, other, rtol=1e-9, atol=1e-12, equal_nan=True)
