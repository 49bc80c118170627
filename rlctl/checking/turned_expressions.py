"""Where the source turns a vector."""

import ast
import collections
import dataclasses
import itertools
from collections.abc import Iterator, Sequence

import numpy as np

from rlctl.checking.assignments import list_parameters
from rlctl.checking.source_code import Expression, Function
from rlctl.checking.vector_series import FEWEST, HARDLY_ANY, NEARLY_ALL, SAME, Array, VectorSeries

WRITING = {"mju_rotVecQuat", "mju_mulMatVec", "mju_mulMatVec3", "mju_mulMatTVec", "mju_mulMatTVec3"}
"""Functions of MuJoCo that write what they compute into the first argument."""
LEAST_TURN = 0.002  # of a vector's length, that a turn moves it


@dataclasses.dataclass(frozen=True, eq=False)
class VectorTurn:
    """An expression that turns a vector: (calls, worlds, elements)."""

    whole: Expression
    part: ast.expr | None  # the vector; None where it has only elements
    text: str  # of the vector
    before: Array
    after: Array
    other: Expression | None = None  # of the second element, where it is written by elements
    is_of_parameters: bool = False  # those who call the function show which vector it is

    @property
    def wholes(self) -> Sequence[Expression]:
        """What the elements are computed by."""
        return [self.whole] if self.other is None else [self.whole, self.other]

    @property
    def turned_back(self) -> "VectorTurn":
        """The opposite turn."""
        return dataclasses.replace(self, before=self.after, after=self.before)


def find_turns(series: VectorSeries) -> Iterator[VectorTurn]:
    """Yield the expressions whose value is as long as one of its operands or arguments, and another vector."""
    for one in series.source.expressions:
        parts: list[ast.expr] = []
        match one.node:
            case ast.BinOp(left=left, op=ast.MatMult(), right=right):
                parts = [left, right]
            case ast.Call(args=args, keywords=keywords, func=function):
                parts = [*args, *(keyword.value for keyword in keywords)]
                parts += [function.value] if isinstance(function, ast.Attribute) else []
            case ast.Subscript(value=ast.Call(args=args)):
                parts = [*args]
            case ast.Name() if any(series.read(one.node, size=size) is not None for size in (2, 3)):
                parts = _list_arguments(one)
        for part, size in itertools.product(parts, (2, 3)):
            before, after = series.read(part, size=size), series.read(one.node, size=size)
            if before is not None and after is not None and _is_turn(before, after):
                yield VectorTurn(one, part, ast.unparse(part), before, after)
    yield from _find_written_out(series)


def _list_arguments(one: Expression) -> list[ast.expr]:
    """Return what was given to the function that returns a name among others, or that writes into it, if nothing else
    sets it."""
    found: list[list[ast.expr]] = []
    for node in ast.walk(one.function):
        match node:
            case ast.Assign(targets=[ast.Tuple(elts=targets)], value=ast.Call(args=args)) if _has(targets, one):
                found.append(args)
            case ast.Call(func=ast.Attribute(attr=name), args=[out, *args]) if name in WRITING and _has([out], one):
                if node.lineno < one.node.lineno:
                    found.append(args)
            case ast.Name(ctx=ast.Store()) if _has([node], one):
                found.append([])
    given = [args for args in found if args]
    return given[0] if len(given) == 1 and len(found) == 2 else []


def _has(nodes: list[ast.expr], one: Expression) -> bool:
    return any(isinstance(node, ast.Name) and node.id == ast.unparse(one.node) for node in nodes)


def _is_turn(before: Array, after: Array) -> bool:
    if before.shape != after.shape:
        return False
    both = np.isfinite(before).all(axis=2) & np.isfinite(after).all(axis=2)
    old, new = before[both], after[both]
    lengths = np.linalg.norm(old, axis=-1)
    if (lengths > SAME).sum() < FEWEST:
        return False
    same = np.abs(np.linalg.norm(new, axis=-1) - lengths) <= SAME * (1e-3 + lengths)
    moved = np.linalg.norm(new - old, axis=-1) > LEAST_TURN * lengths
    return bool(same.mean() > NEARLY_ALL and moved[lengths > SAME].mean() > HARDLY_ANY)


@dataclasses.dataclass(frozen=True)
class _Sum:
    """A sum of two products of two factors."""

    one: Expression
    factors: tuple[tuple[ast.expr, ast.expr], tuple[ast.expr, ast.expr]]


def _find_written_out(series: VectorSeries) -> Iterator[VectorTurn]:
    """Yield turns in the plane that are written by elements: c * x - s * y and s * x + c * y."""
    for turn in list_written_out(series):
        if not turn.is_of_parameters and _is_turn(turn.before, turn.after):
            yield turn


def list_written_out(series: VectorSeries) -> Iterator[VectorTurn]:
    """Yield two sums of products of the elements of a vector and of a cosine and a sine: also those that are no turn,
    as one sign is wrong."""
    sums = collections.defaultdict[Function, list[_Sum]](list)
    for one in series.source.expressions:
        match one.node:
            case ast.BinOp(left=left, op=ast.Add() | ast.Sub(), right=right):
                products = [_read_product(left), _read_product(right)]
                if products[0] is not None and products[1] is not None:
                    sums[one.function].append(_Sum(one, (products[0], products[1])))
    for function, found in sums.items():
        parameters = set(list_parameters(function))
        for first, second in itertools.pairwise(found):
            turn = _read_pair(series, first, second, parameters)
            if turn is not None:
                yield turn


def _read_product(node: ast.expr) -> tuple[ast.expr, ast.expr] | None:
    if isinstance(node, ast.UnaryOp):
        node = node.operand
    if not isinstance(node, ast.BinOp) or not isinstance(node.op, ast.Mult):
        return None
    one = node.left.operand if isinstance(node.left, ast.UnaryOp) else node.left
    return one, node.right


def _read_pair(series: VectorSeries, first: _Sum, second: _Sum, parameters: set[str]) -> VectorTurn | None:
    """Return the turn that two sums are: one factor of each product is a cosine or a sine, the other an element."""
    others = [{ast.unparse(node) for node in product} for product in second.factors]
    for flips in itertools.product((0, 1), repeat=2):
        (a, x), (b, y) = (
            product[::-1] if flip else product for product, flip in zip(first.factors, flips, strict=True)
        )
        names = [ast.unparse(node) for node in (a, x, b, y)]
        crossed = [{names[0], names[3]}, {names[2], names[1]}]
        if others not in (crossed, crossed[::-1]):
            continue
        values = [series.read(node) for node in (a, b, x, y, first.one.node, second.one.node)]
        if any(value is None for value in values):
            continue
        cosine, sine, *vectors = np.broadcast_arrays(*values)  # type: ignore[arg-type]
        known = np.isfinite(cosine) & np.isfinite(sine)
        if not known.any() or np.abs(cosine[known] ** 2 + sine[known] ** 2 - 1).max() > SAME:
            continue
        roots = {node.id for part in (x, y) for node in ast.walk(part) if isinstance(node, ast.Name)}
        before, after = np.stack(vectors[:2], -1), np.stack(vectors[2:], -1)
        return VectorTurn(
            first.one, None, f"({names[1]}, {names[3]})", before, after, second.one, bool(roots & parameters)
        )
    return None
