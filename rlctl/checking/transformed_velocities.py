"""Where the source subtracts a place from a velocity, as from a point."""

import ast
from collections.abc import Iterator

from rlctl.checking.assignments import list_words, peel, read_name
from rlctl.checking.definitions import ReadExpression
from rlctl.checking.experiments.expressions import NotedEpisodes
from rlctl.checking.rule import Rule, RuleFinding
from rlctl.checking.source_code import Function, write_code
from rlctl.checking.term_names import split_name
from rlctl.checking.world_places import is_of_engine

VELOCITY_WORDS = {"vel", "velocity", "velocities", "linvel", "speed", "speeds"}
POINT_WORDS = {
    "pos",
    "position",
    "positions",
    "xpos",
    "origin",
    "place",
    "com",
    "center",
    "centre",
    "xy",
    "xyz",
    "pose",
    "base",
}
DEEPEST = 4


class TransformedVelocities:
    """Those of the functions that were run."""

    def __init__(self, noted: NotedEpisodes) -> None:
        self._noted, self._source, self._definitions = noted, noted.source, noted.definitions
        self._series, self._world = noted.turned.series, noted.turned.world

    def find(self, rule: Rule) -> Iterator[RuleFinding]:
        """Yield the differences of a velocity and a place."""
        for one in self._source.expressions:
            match one.node:
                case ast.BinOp(left=left, op=ast.Sub(), right=right) if self._is_vector(one.node):
                    pass
                case _:
                    continue
            velocity = self._find_velocity(ReadExpression(left, one.function))
            if velocity is None or not self._is_point(right, one.function):
                continue
            text = write_code(velocity.node)
            message = f"{one.text} subtracts a place from a velocity"
            message += f", {text}" if velocity.function is not one.function or text != write_code(left) else ""
            evidence = {"element": text, "value": write_code(right)}
            yield RuleFinding(rule, message, evidence, where=self._source.find_place(velocity.node))

    def _is_vector(self, node: ast.expr) -> bool:
        return any(self._series.read(node, size=size) is not None for size in (2, 3))

    def _find_velocity(self, place: ReadExpression, depth: int = 0) -> ReadExpression | None:
        """Return the velocity that an expression is, in one of the calls of its function; None for others."""
        node = peel(place.node)
        while isinstance(node, ast.Subscript) and isinstance(node.slice, ast.Slice | ast.Tuple):
            node = peel(node.value)
        words = {*split_name(read_name(node))}
        if (words & VELOCITY_WORDS and not words & POINT_WORDS) or self._world.is_engine_velocity(node):
            return place
        if not isinstance(node, ast.Name) or depth > DEEPEST:
            return None
        several = self._definitions.follow(place.at(node))
        found = (self._find_velocity(one, depth + 1) for one in several)
        return next((one for one in found if one is not None), None)

    def _is_point(self, node: ast.expr, function: Function) -> bool:
        one = self._source.find(node)
        words = list_words(node)
        if words & VELOCITY_WORDS or one is None:
            return False
        resolved = self._definitions.resolve(ReadExpression(peel(node), function)).node
        is_known = is_of_engine(one) or any(self._world.is_place_field(part) for part in (node, resolved))
        return is_known or bool({*split_name(read_name(peel(node)))} & POINT_WORDS)
