"""Vectors in the axes of the world that the source puts into an observation next to vectors in the frame of the
robot."""

import ast
import functools
import itertools
from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from rlctl.checking.assignments import CONVERSIONS, list_words, read_name
from rlctl.checking.definitions import Definitions, ReadExpression
from rlctl.checking.rule import Rule, RuleFinding
from rlctl.checking.source_code import Function
from rlctl.checking.turned_expressions import VectorTurn
from rlctl.checking.vector_series import FEWEST, VectorSeries
from rlctl.checking.wrong_turns import FRAME_RULES, TurnedVectors

Array = NDArray[np.float64]

OBSERVERS = {"observe", "_observe"}  # of tasks, which have no step of their own
PASSED_ON = {
    "append", "clip", "column_stack", "concatenate", "dict", "hstack", "items", "list", "reshape", "stack", "tuple",
    "values", "vstack", "zip", "enumerate", *CONVERSIONS,
}  # fmt: skip
SEEN_WORDS = {"ray", "rays", "scan", "scans", "lidar", "camera", "image", "pixels", "ranges", "sonar"}
DEEPEST = 14
SAME = 1e-6
MOST_ANGLES = 12  # of a piece of code
WIDE = 2.0  # range of the headings in which episodes begin [rad]


class ObservedCode:
    """The pieces of code of which an observation is made."""

    def __init__(self, series: VectorSeries, definitions: Definitions, turns: list[VectorTurn]) -> None:
        self._series, self._definitions = series, definitions
        self._turned = {one.node for turn in turns for one in turn.wholes}

    @functools.cached_property
    def nodes(self) -> list[ast.expr]:
        """All of them, as far as elements of the observation are their elements."""
        found: dict[ast.expr, None] = {}
        for root in self.roots:
            self._visit(root, found, 0)
        return list(found)

    @functools.cached_property
    def roots(self) -> list[ast.expr]:
        """What is returned as an observation."""
        source = self._series.source
        classes = [node for tree in source.trees.values() for node in ast.walk(tree) if isinstance(node, ast.ClassDef)]
        own = sorted((one for one in classes if one.name in source.classes), key=lambda o: source.classes.index(o.name))
        methods = [one for owner in reversed(own) for one in owner.body if isinstance(one, Function)]
        functions = {one.name: one for one in methods}.values()
        return [root for function in functions for root in self._list_roots(function)]

    def _list_roots(self, function: Function) -> Iterator[ast.expr]:
        for node in ast.walk(function):
            match node:
                case ast.Return(value=ast.Tuple(elts=[first, *_])) if function.name == "step":
                    yield first
                case ast.Return(value=ast.expr() as value) if function.name in OBSERVERS:
                    yield value

    def _visit(self, node: ast.expr, found: dict[ast.expr, None], depth: int) -> None:
        if node in found or depth > DEEPEST:
            return
        found[node] = None
        is_difference = isinstance(node, ast.BinOp) and isinstance(node.op, ast.Sub)
        if node in self._turned or (is_difference and self._is_vector(node)):
            return
        for part in self.list_parts(node):
            self._visit(part, found, depth + 1)

    def _is_vector(self, node: ast.expr) -> bool:
        return any(self._series.read(node, size=size) is not None for size in (2, 3))

    def list_parts(self, node: ast.expr) -> list[ast.expr]:
        """Return the pieces of code whose elements are elements of another one."""
        match node:
            case ast.Dict(values=values):
                return values
            case ast.List(elts=parts) | ast.Tuple(elts=parts):
                return parts
            case ast.Subscript(slice=index) if _is_vertical(index):
                return []  # of a vector the same in any direction
            case ast.Starred(value=value) | ast.UnaryOp(operand=value) | ast.Subscript(value=value):
                return [value]
            case ast.ListComp(elt=value) | ast.GeneratorExp(elt=value) | ast.DictComp(value=value):
                return [value]
            case ast.BinOp(left=left, op=ast.Add() | ast.Sub(), right=right):
                return [left, right]
            case ast.BinOp(left=left, op=ast.Mult() | ast.Div(), right=right):
                return [one for one, other in ((left, right), (right, left)) if not self._varies(other)]
            case ast.IfExp(body=body, orelse=other):
                return [body, other]
            case ast.Attribute(attr="T", value=array):
                return [array]
            case ast.Attribute():
                text = ast.unparse(node)  # what is added to itself is something else than its parts
                values = self._definitions.read(node)
                return [one for one in values if text not in map(ast.unparse, ast.walk(one))]
            case ast.Name():
                several = [*self._definitions.read(node), *self._definitions.read_parts(node)]
                function = self._series.source.find_function(node)
                passed = self._definitions.follow(ReadExpression(node, function)) if not several else []
                return [*several, *(one.node for one in passed), *self._list_appended(node)]
            case ast.Call(func=function, args=args, keywords=keywords):
                name = read_name(function)
                owner = [function.value] if isinstance(function, ast.Attribute) else []
                given = [*args, *(keyword.value for keyword in keywords)]
                if name in PASSED_ON:
                    return [*owner, *given]
                return self._definitions.read_returned(node) or [one for one in given if self._is_like(node, one)]
        return []

    def _varies(self, node: ast.expr) -> bool:
        """Say whether a factor is another one in other calls, or nothing."""
        several = [self._series.read(node, size=size) for size in (None, 2, 3)]
        known = [rows[np.isfinite(rows).all(axis=tuple(range(1, rows.ndim)))] for rows in several if rows is not None]
        moves = (float(np.ptp(rows, axis=0).max(initial=0.0)) > SAME or not rows.any() for rows in known if len(rows))
        return any(moves)

    def _list_appended(self, name: ast.Name) -> list[ast.expr]:
        """Return what is appended to a list."""
        found: list[ast.expr] = []
        for node in ast.walk(self._series.source.find_function(name)):
            match node:
                case ast.Call(func=ast.Attribute(attr="append" | "extend", value=ast.Name(id=text)), args=args) if (
                    text == name.id
                ):
                    found += args
        return found

    def _is_like(self, whole: ast.expr, part: ast.expr) -> bool:
        """Say whether a function returns as many elements as an argument has: it may add noise."""
        sizes = [self._series.read(node, size=size) for node in (whole, part) for size in (2, 3)]
        return any(one is not None and other is not None for one, other in zip(sizes[:2], sizes[2:], strict=True))


