"""Times in expressions, by what they are called: `dt`, `dt / substeps`, `1 / 240`; and the products and sums around."""

import ast
import collections
import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from rlctl.checking.assignments import list_values
from rlctl.checking.expressions import NotedCall
from rlctl.checking.source_code import Expression, SourceCode
from rlctl.checking.step_times import SUBSTEP_WORDS
from rlctl.checking.term_names import split_name

TIME_WORDS = {"dt", "timestep", "h", "ts"}
RATE_WORDS = {"hz", "freq", "frequency", "fps", "rate"}


def find_constants(source: SourceCode, calls: Sequence[NotedCall]) -> dict[ast.expr, float]:
    """Return the expressions that are always the same number."""
    seen: dict[int, float] = {}
    for call in calls:
        for number, values in call.values.items():
            for value in values:
                if not isinstance(value, float) or seen.setdefault(number, value) != value:
                    seen[number] = math.nan
    return {source.expressions[number].node: value for number, value in seen.items() if not math.isnan(value)}


def extend_constants(source: SourceCode, constants: dict[ast.expr, float]) -> dict[ast.expr, float]:
    """Return the constants, and expressions of lines that no step has reached, which are written as constants are."""
    by_text = collections.defaultdict[tuple[Any, str], set[float]](set)
    for node, value in constants.items():
        one = source.find(node)
        if one is not None:
            by_text[_read_scope(one), one.text].add(value)
    found = dict(constants)
    for one in source.expressions:
        values = by_text.get((_read_scope(one), one.text), ())
        if one.node not in found and len(values) == 1:
            found[one.node] = next(iter(values))
    for one in source.expressions:
        match one.node:
            case ast.BinOp(left=left, op=ast.Div(), right=right) if one.node not in found and found.get(right):
                if left in found:
                    found[one.node] = found[left] / found[right]
    return found


def _read_scope(one: Expression) -> Any:
    """Return where a name means the same: its function, or everywhere for an attribute and a constant of a module."""
    node = one.node
    is_shared = isinstance(node, ast.Attribute) or (isinstance(node, ast.Name) and node.id.isupper())
    return None if is_shared else one.function


def list_summands(node: ast.expr) -> Iterator[ast.expr]:
    """Yield the parts of a sum, also of the entries of an array."""
    match node:
        case ast.BinOp(left=left, op=ast.Add() | ast.Sub(), right=right):
            yield from list_summands(left)
            yield from list_summands(right)
        case ast.UnaryOp(operand=operand):
            yield from list_summands(operand)
        case ast.Call(func=ast.Attribute(attr="clip"), args=[_, _, limit]):
            yield limit  # of a change
        case ast.Call(func=ast.Attribute(attr="array" | "asarray"), args=[ast.List(elts=entries), *_]):
            for entry in entries:
                yield from list_summands(entry)
        case _:
            yield node


def list_factors(node: ast.expr, one: Expression) -> list[tuple[ast.expr, int]]:
    """Return the factors of a product, each with its exponent: -1 of what it is divided by."""
    match node:
        case ast.BinOp(left=left, op=ast.Mult(), right=right):
            return list_factors(left, one) + list_factors(right, one)
        case ast.BinOp(op=ast.Div(), left=left, right=right) if not is_named_time(node, one):
            return [*list_factors(left, one), (right, -1)]
        case ast.Call(func=ast.Name(id="float"), args=[only]):
            return list_factors(only, one)
        case ast.UnaryOp(operand=operand):
            return list_factors(operand, one)
    return [(node, 1)]


def multiply_counts(
    factors: Sequence[tuple[ast.expr, int]], one: Expression, constants: Mapping[ast.expr, float]
) -> float:
    """Return the product of the factors that say how often something is repeated in a step."""
    counts = [
        constants[factor] ** exponent
        for factor, exponent in factors
        if constants.get(factor) and not isinstance(factor, ast.Constant) and is_count(factor, one)
    ]
    return math.prod(counts)


def list_factors_that_stay(
    factors: Sequence[tuple[ast.expr, int]], constants: Mapping[ast.expr, float], exponent: int = 1
) -> tuple[float, ...]:
    """Return the values of the factors with an exponent that never change, whatever they are called."""
    return tuple(constants[factor] for factor, by in factors if by == exponent and factor in constants)


def read_time(node: ast.expr, one: Expression, constants: Mapping[ast.expr, float]) -> float | None:
    """Return the time that a part of an expression is, by what it is called [s]; None for anything else."""
    value = constants.get(node)
    return value if value is not None and value > 0 and is_named_time(node, one) else None


def read_rate(node: ast.expr, constants: Mapping[ast.expr, float]) -> float | None:
    """Return the time of which a part of an expression is the reciprocal, by what it is called [s]."""
    value = constants.get(node)
    return 1 / value if value is not None and value > 1 and _words(node) & RATE_WORDS else None


def is_named_time(node: ast.expr, one: Expression, resolved: frozenset[str] = frozenset()) -> bool:
    """Say whether names say that a part of an expression is a time: `dt`, `dt / substeps`, `1 / 240`, `1 / rate_hz`.

    `resolved` are the names whose values are being read: `speed = speed / 5` is assigned from itself.
    """
    match node:
        case ast.BinOp(left=ast.Constant(), op=ast.Div(), right=right):
            return bool(_words(right) & RATE_WORDS) or isinstance(right, ast.Constant)
        case ast.BinOp(left=left, op=ast.Div(), right=right):
            return is_named_time(left, one, resolved) and is_count(right, one)
        case ast.BinOp(left=left, op=ast.Mult(), right=right):
            pairs = (left, right), (right, left)
            return any(is_named_time(time, one, resolved) and is_count(count, one) for time, count in pairs)
        case ast.Name(id=name) if name not in resolved:
            assigned = list_values(one.function, name)
            if len(assigned) == 1 and is_named_time(assigned[0], one, resolved | {name}):
                return True
    words = _words(node)
    return bool(words & TIME_WORDS) or words >= {"time", "step"}


def is_count(node: ast.expr, one: Expression) -> bool:
    """Say whether a part of an expression is how often something is repeated."""
    match node:
        case ast.Constant(value=int()):
            return True
        case ast.Call(func=ast.Name(id="int" | "float"), args=[only]):
            return is_count(only, one)
    return bool(_words(node) & SUBSTEP_WORDS)


def _words(node: ast.expr) -> set[str]:
    match node:
        case ast.Attribute(attr=name) | ast.Name(id=name):
            return set(split_name(name))
        case ast.Subscript(slice=ast.Constant(value=str(name))):
            return set(split_name(name))
    return set()
