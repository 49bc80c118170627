"""Where the source looks for a foot that has just come down: by its contact, and by the time that it was in the air."""

import ast
import dataclasses
from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from rlctl.checking.assignments import list_name_words, read_key
from rlctl.checking.definitions import Definitions, ReadExpression
from rlctl.checking.experiments.expressions import NotedEpisodes
from rlctl.checking.expressions import NotedCall
from rlctl.checking.source_code import Expression

FEWEST_STAYS = 20  # steps in which a contact goes on
FEWEST_LANDINGS = 5
EXACT = 1e-6
CONTACT_WORDS = {"contact", "contacts", "touch", "touches", "touching"}
DISTANCE_WORDS = {"dist", "distance", "depth", "gap", "time", "last", "index", "geom", "geom1", "geom2", "id", "link"}
"""What a contact has that may be below 0."""


@dataclasses.dataclass(frozen=True)
class EndlessLanding:
    """A condition that holds in each step of a contact that goes on, since the time in the air was counted before."""

    key: str  # of the time
    text: str
    where: tuple[str, int]
    time: float  # that is counted in a step
    stays: int  # steps in which a contact went on


def find_endless_landings(noted: NotedEpisodes) -> Iterator[EndlessLanding]:
    """Yield conditions `contact and time > 0` that hold in each step of contact."""
    definitions = noted.definitions
    for contact, comparison, time, key in _list_conditions(noted, definitions):
        stays: list[float] = []
        for episode in noted.episodes:
            touching, times = _read(contact, time, episode[1:])
            if not len(touching):
                continue
            goes_on = touching[1:] & touching[:-1]
            stays += times[1:][goes_on].tolist()
        values = np.array(stays)
        if len(values) >= FEWEST_STAYS and values[0] > 0 and np.allclose(values, values[0], rtol=EXACT, atol=0):
            yield EndlessLanding(key, comparison.text, comparison.where, float(values[0]), len(values))


def find_missed_landings(noted: NotedEpisodes) -> Iterator[EndlessLanding]:
    """Yield conditions `contact and time > 0` that never hold, although contacts begin after a time in the air: that
    time has been set to 0 before."""
    for contact, comparison, time, key in _list_conditions(noted, noted.definitions):
        begun, longest, is_met = 0, 0.0, False
        for episode in noted.episodes:
            touching, times = _read(contact, time, episode[1:])
            if len(touching):
                begun += int((touching[1:] & ~touching[:-1] & (times[:-1] > 0)).sum())
                longest = max(longest, float(times.max()))
                is_met |= bool((touching & (times > 0)).any())
        if begun >= FEWEST_LANDINGS and not is_met:
            yield EndlessLanding(key, comparison.text, comparison.where, longest, begun)


def find_counts_of_any_size(noted: NotedEpisodes) -> Iterator[Expression]:
    """Yield comparisons that ask whether a number or a force of contacts is at least 0, which always holds."""
    for one in noted.source.expressions:
        match one.node:
            case ast.Compare(left=count, ops=[ast.GtE()], comparators=[zero]):
                pass
            case ast.Compare(left=zero, ops=[ast.LtE()], comparators=[count]):
                pass
            case _:
                continue
        values = noted.reward.numbers.list_values(count)
        if noted.reward.numbers.read_constant(zero) != 0 or values.size < FEWEST_STAYS or values.min() < 0:
            continue
        origin = noted.definitions.resolve(ReadExpression(count, one.function))
        words = list_name_words(count) | list_name_words(origin.node)
        if words & CONTACT_WORDS and not words & DISTANCE_WORDS:
            yield one


def _list_conditions(
    noted: NotedEpisodes, definitions: Definitions
) -> Iterator[tuple[Expression, Expression, Expression, str]]:
    """Yield a contact, the comparison of a time that has to hold besides, the time, and its attribute."""
    source = noted.source
    for comparison in source.expressions:
        time = _read_time(comparison.node)
        if time is None or (noted_time := source.find(time)) is None:
            continue
        origin = definitions.find_origin(time, comparison.function)
        key = read_key(origin)
        if not key or not _is_timer(definitions, key):
            continue
        for other in _list_others(definitions, comparison.node):
            if (contact := source.find(other)) is not None:
                yield contact, comparison, noted_time, key


