"""Commands that a reward compares with a number that is never negative, or with a tolerance that everything meets."""

import ast
import dataclasses
import functools
import itertools
from collections.abc import Iterator, Sequence

import numpy as np

from rlctl.checking.assignments import CONVERSIONS, Assignment, list_name_words, read_name
from rlctl.checking.definitions import ReadExpression
from rlctl.checking.experiments.expressions import NotedEpisodes
from rlctl.checking.expressions import NotedCall
from rlctl.checking.paid_errors import EARLIER_WORDS, FEWEST, PART, ErrorReader, Numbers, has_both_signs
from rlctl.checking.products import list_product
from rlctl.checking.source_code import Function
from rlctl.checking.summands import Summand

SIZES = {"norm", "hypot", "abs", "absolute", "fabs", "square", "sqrt"}
SAME_SIGN = CONVERSIONS | {"sum", "mean", "max", "min", "clip", "round"}
BEGINNINGS = {"zeros", "zeros_like"}
FEWEST_STEPS = 3  # before the one whose command is turned round
SAME = 1e-6
MOST_SEEN = 100  # names that are followed
MET = 0.98  # of the largest value of a kernel: what a tolerance pays that everything meets
CLEARLY, MOST_CHANGES = 0.25, 0.1  # parts: of the largest difference, of the steps


@dataclasses.dataclass(frozen=True, eq=False)
class OneSided:
    """A difference of a command, which has both signs, and a number that is never negative."""

    summand: Summand
    place: ReadExpression  # of the difference
    size: ast.expr  # what is never negative


@dataclasses.dataclass(frozen=True, eq=False)
class AlwaysMet:
    """A part of the reward that is nearly its maximum in each step, whatever the command is."""

    summand: Summand
    place: ReadExpression
    difference: ast.expr
    least: float


