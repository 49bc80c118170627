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

from rlctl.checking.assignments import list_values
from rlctl.checking.experiments.attributes import AttributeLog
from rlctl.checking.expressions import NotedCall, Value
from rlctl.checking.records import Records
from rlctl.checking.rule import NotApplicable
from rlctl.checking.source_code import Expression, SourceCode
from rlctl.checking.step_times import SUBSTEP_WORDS, StepTimes, require_step_times
from rlctl.checking.term_names import split_name

TIME_WORDS = {"dt", "timestep", "h", "ts"}
RATE_WORDS = {"hz", "freq", "frequency", "fps", "rate"}
FEWEST, SPANS = 10, 0.8  # steps; part of them in which a difference spans a whole step
EXACT = 1e-6
LONGEST_S = 1.0
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

    @property
    def total_s(self) -> float:
        """For how long it counts a step [s]."""
        return self.seconds * self.most

    def is_wrong(self, times: StepTimes) -> bool:
        """Say whether it counts a step for too short or too long by the number of its substeps."""
        if self.most == 1:
            return math.isclose(self.total_s, times.physics_s, rel_tol=EXACT)
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
    constants = _find_constants(source, [call for episode in episodes for call in episode])
    found = [*_find_added(source, steps, constants), *_find_divided(source, steps, constants)]
    return [one for one in found if one.seconds <= LONGEST_S]


def _find_constants(source: SourceCode, calls: Sequence[NotedCall]) -> dict[ast.expr, float]:
    """Return the expressions that are always the same number."""
    seen: dict[int, float] = {}
    for call in calls:
        for number, values in call.values.items():
            for value in values:
                if not isinstance(value, float) or seen.setdefault(number, value) != value:
                    seen[number] = math.nan
    return {source.expressions[number].node: value for number, value in seen.items() if not math.isnan(value)}


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
        for summand in _list_summands(added):
            factors = _list_factors(summand, one)
            times = [seconds for factor, _ in factors if (seconds := _read_time(factor, one, constants)) is not None]
            if len(times) == 1:
                is_clock = all(factor in constants or isinstance(factor, ast.Constant) for factor, _ in factors)
                use = Use.COUNTED if is_clock else Use.INTEGRATED
                most = _count(source, one, target, steps)
                seconds = times[0] * _multiply_counts(factors, one, constants)
                if most:
                    yield TimedExpression(use, ast.unparse(target), one.text, seconds, most, one.where)


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


def _list_summands(node: ast.expr) -> Iterator[ast.expr]:
    """Yield the parts of a sum, also of the entries of an array."""
    match node:
        case ast.BinOp(left=left, op=ast.Add() | ast.Sub(), right=right):
            yield from _list_summands(left)
            yield from _list_summands(right)
        case ast.UnaryOp(operand=operand):
            yield from _list_summands(operand)
        case ast.Call(func=ast.Attribute(attr="array" | "asarray"), args=[ast.List(elts=entries), *_]):
            for entry in entries:
                yield from _list_summands(entry)
        case _:
            yield node


def _list_factors(node: ast.expr, one: Expression) -> list[tuple[ast.expr, int]]:
    """Return the factors of a product, each with its exponent: -1 of what it is divided by."""
    match node:
        case ast.BinOp(left=left, op=ast.Mult(), right=right):
            return _list_factors(left, one) + _list_factors(right, one)
        case ast.BinOp(op=ast.Div(), left=left, right=right) if not _is_named_time(node, one):
            return [*_list_factors(left, one), (right, -1)]
        case ast.Call(func=ast.Name(id="float"), args=[only]):
            return _list_factors(only, one)
    return [(node, 1)]


def _multiply_counts(
    factors: Sequence[tuple[ast.expr, int]], one: Expression, constants: Mapping[ast.expr, float]
) -> float:
    """Return the product of the factors that say how often something is repeated in a step."""
    counts = [
        constants[factor] ** exponent
        for factor, exponent in factors
        if constants.get(factor) and not isinstance(factor, ast.Constant) and _is_count(factor, one)
    ]
    return math.prod(counts)


def _read_time(node: ast.expr, one: Expression, constants: Mapping[ast.expr, float]) -> float | None:
    """Return the time that a part of an expression is, by what it is called [s]; None for anything else."""
    value = constants.get(node)
    return value if value is not None and value > 0 and _is_named_time(node, one) else None


def _is_named_time(node: ast.expr, one: Expression) -> bool:
    """Say whether names say that a part of an expression is a time: `dt`, `dt / substeps`, `1 / 240`, `1 / rate_hz`."""
    match node:
        case ast.BinOp(left=ast.Constant(), op=ast.Div(), right=right):
            return bool(_words(right) & RATE_WORDS) or isinstance(right, ast.Constant)
        case ast.BinOp(left=left, op=ast.Div(), right=right):
            return _is_named_time(left, one) and _is_count(right, one)
        case ast.BinOp(left=left, op=ast.Mult(), right=right):
            return any(_is_named_time(a, one) and _is_count(b, one) for a, b in ((left, right), (right, left)))
        case ast.Name(id=name):
            assigned = list_values(one.function, name)
            if len(assigned) == 1 and _is_named_time(assigned[0], one):
                return True
    words = _words(node)
    return bool(words & TIME_WORDS) or words >= {"time", "step"}


def _is_count(node: ast.expr, one: Expression) -> bool:
    """Say whether a part of an expression is how often something is repeated."""
    match node:
        case ast.Constant(value=int()):
            return True
        case ast.Call(func=ast.Name(id="int" | "float"), args=[only]):
            return _is_count(only, one)
    return bool(_words(node) & SUBSTEP_WORDS)


def _words(node: ast.expr) -> set[str]:
    match node:
        case ast.Attribute(attr=name) | ast.Name(id=name):
            return set(split_name(name))
        case ast.Subscript(slice=ast.Constant(value=str(name))):
            return set(split_name(name))
    return set()


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


def _find_divided(
    source: SourceCode, steps: Sequence[NotedCall], constants: Mapping[ast.expr, float]
) -> Iterator[TimedExpression]:
    for one in source.expressions:
        match one.node:
            case ast.BinOp(left=left, op=ast.Div(), right=right):
                seconds = _read_time(right, one, constants)
            case _:
                continue
        differences = [source.find(node) for node in ast.walk(left) if _is_difference(node)]
        if seconds is None or not differences:
            continue
        most = max((len(call.values.get(one.number, ())) for call in steps), default=0)
        for difference in differences:
            if difference is not None and most == 1 and spans_steps(source, difference, steps):
                yield TimedExpression(Use.DIVIDED, difference.text, one.text, seconds, most, one.where)
                break


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