def _is_vertical(index: ast.expr) -> bool:
    """Say whether an index takes the last of three elements."""
    last = index.elts[-1] if isinstance(index, ast.Tuple) and index.elts else index
    match last:
        case ast.Constant(value=2) | ast.Slice(lower=ast.Constant(value=2)):
            return True
        case ast.List(elts=[ast.Constant(value=2)]):
            return True
    return False


def find_world_vectors(rule: Rule, turned: TurnedVectors, observed: ObservedCode) -> Iterator[RuleFinding]:
    """Yield the first vector of the world in an observation that has others in the frame of the robot, or that the
    source turns into that frame elsewhere, if it does not show its heading, with which episodes begin in all
    directions."""
    series, directions, world = turned.series, turned.directions, turned.world
    if any(SEEN_WORDS & list_words(node) for node in observed.nodes):
        return
    inside = {turn.whole.node for turn in turned.turns} & set(observed.nodes)
    backwards = [(turn, found[1]) for turn, found in turned.known if found is not None and found[0] < 0]
    orientations = {one.text for one in series.orientations}
    for turn, by in sorted(backwards, key=lambda entry: entry[0].whole.node not in inside):
        if by in orientations and directions.has_engine and not world.has_free_base:
            continue  # the gripper of an arm, whose joints tell its heading
        yaw = directions.read_yaw(turn, by)
        if yaw is None or not _begins_anywhere(series, yaw):
            continue
        if _shows_heading(series, observed.nodes, yaw):
            return
        is_observed = turn.whole.node in inside
        is_of_world = is_observed and (world.is_gravity(turn.before) or world.explain(turn))
        for node in observed.nodes:
            what = _explain(turned, node, yaw) if is_of_world else None
            if is_observed and world.is_engine_velocity(node):
                what = "the velocity of the base"
            if what is None and _moves(turn.before) and _is_same_vector(series, node, turn):
                what = f"which {turn.whole.text} turns into the frame of the robot"
            one = series.source.find(node)
            if what is not None and one is not None:
                message = f"{one.text}, {what}, is observed in the axes of the world"
                message += f", and {turn.whole.text} in the frame of the robot" if is_observed else ""
                message += f": nothing shows the heading, which is another one in each episode ({by})"
                evidence = {"element": one.text, "value": by}
                yield RuleFinding(rule, message, evidence, where=one.where, same=FRAME_RULES)
                return


def _moves(rows: Array) -> bool:
    known = rows[np.isfinite(rows).all(axis=2)]
    return bool(len(known)) and float(np.ptp(known[:, :2], axis=0).max()) > SAME


def _is_same_vector(series: VectorSeries, node: ast.expr, turn: VectorTurn) -> bool:
    """Say whether a piece of code is worth what is turned, and not what it is turned into."""
    rows = series.read(node, size=turn.before.shape[2])
    if rows is None or rows.shape != turn.before.shape:
        return False
    known = np.isfinite(rows).all(axis=2) & np.isfinite(turn.before).all(axis=2)
    before, after = (
        np.allclose(rows[known], other[known], rtol=SAME, atol=1e-9) for other in (turn.before, turn.after)
    )
    return bool(known.sum() >= FEWEST and before and not after)


