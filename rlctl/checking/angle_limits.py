"""Where an angle in radians is compared with a limit in degrees, as its value shows: it is more than a whole turn."""

import ast
import itertools
import math
from collections.abc import Iterator

import numpy as np

from rlctl.checking.angle_readings import OF_RADIANS, OF_ROTATIONS, AngleReadings
from rlctl.checking.angle_units import Unit, read_turn
from rlctl.checking.assignments import read_name
from rlctl.checking.definitions import ReadExpression
from rlctl.checking.experiments.expressions import NotedEpisodes
from rlctl.checking.source_code import Function

TRIGONOMETRIC = {"sin", "cos", "tan"}
WHOLE_TURN, MOST_DEGREES = 2 * math.pi, 180.0
GUARD = 100.0  # a round number that only a simulation which diverges exceeds
OF_ONE_ANGLE = {"abs", "fabs", "absolute", "float"}


class AngleLimits:
    """Finds them in the functions of the environment, also where no episode has come to."""

    def __init__(self, noted: NotedEpisodes) -> None:
        self.source, self.definitions, self.readings = noted.source, noted.definitions, noted.share(AngleReadings)
        self._series = noted.turned.series
        own = {*noted.own_functions}
        self._own = [one for one in self.source.expressions if one.function in own]
        calls = [one.node for one in self._own if isinstance(one.node, ast.Call) and one.node.args]
        self._radians = {self._key(call.args[0]) for call in calls if read_name(call.func) in TRIGONOMETRIC}

    def find_compared(self) -> Iterator[tuple[ast.expr, str]]:
        """Yield the comparisons, and what is wrong with each."""
        for one in self._own:
            if not isinstance(one.node, ast.Compare):
                continue
            for left, right in itertools.pairwise([one.node.left, *one.node.comparators]):
                for angle, limit in ((left, right), (right, left)):
                    number = self._read_degrees(limit, one.function)
                    if number is not None and (most := self._measure_radians(angle, one.function)) is not None:
                        what = f"compares an angle in radians, of up to {most:.2g}, with {number:g}, more than a whole"
                        yield one.node, f"{what} turn: the limit is in degrees, and never acts"

    def _read_constant(self, node: ast.expr) -> float | None:
        """Return a number that is written in the source, or a constant of a module or a class."""
        number = _read_literal(node)
        if number is not None or not isinstance(node, ast.Name | ast.Attribute):
            return number
        numbers = {_read_literal(value) for value, _ in self.readings.constants.get(read_name(node), ())}
        return numbers.pop() if len(numbers) == 1 else None

    def _read_degrees(self, node: ast.expr, function: Function) -> float | None:
        """Return a number that is always the same, and more than a whole turn in radians; none that is computed."""
        unit, origins = self.readings.find(node, function), self._list_origins(node, function)
        number, rows = self._read_constant(node), self._series.read(node)
        known = rows[np.isfinite(rows)] if rows is not None else np.zeros(0)
        written = {_read_literal(one) for one in origins}
        is_plain = unit.unit in (Unit.NUMBER, Unit.DEGREES) if unit is not None else bool(written - {None})
        if not is_plain or (known.size and np.ptp(known)):
            return None
        if known.size:
            number = float(known[0])
        elif number is None and len(written) == 1:
            number = written.pop()
        return number if number is not None and _is_of_degrees(number) else None

    def _list_origins(self, node: ast.expr, function: Function) -> list[ast.expr]:
        """Return what a name or an attribute is given; for a parameter, what it is worth if it is not given."""
        found: list[ast.expr] = []
        places = [one for one, _ in self.readings.list_definitions(ReadExpression(node, function))]
        for place in places or [ReadExpression(node, function)]:
            default = _find_default(place) if isinstance(place.node, ast.Name) else None
            found.append(default or place.node)
        return found

    def _measure_radians(self, node: ast.expr, function: Function) -> float | None:
        """Return the largest value that an angle in radians has had, or may have; None for what was once more than half
        a turn, as that may count turns, and for all else."""
        while isinstance(node, ast.Call) and read_name(node.func) in OF_ONE_ANGLE and len(node.args) == 1:
            node = node.args[0]
        key = self._key(node)
        several = [self._series.read(one.node) for one in self._own if self._key(one.node) == key]
        known = np.concatenate([np.zeros(0), *(rows[np.isfinite(rows)] for rows in several if rows is not None)])
        if self._is_computed(node, function):
            return math.pi if np.abs(known).max(initial=0.0) <= math.pi else None
        if key not in self._radians or not known.min(initial=0.0) < 0 < known.max(initial=0.0):  # a time has one sign
            return None
        most = float(np.abs(known).max())
        return most if most <= math.pi else None

    def _is_computed(self, node: ast.expr, function: Function) -> bool:
        """Say whether an expression is an angle in radians, and no rate."""
        place = ReadExpression(node, function)
        angle = self.readings.find(node, function)
        if angle is None or angle.unit is not Unit.RADIANS:
            return False
        several = [self.definitions.resolve(one).node for one, _ in self.readings.list_definitions(place)]
        return all(map(_is_angle, several or [self.definitions.resolve(place).node]))

    def _key(self, node: ast.expr) -> tuple[ast.AST | None, str]:
        """Return by what an expression is known again: names are those of a function."""
        one = self.source.find(node)
        text = ast.unparse(node) if one is None else one.text
        return None if one is None or text.startswith("self.") else one.function, text


def _is_angle(node: ast.AST) -> bool:
    """Say whether code returns an angle that is wrapped, in radians."""
    match node:
        case ast.Call(func=function):
            return read_name(function) in OF_RADIANS | OF_ROTATIONS
        case ast.BinOp(left=ast.BinOp(op=ast.Mod(), right=turn), op=ast.Sub()):
            return read_turn(turn) is not None
        case ast.Subscript(value=value):
            return _is_angle(value)
    return False


def _find_default(place: ReadExpression) -> ast.expr | None:
    """Return the default of a parameter of a function."""
    given, name = place.function.args, ast.unparse(place.node)
    several = [*given.posonlyargs, *given.args]
    of_places = dict(zip([one.arg for one in several[::-1]], given.defaults[::-1], strict=False))
    of_words = dict(zip([one.arg for one in given.kwonlyargs], given.kw_defaults, strict=True))
    return of_places.get(name) or of_words.get(name)


def _read_literal(node: ast.expr) -> float | None:
    match node:
        case ast.Constant(value=int() | float() as value) if not isinstance(value, bool):
            return float(value)
        case ast.UnaryOp(op=ast.USub(), operand=operand):
            found = _read_literal(operand)
            return None if found is None else -found
    return None


def _is_of_degrees(number: float) -> bool:
    return WHOLE_TURN < abs(number) <= MOST_DEGREES and abs(number) != GUARD