def _read_time(node: ast.expr) -> ast.expr | None:
    """Return what has to be more than 0."""
    match node:
        case ast.Compare(left=left, ops=[ast.Gt() | ast.NotEq()], comparators=[ast.Constant(value=0 | 0.0)]):
            return left
        case ast.Compare(left=ast.Constant(value=0 | 0.0), ops=[ast.Lt() | ast.NotEq()], comparators=[right]):
            return right
    return None


def _is_timer(definitions: Definitions, key: str) -> bool:
    """Say whether an attribute is counted up, and is set to 0 other than in the functions that begin an episode."""
    counts = [one for one in definitions.assigned[key] if _counts_up(key, one.statement)]
    zeroes = [one for one in definitions.assigned[key] if _sets_back(one.statement, one.value)]
    return bool(counts and zeroes)


def _counts_up(key: str, statement: ast.stmt) -> bool:
    if isinstance(statement, ast.AugAssign):
        return isinstance(statement.op, ast.Add)
    sums = [node for node in ast.walk(statement) if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Add)]
    return any(read_key(side) == key for one in sums for side in (one.left, one.right))


def _sets_back(statement: ast.stmt, value: ast.expr) -> bool:
    if isinstance(statement, ast.AugAssign):
        return isinstance(statement.op, ast.Mult)
    nodes = list(ast.walk(value))
    is_product = any(isinstance(node, ast.BinOp) and isinstance(node.op, ast.Mult) for node in nodes)
    return is_product or any(isinstance(node, ast.Constant) and node.value in (0, 0.0) for node in nodes)


def _list_others(definitions: Definitions, comparison: ast.expr) -> Iterator[ast.expr]:
    """Yield what has to hold together with a comparison."""
    parents = definitions.source.parents
    node: ast.AST = comparison
    parent = parents[node]
    match parent:
        case ast.Assign(targets=[ast.Name(id=name)]):
            for use in ast.walk(definitions.source.find_function(parent)):
                if isinstance(use, ast.Name) and use.id == name and isinstance(use.ctx, ast.Load):
                    yield from _list_others(definitions, use)
        case ast.BinOp(left=left, op=ast.BitAnd() | ast.Mult(), right=right):
            yield right if left is node else left
        case ast.BoolOp(op=ast.And(), values=values):
            yield from (value for value in values if value is not node)
        case ast.Call(func=ast.Attribute(attr="logical_and" | "multiply"), args=[left, right]):
            yield right if left is node else left
        case ast.If(test=test) if test is node and isinstance(outer := parents[parent], ast.If):
            yield outer.test
    if isinstance(parent, ast.BoolOp) and isinstance(parents[parent], ast.If):
        outer = parents[parents[parent]]
        if isinstance(outer, ast.If):
            yield outer.test


def _read(
    contact: Expression, time: Expression, calls: Sequence[NotedCall]
) -> tuple[NDArray[np.bool_], NDArray[np.float64]]:
    """Return contacts and times at the comparison, by steps and feet. Shape (steps, feet) each; empty where a step has
    other numbers of them."""
    rows = [_pair(call, contact, time) for call in calls]
    if len({len(row) for row in rows}) != 1 or not len(rows[0]):
        return np.zeros((0, 1), np.bool_), np.zeros((0, 1))
    pairs = np.stack(rows)
    on, times = pairs[..., 0], pairs[..., 1]
    if not np.isin(on, (0.0, 1.0)).all():
        return np.zeros((0, 1), np.bool_), np.zeros((0, 1))
    return on > 0, times


def _pair(call: NotedCall, contact: Expression, time: Expression) -> NDArray[np.float64]:
    """Return what a contact and a time are in one step, for each foot. Shape (feet, 2). What is not evaluated, since
    the other one decides already, is 0."""
    columns = {contact.number: 0, time.number: 1}
    first = min((contact, time), key=lambda one: (one.node.lineno, one.node.col_offset)).number
    groups: list[list[NDArray[np.float64]]] = []
    for number, value in call.events:
        if number not in columns or value is None:
            continue
        if number == first or not groups:
            groups.append([np.zeros(1), np.zeros(1)])
        groups[-1][columns[number]] = np.atleast_1d(np.asarray(value, np.float64)).ravel()
    if any(len(one) != len(other) and len(one) > 1 and len(other) > 1 for one, other in groups):
        return np.zeros((0, 2))
    pairs = [np.stack(np.broadcast_arrays(one, other), axis=-1) for one, other in groups]
    return np.concatenate([np.zeros((0, 2)), *pairs])