def _begins_anywhere(series: VectorSeries, yaw: Array) -> bool:
    firsts = [yaw[series.episodes == number][:2] for number in np.unique(series.episodes)]
    known = np.array([rows[np.isfinite(rows)][0] for rows in firsts if np.isfinite(rows).any()])
    return len(known) > 2 and float(np.ptp(np.angle(np.exp(1j * known)))) > WIDE


def _shows_heading(series: VectorSeries, nodes: Sequence[ast.expr], yaw: Array) -> bool:
    """Say whether pieces of code show the heading, or an angle to it from a direction that others show."""
    offsets: list[Array] = []
    for node in nodes:
        if _shows(series, node, yaw):
            return True
        offsets += _list_offsets(series, node, yaw)
    constant = [np.broadcast_to(offset, yaw.shape) for offset in offsets]
    return any(_shows(series, node, offset) or not offset.any() for node in nodes for offset in constant)


def _list_offsets(series: VectorSeries, node: ast.expr, yaw: Array) -> Iterator[Array]:
    """Yield by how much an angle that changes as the heading does differs from it in each episode: (calls, 1)."""
    rows = series.read(node)
    if rows is None or len(rows) != len(yaw):
        return
    angles = yaw[:, :1]
    for column, sign in itertools.product(range(min(rows.shape[1], MOST_ANGLES)), (1, -1)):
        offset = np.angle(np.exp(1j * (sign * rows[:, column : column + 1] - angles)))
        means = np.full_like(offset, np.nan)
        for number in np.unique(series.episodes):
            own = offset[series.episodes == number]
            known = own[np.isfinite(own)]
            if len(known) == 0 or np.abs(np.exp(1j * known) - np.exp(1j * known[0])).max() > SAME:
                break
            means[series.episodes == number] = known[0]
        else:
            if np.nanstd(angles) > SAME:
                yield np.zeros_like(offset) if np.ptp(np.exp(1j * means).real) < SAME else means


def _shows(series: VectorSeries, node: ast.expr, yaw: Array) -> bool:
    """Say whether a piece of code has an angle, its sine or its cosine, that of half of it, or an orientation."""
    rows = series.read(node)
    if rows is None or len(rows) != len(yaw):
        return False
    angles = np.broadcast_to(yaw[:, :1], rows.shape)
    known = np.isfinite(rows) & np.isfinite(angles)
    if not known.any():
        return False
    turned = np.abs(np.exp(1j * rows) - np.exp(1j * angles)) < SAME
    if ((turned | ~known).all(axis=0) & known.any(axis=0)).any():
        return True
    for wanted in (np.cos(angles), np.sin(angles), np.cos(angles / 2), np.sin(angles / 2)):
        near = (np.abs(np.abs(rows) - np.abs(wanted)) < SAME) | ~known
        if (near.all(axis=0) & known.any(axis=0)).any():
            return True
    lengths = np.linalg.norm(rows[np.isfinite(rows).all(axis=1)], axis=1)
    is_orientation = rows.shape[1] in (4, 9) and np.abs(lengths - {4: 1, 9: 3}[rows.shape[1]] ** 0.5).max() < 1e-4
    return bool(is_orientation)


def _explain(turned: TurnedVectors, node: ast.expr, yaw: Array) -> str | None:
    """Return what a vector of the world is; None for others."""
    series, world, turns = turned.series, turned.world, turned.turns
    for size in (2, 3):
        rows = series.read(node, size=size)
        one = series.source.find(node)
        if rows is None or one is None or rows.shape[1] != yaw.shape[1] or not np.nanstd(rows, axis=0).any():
            continue
        if any(_is_same(turn.after, rows) for turn in turns) or any(node is turn.part for turn in turns):
            return None
        c, s = np.cos(yaw), np.sin(yaw)
        after = rows.copy()
        after[..., 0], after[..., 1] = c * rows[..., 0] + s * rows[..., 1], c * rows[..., 1] - s * rows[..., 0]
        if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Sub):
            sides = [series.read(side, size=size) for side in (node.left, node.right)]
            if any(side is not None and _is_same(turn.after, side) for side in sides for turn in turns):
                return None
            found = world.find_way(VectorTurn(one, node, one.text, rows, after))
            return None if found is None else "a way"
        if world.is_velocity(VectorTurn(one, node, one.text, rows, after)):
            return "the velocity that moves a position"
    return None


def _is_same(one: Array, other: Array) -> bool:
    return one.shape == other.shape and np.allclose(one, other, rtol=1e-6, atol=1e-9, equal_nan=True)
