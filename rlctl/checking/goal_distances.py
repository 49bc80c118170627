"""Which expressions of a source are distances to something that is to be reached: a goal, a target, an object."""

import ast
import dataclasses
import functools
from collections.abc import Iterator, Sequence

from rlctl.checking.assignments import LIBRARIES, list_words, read_converted, read_name, read_root
from rlctl.checking.definitions import ReadExpression
from rlctl.checking.experiments.expressions import NotedEpisodes
from rlctl.checking.paid_errors import EARLIER_WORDS, FEWEST, WANTED_WORDS
from rlctl.checking.paid_goals import AVOIDED_WORDS
from rlctl.checking.source_code import Expression, Function
from rlctl.checking.summands import Summand
from rlctl.checking.term_names import split_name

HAND_WORDS = {
    "claw", "ee", "eef", "effector", "finger", "fingers", "fingertip", "grip", "gripper", "hand", "hook", "jaw",
    "magnet", "palm", "suction", "tcp", "tip", "tool",
}  # fmt: skip
OBJECT_WORDS = {
    "ball", "block", "bottle", "box", "brick", "button", "can", "cap", "crate", "cube", "cup", "door", "drawer",
    "handle", "hole", "item", "knob", "lever", "lid", "nut", "obj", "object", "parcel", "part", "peg", "plug", "puck",
    "screw", "socket", "stone", "switch", "valve",
}  # fmt: skip
TARGET_WORDS = WANTED_WORDS | {
    "basket", "beacon", "bin", "charger", "checkpoint", "dest", "destination", "dock", "gate", "hoop", "pad", "slot",
    "station",
}  # fmt: skip
REACH_WORDS = {"reach", "reaching", "reached", "approach"}
LENGTHS = {
    "norm", "hypot", "sqrt", "dist", "distance", "abs", "absolute", "fabs", "sum", "square", "dot", "vdot", "inner",
}  # fmt: skip
"""Functions of a difference whose values are lengths, or their squares, where they are never negative."""
AWAY_WORDS = AVOIDED_WORDS | {"drop", "keep", "orbit", "release", "repulse", "standoff", "throw", "thrown", "between"}
FEWEST_SUMMANDS = 2
DEEPEST = 8  # parts of an expression that are searched for a difference


@dataclasses.dataclass(frozen=True, eq=False)
class GoalDistance:
    """An expression that is worth the distance to something that is to be reached."""

    expression: Expression
    summands: tuple[Summand, ...]  # of the reward, that are computed from it
    largest: float  # that was noted
    sides: tuple[ReadExpression, ReadExpression]  # the two things whose distance it is
    is_told: bool  # Whether names tell that it is the distance to something that is to be reached


