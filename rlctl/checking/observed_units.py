"""Angles that the source observes in degrees, next to others in radians."""

import ast
import functools
from collections.abc import Iterator

from rlctl.checking.angle_readings import TAKING_RADIANS, AngleReadings
from rlctl.checking.angle_units import DEGREE_WORDS, Angle, Unit, list_factors
from rlctl.checking.assignments import list_words, peel, read_name
from rlctl.checking.experiments.expressions import NotedEpisodes
from rlctl.checking.observed_frames import DEEPEST
from rlctl.checking.rule import Rule, RuleFinding

LEAST_FACTOR = 0.1  # of degrees, that is not a scale that makes them small


class ObservedUnits:
    """The units of what an observation is made of."""

    def __init__(self, noted: NotedEpisodes) -> None:
        self._source, self._definitions = noted.source, noted.definitions
        self._readings = noted.share(AngleReadings)
        self._observed = noted.observed
        self._seen: set[ast.expr] = set()
        self._angles = [entry for root in self._observed.roots for entry in self._list(root, 0)]

    def _list(self, node: ast.expr, depth: int) -> Iterator[tuple[ast.expr, Angle]]:
        """Yield the largest pieces of code that are angles."""
        if node in self._seen or depth > DEEPEST:
            return
        self._seen.add(node)
        is_own = isinstance(node, ast.Call) and read_name(node.func) in self._definitions.functions
        parts = self._observed.list_parts(node)
        if parts and (is_own or isinstance(node, ast.Name | ast.Attribute)):
            found = [entry for part in parts for entry in self._list(part, depth + 1)]  # as it is computed
            if found:
                yield from found
                return
        angle = self._readings.find(node, self._source.find_function(node))
        if angle is not None and angle.unit in (Unit.DEGREES, Unit.RADIANS):
            yield node, angle
        elif ast.unparse(peel(node)) in self._taken:
            yield node, Angle(Unit.RADIANS, "by what is computed with it")
        else:
            for part in parts:
                yield from self._list(part, depth + 1)

    @functools.cached_property
    def _taken(self) -> set[str]:
        """What is given to functions of radians, and what is added to it, times a time."""
        calls = [one.node for one in self._source.expressions if isinstance(one.node, ast.Call)]
        taken = {ast.unparse(call.args[0]) for call in calls if read_name(call.func) in TAKING_RADIANS and call.args}
        several = [one for known in self._definitions.assigned.values() for one in known]
        added = [part for one in several if ast.unparse(one.target) in taken for part, _ in one.added]
        rates = [factor for part in added for factor, exponent in list_factors(part).others if exponent > 0]
        return taken | {ast.unparse(rate) for rate in rates if isinstance(rate, ast.Attribute)}

    def find_degrees(self, rule: Rule) -> Iterator[RuleFinding]:
        """Yield what is in degrees, where something else is in radians."""
        others = [(node, angle) for node, angle in self._angles if angle.unit is Unit.RADIANS]
        for node, angle in self._angles:
            one = self._source.find(node)
            if angle.unit is not Unit.DEGREES or one is None or not others or self._is_told(node):
                continue
            if self._find_factor(node) >= LEAST_FACTOR:
                other = others[0]
                message = f"{one.text} is observed in degrees ({angle.why}), and {ast.unparse(other[0])} in radians"
                message += f" ({other[1].why})"
                yield RuleFinding(rule, message, {"element": one.text, "value": ast.unparse(other[0])}, where=one.where)

    def _find_factor(self, node: ast.expr) -> float:
        """Return by what degrees are multiplied that are observed, as far as numbers of the source say it."""
        if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Add | ast.Sub):
            parts = [node.left, node.right]
            angles = [self._readings.find(part, self._source.find_function(part)) for part in parts]
            degrees = [part for part, angle in zip(parts, angles, strict=True) if angle and angle.unit is Unit.DEGREES]
            return self._find_factor(degrees[0]) if degrees else 0.0
        factors = list_factors(node)
        nested = [part for part, exponent in factors.others if exponent > 0 and isinstance(part, ast.BinOp)]
        return abs(factors.number) * (self._find_factor(nested[0]) if nested else 1.0)

    def _is_told(self, node: ast.expr) -> bool:
        """Say whether the name of an entry, or of what it is kept in, says that it is in degrees."""
        below, above = node, self._source.parents[node]
        while not isinstance(above, ast.stmt):
            if isinstance(above, ast.Dict) and below in above.values:
                key = above.keys[above.values.index(below)]
                return key is not None and bool(list_words(key) & DEGREE_WORDS)
            below, above = above, self._source.parents[above]  # type: ignore[assignment]
        targets = above.targets if isinstance(above, ast.Assign) else []
        return any(list_words(target) & DEGREE_WORDS for target in targets)
