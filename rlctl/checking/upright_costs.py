"""Costs of a tilt that square the vertical part of a direction: they are largest where a robot stands upright."""

import ast
from collections.abc import Iterator

import numpy as np

from rlctl.checking.assignments import read_name
from rlctl.checking.definitions import ReadExpression
from rlctl.checking.experiments.expressions import NotedEpisodes
from rlctl.checking.summands import Summand

FEWEST = 20  # values
UNIT = 1e-3  # how far from 1 the length of a direction may be
UPRIGHT = 0.9  # of its vertical part, at the start of episodes


def find_upright_costs(notes: NotedEpisodes) -> Iterator[tuple[Summand, ast.expr]]:
    """Yield the summand, and the vertical part that it squares."""
    for summand in notes.reward.summands:
        for place in notes.definitions.walk(summand.place) if summand.weight < 0 else ():
            squared = _read_squared(place.node)
            if squared is not None and _is_vertical_part(squared) and _is_upright(notes, place.at(squared)):
                yield summand, squared


def _read_squared(node: ast.expr) -> ast.Subscript | None:
    match node:
        case ast.BinOp(left=ast.Subscript() as base, op=ast.Pow(), right=ast.Constant(value=2)):
            return base
        case ast.BinOp(left=ast.Subscript() as base, op=ast.Mult(), right=other) if ast.dump(base) == ast.dump(other):
            return base
        case ast.Call(func=function, args=[ast.Subscript() as base]) if read_name(function) == "square":
            return base
    return None


def _is_vertical_part(node: ast.Subscript) -> bool:
    """Say whether the third number of a vector is among those that an index selects."""
    match _read_index(node):
        case ast.Constant(value=2 | -1):
            return True
        case ast.Slice(lower=ast.Constant(value=1 | 2), upper=None | ast.Constant(value=3), step=None):
            return True
        case ast.UnaryOp(op=ast.USub(), operand=ast.Constant(value=1)):
            return True
    return False


def _read_index(node: ast.Subscript) -> ast.expr:
    return node.slice.elts[-1] if isinstance(node.slice, ast.Tuple) and node.slice.elts else node.slice


def _is_upright(notes: NotedEpisodes, place: ReadExpression) -> bool:
    """Say whether it is a part of directions in space, which begin vertical."""
    assert isinstance(place.node, ast.Subscript)
    part = notes.source.find(place.node)
    directions = notes.reward.numbers.list_arrays(place.at(place.node.value))
    if part is None or len(directions) < FEWEST or any(np.shape(value)[-1:] != (3,) for value in directions):
        return False
    lengths = [np.linalg.norm(value, axis=-1).ravel() for value in directions]
    starts = [value for episode in notes.episodes for value in episode[1].values.get(part.number, ())[:1]]
    is_slice = isinstance(_read_index(place.node), ast.Slice)
    numbers = [value[..., -1] if is_slice else value for value in starts if value is not None]  # type: ignore[index]
    begins = [float(np.min(np.abs(value))) for value in numbers]
    is_unit = bool(np.allclose(np.concatenate(lengths), 1.0, atol=UNIT))
    return is_unit and bool(begins) and min(begins) > UPRIGHT