class DistanceReader:
    """Finds them."""

    def __init__(self, notes: NotedEpisodes) -> None:
        self.notes, self.definitions = notes, notes.reward.definitions

    @functools.cached_property
    def distances(self) -> list[GoalDistance]:
        """Those that the reward may be computed from, in the order of the source."""
        found = [one for one in self.measured if one.is_told]
        inner = {part for one in found for part in ast.walk(one.expression.node) if part is not one.expression.node}
        return [one for one in found if one.expression.node not in inner]

    @functools.cached_property
    def measured(self) -> list[GoalDistance]:
        """All distances that the reward may be computed from, but for those from what is to be kept away from."""
        return list(self._list_distances())

    def _list_distances(self) -> Iterator[GoalDistance]:
        evaluated = {number for call in self.notes.steps for number in call.values}
        for one in self.notes.source.expressions:
            is_copy = read_converted(one.node) is not None
            if one.number not in evaluated or is_copy or not _may_be_length(one.node):
                continue
            values = self.notes.reward.numbers.list_values(one.node)
            if values.size < FEWEST or values.min() < 0 or values.max() <= 0:
                continue
            sides = self._read_sides(ReadExpression(one.node, one.function, {}))
            if sides is None:
                continue
            summands = tuple(self._list_summands(one))
            is_unread = len(self._walked) < FEWEST_SUMMANDS  # as in a step that calls the one of another class
            is_told = self._is_to_be_reached(one, sides, summands) if summands or is_unread else None
            if is_told is not None:
                yield GoalDistance(one, summands, float(values.max()), sides, is_told)

    def _list_summands(self, one: Expression) -> Iterator[Summand]:
        """Yield the summands that are computed from an expression, or from what the own function returns that it
        calls."""
        place = ReadExpression(one.node, one.function)
        inside = {one.node, *(returned.node for returned in self.definitions.list_returned(place))}
        inside |= {self.definitions.find_origin(node, one.function) for node in inside}
        for summand, nodes in self._walked:
            if inside & nodes:
                yield summand

    @functools.cached_property
    def _walked(self) -> list[tuple[Summand, set[ast.expr]]]:
        reward = self.notes.reward
        return [(one, {place.node for place in self.definitions.walk(one.place)}) for one in reward.summands]

    def _read_sides(self, place: ReadExpression) -> tuple[ReadExpression, ReadExpression] | None:
        """Return the two things whose distance is measured; None where there are none, or a function returns it of its
        parameters: those are known where it is called."""
        returned = self.definitions.list_returned(place)
        if len(returned) == 1 and isinstance(returned[0].node, ast.Call | ast.BinOp):
            sides = self._read_length(returned[0])
            return sides if sides and any(_is_parameter(side) for side in sides) else None
        sides = self._read_length(place)
        is_named = isinstance(self.notes.source.find_statement(place.node), ast.Assign)
        return None if sides is None or (any(map(_is_parameter, sides)) and not is_named) else sides

    def _read_length(self, place: ReadExpression) -> tuple[ReadExpression, ReadExpression] | None:
        while isinstance(place.node, ast.Call) and read_name(place.node.func) in ("float", "item", "abs"):
            if read_name(place.node.func) == "abs" or not place.node.args:
                break
            place = self.definitions.resolve(place.at(place.node.args[0]))
        match place.node:
            case ast.Call(func=function, args=[one, two]) if read_name(function) in ("dist", "distance"):
                return place.at(one), place.at(two)
            case ast.Call(func=function) if read_name(function) in LENGTHS:
                return self._find_first([place.at(one) for one in _list_measured(place.node)])
            case ast.BinOp() if _may_be_length(place.node):
                return self._find_difference(place)
        return None

    def _find_first(
        self, places: Sequence[ReadExpression], depth: int = 0
    ) -> tuple[ReadExpression, ReadExpression] | None:
        found = (self._find_difference(place, depth) for place in places)
        return next((one for one in found if one is not None), None)

    def _find_difference(self, place: ReadExpression, depth: int = 0) -> tuple[ReadExpression, ReadExpression] | None:
        node = place.node
        parts: list[ReadExpression] = []
        match node:
            case ast.BinOp(left=left, op=ast.Sub(), right=right):
                return place.at(left), place.at(right)
            case ast.BinOp(left=left, op=ast.Add() | ast.Mult() | ast.MatMult(), right=right):
                parts = [place.at(left), place.at(right)]
            case ast.BinOp(left=left, op=ast.Pow()):
                parts = [place.at(left)]
            case ast.Subscript(value=owner) if not isinstance(owner, ast.Name | ast.Attribute):
                parts = [place.at(owner)]
            case ast.Subscript(value=owner):
                parts = self.definitions.follow(place) or self.definitions.follow(place.at(owner))
            case ast.List(elts=elements) | ast.Tuple(elts=elements):
                parts = [place.at(one) for one in elements]
            case ast.Call():
                parts = self.definitions.follow(place) or [place.at(one) for one in _list_measured(node)]
            case ast.Name() | ast.Attribute():
                unpacked = [one for one in self.definitions.list_before(place) if one.element is not None]
                found = self.definitions.follow(place) or [place.at(one.value) for one in unpacked]
                parts = found if len(found) == 1 else []
        return self._find_first(parts, depth + 1) if depth < DEEPEST else None

    def _is_to_be_reached(
        self, one: Expression, sides: tuple[ReadExpression, ReadExpression], summands: tuple[Summand, ...]
    ) -> bool | None:
        """Say whether names tell it; None where they tell the opposite."""
        left, right = (self._list_words(side) for side in sides)
        names = self._list_titles(one.node)
        titles = names | {word for one in summands for name in (one.name, *one.names) for word in split_name(name)}
        if (left | right | titles) & AWAY_WORDS or (left | right | names) & EARLIER_WORDS:
            return None
        is_of_goal = bool(left & TARGET_WORDS) != bool(right & TARGET_WORDS)
        is_of_hand = any(one & HAND_WORDS and two & OBJECT_WORDS for one, two in ((left, right), (right, left)))
        is_called_so = bool(names & (REACH_WORDS | TARGET_WORDS))
        is_size = isinstance(one.node, ast.Call) and read_name(one.node.func) in ("abs", "absolute", "fabs")
        return is_of_goal or (not is_size and (is_of_hand or is_called_so))

    def _list_words(self, side: ReadExpression) -> set[str]:
        """Return the words of the names with which a side is written, and of those that it stands for."""
        words: set[str] = set()
        for _ in range(DEEPEST):
            words |= list_words(side.node)
            found = self.definitions.follow(side)
            if len(found) != 1:
                break
            side = found[0]
        return words

    def _list_titles(self, node: ast.expr) -> set[str]:
        """Return the words of the variable that is given this value, or of the function that returns it."""
        parents, names = self.notes.source.parents, []
        parent = parents.get(node)
        while isinstance(parent, ast.Call):
            parent = parents.get(parent)
        if isinstance(parent, ast.Assign):
            names = [read_name(target) for target in parent.targets]
        elif isinstance(parent, ast.Return):
            names = [self.notes.source.find_function(parent).name]
        return {word for name in names for word in split_name(name)}


def _may_be_length(node: ast.expr) -> bool:
    """Say whether it is a call, a scalar product, or a square or a sum of squares."""
    match node:
        case ast.BinOp(left=left, op=ast.Add(), right=right):
            return _may_be_length(left) and _may_be_length(right) and not isinstance(left, ast.Call)
        case ast.BinOp(op=ast.Pow(), right=ast.Constant(value=2)):
            return True
    return isinstance(node, ast.Call) or (isinstance(node, ast.BinOp) and isinstance(node.op, ast.MatMult))


def _list_measured(call: ast.Call) -> list[ast.expr]:
    """Return the arguments of a call; of a method of an array, the array."""
    match call:
        case ast.Call(func=ast.Attribute(value=owner)) if read_root(owner) not in LIBRARIES:
            return [owner, *call.args]
    return call.args


def _is_parameter(side: ReadExpression) -> bool:
    node: ast.expr = side.node
    while isinstance(node, ast.Subscript):
        node = node.value
    return isinstance(node, ast.Name) and node.id in _list_parameters(side.function)


def _list_parameters(function: Function) -> set[str]:
    return {one.arg for one in [*function.args.posonlyargs, *function.args.args]} - {"self", "cls"}