class SizeReader:
    """Finds them."""

    def __init__(self, notes: NotedEpisodes) -> None:
        self.notes, self.reward = notes, notes.reward
        self.errors, self.definitions = notes.share(ErrorReader), notes.reward.definitions
        self._lengths: list[ast.expr] = []

    def find_one_sided(self) -> Iterator[OneSided]:
        """Yield differences that cannot be 0 for half of the commands."""
        for summand in self.reward.summands:
            for place, wanted, other in self._list_differences(summand.place):
                commands, values = (self.reward.numbers.list_values(side.node) for side in (wanted, other))
                if not has_both_signs(commands, PART) or values.size < FEWEST or values.min() < 0:
                    continue
                self._lengths = []
                if self._is_never_negative(other, set()) and self._lengths:
                    yield OneSided(summand, place, self._lengths[0])

    def find_sizes_only(self) -> Iterator[OneSided]:
        """Yield differences of two sizes, one of them of a command with both signs, where its sign changes nothing."""
        for summand in self.reward.summands:
            for one in self.definitions.walk(summand.place):
                match one.node:
                    case ast.BinOp(left=left, op=ast.Sub(), right=right):
                        inner = [self._read_inside(one.at(side)) for side in (left, right)]
                        if None not in inner and any(
                            self._is_signed_command(side) for side in inner if side is not None
                        ):
                            yield OneSided(summand, one, left)

    def _read_inside(self, place: ReadExpression) -> ReadExpression | None:
        """Return of what a number is the size."""
        resolved = self.definitions.resolve(place)
        match resolved.node:
            case ast.Call(func=function, args=[only]) if read_name(function) in SIZES - {"square", "sqrt"}:
                return resolved.at(only)
        return None

    def _is_signed_command(self, place: ReadExpression) -> bool:
        values = self.reward.numbers.list_values(place.node)
        is_signed = values.size >= FEWEST and has_both_signs(values, PART)
        return is_signed and self._is_kept(place.node) and not self._is_sign_paid(place)

    def _is_sign_paid(self, place: ReadExpression) -> bool:
        """Say whether the opposite command changes the reward, wherever this reads it."""
        text, functions = ast.unparse(place.node), self._readers | {place.function}
        numbers = [
            one.number for one in self.notes.source.expressions if one.text == text and one.function in functions
        ]
        for number, episode in enumerate(self.notes.episodes):
            for call in episode[FEWEST_STEPS:]:
                values = [call.values[one][-1] for one in numbers if call.values.get(one)]
                if values and values[0] is not None and np.any(values[0]):
                    opposite = dict.fromkeys(numbers, -values[0])
                    return self.notes.changes(number, call.step, {}, opposite, tolerance=SAME) is not False
        return True

    @functools.cached_property
    def _readers(self) -> set[Function]:
        """The functions that compute the reward and set nothing: others move the robot."""
        walked = {one.function for summand in self.reward.summands for one in self.definitions.walk(summand.place)}
        return {
            one for one in walked if not any(key.startswith("self.") for key in self.definitions.list_assigned(one))
        }

    def _list_differences(
        self, place: ReadExpression
    ) -> Iterator[tuple[ReadExpression, ReadExpression, ReadExpression]]:
        """Yield the differences of a command, or a goal, and something else."""
        for one in self.definitions.walk(place):
            match one.node:
                case ast.BinOp(left=left, op=ast.Sub(), right=right):
                    sides = [one.at(left), one.at(right)]
                    wanted = [self.errors.is_wanted(side) for side in sides]
                    if sum(wanted) == 1 and not list_name_words(one.node) & EARLIER_WORDS:
                        yield one, sides[wanted.index(True)], sides[wanted.index(False)]

    def _is_never_negative(self, place: ReadExpression, seen: set[tuple[object, str]]) -> bool:
        """Say whether the source lets a number be at least 0 only. One that is replaced by a mean of itself and others
        is so if these are."""
        node, key = place.node, (place.function, ast.unparse(place.node))
        if key in seen or len(seen) > MOST_SEEN:
            return key in seen
        constant = self.reward.numbers.read_constant(node)
        if constant is not None and not isinstance(node, ast.Attribute | ast.Subscript):
            return constant >= 0
        match node:
            case ast.Call(func=function) if read_name(function) in SIZES:
                self._lengths.append(node)
                return True
            case ast.Call(func=function) if read_name(function) in BEGINNINGS:
                return True
            case ast.Call(func=function, args=[first, *_]) if read_name(function) in SAME_SIGN:
                owner = function.value if isinstance(function, ast.Attribute) else None
                is_method = owner is not None and ast.unparse(owner) not in ("np", "numpy", "math", "torch")
                return self._is_never_negative(place.at(owner if is_method and owner is not None else first), seen)
            case ast.Call(func=ast.Attribute(value=owner, attr=name), args=[]) if name in SAME_SIGN:
                return self._is_never_negative(place.at(owner), seen)
            case ast.BinOp(op=ast.Pow(), right=ast.Constant(value=int(power))) if power % 2 == 0:
                self._lengths.append(node)
                return True
            case ast.BinOp(left=left, op=ast.Add() | ast.Mult() | ast.Div(), right=right):
                return all(
                    self._is_never_negative(place.at(side), seen) or self._is_share(side) for side in (left, right)
                )
            case ast.Name() | ast.Attribute() | ast.Subscript() | ast.Call():
                return self._is_defined_so(place, seen | {key})
        return False

    def _is_share(self, node: ast.expr) -> bool:
        """Say whether it is a constant, or what a share leaves of 1."""
        values = self.reward.numbers.list_values(node)
        return bool(values.size and (values == values[0]).all() and values[0] >= 0)

    def _is_defined_so(self, place: ReadExpression, seen: set[tuple[object, str]]) -> bool:
        text = ast.unparse(place.node)
        if isinstance(place.node, ast.Call):
            found = self.definitions.list_returned(place)
            return bool(found) and all(self._is_never_negative(one, seen) for one in found)
        if isinstance(place.node, ast.Name) and not self.definitions.list_assigned(place.function).get(text):
            given = place.arguments.get(text)
            return given is not None and self._is_never_negative(given, seen)
        inside = [place.function] if isinstance(place.node, ast.Name) else self.definitions.called
        assigned = [one for function in inside for one in self.definitions.list_assigned(function).get(text, ())]
        seen = seen | {(one.function, text) for one in assigned}
        return bool(assigned) and all(self._is_assigned_so(one, place, text, seen) for one in assigned)

    def _is_assigned_so(self, one: Assignment, place: ReadExpression, text: str, seen: set[tuple[object, str]]) -> bool:
        if not one.is_known:
            return False
        arguments = place.arguments if one.function is place.function else {}
        for value, sign in one.parts:
            here = ReadExpression(value, one.function, arguments, place.depth + 1)
            parts = [self._read_filtered(here, text)] if one.added else self.definitions.select(here, one.element)
            if sign < 0 or not parts or not all(self._is_never_negative(part, seen) for part in parts):
                return False
        return True

    def _read_filtered(self, place: ReadExpression, text: str) -> ReadExpression:
        """Return x of `y += share * (x - y)`; the value itself where it is not of this form."""
        for factor in list_product(place.node):
            match factor:
                case ast.BinOp(left=left, op=ast.Sub(), right=right) if ast.unparse(right) == text:
                    return place.at(left)
        return place

    def find_always_met(self) -> Iterator[AlwaysMet]:
        """Yield kernels of a difference to a command whose tolerance is far above all differences."""
        for summand in self.reward.summands:
            for factor in list_product(summand.place.node):
                place = summand.place.at(factor)
                values = self.reward.numbers.list_values(factor)
                if values.size < FEWEST or values.min() < MET or values.max() > 1 + 1e-9 or not np.ptp(values) > 0:
                    continue
                for one, wanted, _ in self._list_differences(place):
                    if self._is_drawn(one, wanted):
                        yield AlwaysMet(summand, place, one.node, float(values.min()))

    def _is_drawn(self, difference: ReadExpression, wanted: ReadExpression) -> bool:
        """Say whether a command differs between episodes as much as the difference to it, and is kept in them."""
        differences, commands = (self.reward.numbers.list_values(one.node) for one in (difference, wanted))
        if differences.size < FEWEST:
            return False
        is_apart = np.ptp(commands) > CLEARLY * float(np.abs(differences).max())
        return bool(is_apart and self._is_kept(wanted.node))

    def _is_kept(self, node: ast.expr) -> bool:
        """Say whether a value stays the same in most steps."""
        noted = self.notes.source.find(node)
        changes = [
            not np.array_equal(before, after)
            for episode in self.notes.episodes
            for before, after in itertools.pairwise(_list_last(episode[1:], noted.number) if noted is not None else ())
        ]
        return bool(changes) and bool(np.mean(changes) <= MOST_CHANGES)


def _list_last(calls: Sequence[NotedCall], number: int) -> list[Numbers]:
    values = [call.values[number][-1] if call.values.get(number) else None for call in calls]
    return [np.asarray(value, np.float64) for value in values if value is not None]
