"""Where the source turns one vector of an observation the other way than all others, and points of a body backwards."""

import ast
import collections
from collections.abc import Iterator

import numpy as np

from rlctl.checking.assignments import read_name
from rlctl.checking.definitions import Definitions
from rlctl.checking.experiments.expressions import NotedEpisodes
from rlctl.checking.rule import Rule, RuleFinding
from rlctl.checking.turned_expressions import VectorTurn
from rlctl.checking.vector_series import SAME, VectorSeries
from rlctl.checking.world_places import is_of_engine, is_place
from rlctl.checking.wrong_turns import FRAME_RULES, TurnedVectors


def find_wrong_points(rule: Rule, turned: TurnedVectors) -> Iterator[RuleFinding]:
    """Yield the points of a body that are added to its place after they were turned by the inverse."""
    rights = {one.text for one in turned.series.orientations}
    for turn, found in turned.known:
        if found is None or found[0] > 0 or not _is_constant(turn) or not _is_added_to_place(turned, turn, found[1]):
            continue
        by = found[1]
        if (turn.before.shape[2] == 3 and by in rights) or by in turned.rights or turned.directions.counts_forwards(by):
            message = f"{turn.whole.text} turns {turn.text}, which is fixed to a body, by the inverse of {by}, from the"
            message += " world to the body, and it is added to a place in the world"
            evidence = {"element": turn.whole.text, "value": turn.text}
            yield RuleFinding(rule, message, evidence, where=turn.whole.where, same=FRAME_RULES)


def _is_constant(turn: VectorTurn) -> bool:
    known = turn.before[np.isfinite(turn.before).all(axis=(1, 2))]
    return len(known) > 0 and float(np.ptp(known, axis=0).max()) <= SAME


def _is_added_to_place(turned: TurnedVectors, turn: VectorTurn, by: str) -> bool:
    source = turned.series.source
    match source.parents[turn.whole.node]:
        case ast.BinOp(left=left, op=ast.Add(), right=right):
            one = source.find(right if left is turn.whole.node else left)
            is_known = one is not None and (is_place(one) or is_of_engine(one) or turned.world.is_place_field(one.node))
            return is_known or (one is not None and turned.directions.moves_by(one.node, by))
    return False


def find_lone_turns(rule: Rule, noted: NotedEpisodes) -> Iterator[RuleFinding]:
    """Yield the vector of an observation that is turned by an orientation itself while the others are turned by the
    inverse, or the other way round."""
    series = noted.turned.series
    ways = collections.defaultdict[str, dict[bool, list[ast.expr]]](lambda: {True: [], False: []})
    for node in noted.observed.nodes:
        way = _read_way(series, noted.definitions, node)
        if way is not None and ast.unparse(node) not in map(ast.unparse, ways[way[0]][way[1]]):
            ways[way[0]][way[1]].append(node)
    for by, found in ways.items():
        several, few = sorted(found.values(), key=len, reverse=True)
        if len(few) != 1 or len(several) < 2:
            continue
        one = noted.source.find(few[0])
        if one is not None:
            others = ", ".join(ast.unparse(node) for node in several[:2])
            message = f"{one.text} turns a vector of the observation by {by} in the other direction than {others}:"
            message += " all of them cannot be in one frame"
            yield RuleFinding(rule, message, {"element": one.text, "value": by}, where=one.where, same=FRAME_RULES)


def _read_way(series: VectorSeries, definitions: Definitions, node: ast.expr) -> tuple[str, bool] | None:
    """Return by what a piece of code turns a vector, and whether by its inverse."""
    if all(series.read(node, size=size) is None for size in (2, 3)):
        return None
    match node:
        case ast.BinOp(left=ast.Attribute(attr="T", value=matrix), op=ast.MatMult()):
            return ast.unparse(matrix), True
        case ast.BinOp(left=matrix, op=ast.MatMult()):
            return ast.unparse(matrix), False
        case ast.Call(func=function, args=[_, angle]) if definitions.find_function(read_name(function)) is not None:
            is_negative = isinstance(angle, ast.UnaryOp) and isinstance(angle.op, ast.USub)
            return ast.unparse(angle.operand if is_negative else angle), is_negative  # type: ignore[attr-defined]
    return None
