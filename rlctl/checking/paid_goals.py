"""How the source of a reward pays for distances, progress, and success."""

import ast
import dataclasses
import enum
import functools
import math
from collections.abc import Iterator, Sequence

import numpy as np

from rlctl.checking.assignments import list_name_words, read_name
from rlctl.checking.definitions import ReadExpression
from rlctl.checking.experiments.expressions import NotedEpisodes
from rlctl.checking.paid_errors import EARLIER_WORDS, FEWEST, WANTED_WORDS, ErrorReader, read_summed
from rlctl.checking.summands import SUMS, Summand
from rlctl.checking.term_names import COST_WORDS, is_about_time, split_name

AVOIDED_WORDS = {
    "agent", "avoid", "avoidance", "barrier", "border", "boundary", "bounds", "clearance", "cliff", "collision",
    "crash", "danger", "edge", "enemy", "escape", "evader", "flee", "forbidden", "hazard", "hazards", "home", "human",
    "initial", "keepout", "laser", "lidar", "limit", "limits", "margin", "neighbor", "neighbour", "obstacle",
    "obstacles", "opponent", "origin", "others", "pedestrian", "people", "person", "pursuer", "range", "ray", "rays",
    "repel", "repulsion", "repulsive", "safe", "safety", "scan", "separation", "singularity", "sonar", "spawn",
    "spread", "start", "sun", "threat", "traveled", "travelled", "unsafe", "wall", "walls",
}  # fmt: skip
"""What a robot keeps away from, or is paid to leave."""
NEAR_WORDS = {
    "align", "alignment", "approach", "close", "closeness", "near", "proximity", "reach", "reaching", "track",
    "tracking",
}  # fmt: skip
ALIGNED_WORDS, UPRIGHT_WORDS = {"align", "aligned", "alignment", "facing"}, {"up", "upright", "uprightness"}
UPRIGHT = 0.9  # cosine at the start
DISTANCES = {"norm", "hypot", "dist", "distance", "sqrt"}
KERNELS = {"exp", "closeness", "arrival"}
SUCCESS_KEYS = {"is_success", "success"}


class WrongSign(enum.StrEnum):
    """How the sign of a summand is wrong."""

    NEARNESS_COSTS = "nearness costs"
    ALIGNMENT_COSTS = "a cosine that is 1 where all is aligned costs"
    LEAVING_PAYS = "leaving pays"


@dataclasses.dataclass(frozen=True, eq=False)
class PaidDistance:
    """A summand that costs for being near a goal, or pays for going away from it."""

    how: WrongSign
    summand: Summand
    place: ReadExpression


class GoalReader:
    """Reads what the reward pays near a goal, and for success."""

    def __init__(self, notes: NotedEpisodes) -> None:
        self.notes, self.reward = notes, notes.reward
        self.errors = notes.share(ErrorReader)
        self.definitions = notes.reward.definitions

    def find_wrong_signs(self) -> Iterator[PaidDistance]:
        """Yield them; what rises with a distance is found by playing, in `paid_distances`."""
        for summand in self.reward.summands:
            if self._is_avoided(summand):
                continue
            if summand.weight < 0 and self._is_nearness(summand.place):
                words = self._list_words(summand)
                if words & (NEAR_WORDS | WANTED_WORDS):
                    yield PaidDistance(WrongSign.NEARNESS_COSTS, summand, summand.place)
            elif summand.weight < 0 and self._is_alignment(summand):
                yield PaidDistance(WrongSign.ALIGNMENT_COSTS, summand, summand.place)
        for summand in self.reward.differences:
            if not self._is_avoided(summand) and self._pays_leaving(summand):
                yield PaidDistance(WrongSign.LEAVING_PAYS, summand, summand.place)

    def _list_words(self, summand: Summand) -> set[str]:
        words = set(split_name(summand.name))
        for one in self.definitions.walk(summand.place):
            words |= set(split_name(read_name(one.node))) - KERNELS
        return words

    def _is_avoided(self, summand: Summand) -> bool:
        return bool(self._list_words(summand) & AVOIDED_WORDS) or math.isnan(summand.weight)

    def _is_nearness(self, place: ReadExpression) -> bool:
        """Say whether an expression is a function that falls with the distance of two things, or a sum of some."""
        resolved = self.definitions.resolve(place)
        match resolved.node:
            case ast.BinOp(left=left, op=ast.Mult(), right=right):
                constants = [self.reward.numbers.read_constant(side) for side in (left, right)]
                others = [side for side, number in zip((left, right), constants, strict=True) if number is None]
                return len(others) == 1 and self._is_nearness(resolved.at(others[0]))
            case ast.Call(func=function, args=[argument, *_]) if read_name(function) in KERNELS:
                values = self.reward.numbers.list_values(resolved.node)
                is_kernel = values.size >= FEWEST and values.min() >= 0 and values.max() <= 1 + 1e-9
                return is_kernel and any(map(self._is_distance, self.definitions.walk(resolved.at(argument))))
            case ast.Call(func=function) if read_name(function) in SUMS:
                summed = read_summed(resolved.node)
                return summed is not None and self._is_nearness(resolved.at(summed))
        return False

    def _is_alignment(self, summand: Summand) -> bool:
        """Say whether it is a cosine that is called after what it is large for: an alignment, or standing upright."""
        names = {word for name in (summand.name, *summand.names) for word in split_name(name)}
        place = self.definitions.resolve(summand.place)
        values = self.reward.numbers.list_values(place.node)
        if values.size < FEWEST or np.abs(values).max() > 1 + 1e-6 or not float(np.ptp(values)) > 0:
            return False
        is_cosine = self.errors.is_cosine(place) and not isinstance(summand.place.node, ast.BinOp)
        is_angle = isinstance(place.node, ast.Call) and read_name(place.node.func) == "cos"
        is_upright = bool(names & UPRIGHT_WORDS) and not is_angle and values[0] > UPRIGHT
        is_named = bool(names & ALIGNED_WORDS) or is_upright
        return is_cosine and is_named and not names & COST_WORDS and not self.is_of_progress(summand)

    def is_of_progress(self, summand: Summand) -> bool:
        """Say whether another summand takes away what this one was a step before."""
        if any(summand.place.node in list(ast.walk(one.place.node)) for one in self.reward.differences):
            return True
        others = [one for one in self.reward.summands if one.weight * summand.weight < 0]
        if set(split_name(summand.name)) & EARLIER_WORDS or any(one.place.node is summand.place.node for one in others):
            return True
        return any(set(split_name(one.name)) & EARLIER_WORDS or self._is_earlier(one.place) for one in others)

    def _is_earlier(self, place: ReadExpression) -> bool:
        return bool(list_name_words(place.node) & EARLIER_WORDS)

    def _pays_leaving(self, summand: Summand) -> bool:
        """Say whether it is what a distance is now, less what it was before, and is paid."""
        match summand.place.node:
            case ast.BinOp(left=left, op=ast.Sub(), right=right):
                earlier = [self._is_earlier(summand.place.at(side)) for side in (left, right)]
            case _:
                return False
        if sum(earlier) != 1 or not self.errors.is_between_steps(summand.place):
            return False
        new, sign = (left, 1.0) if earlier[1] else (right, -1.0)
        if summand.weight * sign <= 0:
            return False
        values = self.reward.numbers.list_values(new)
        return values.size >= FEWEST and values.min() >= 0 and self._is_distance(summand.place.at(new))

    def _is_distance(self, place: ReadExpression) -> bool:
        """Say whether it is a distance between two things."""
        resolved = self.definitions.resolve(place)
        match resolved.node:
            case ast.Call(func=function, args=[only, *_]) if read_name(function) == "norm":
                inner = self.definitions.resolve(resolved.at(only)).node
                is_difference = isinstance(inner, ast.BinOp) and isinstance(inner.op, ast.Sub)
                return is_difference or bool(set(split_name(read_name(only))) & (WANTED_WORDS | {"to", "error"}))
            case ast.Call(func=function, args=[_, _, *_]) if read_name(function) in DISTANCES:
                return True
        return False

    def read_success(self) -> ReadExpression | None:
        """Return the expression that tells success."""
        step = self.definitions.find_function("step")
        for node in ast.walk(step) if step is not None else ():
            assert step is not None
            match node:
                case ast.Dict(keys=keys, values=values):
                    for key, value in zip(keys, values, strict=True):
                        if isinstance(key, ast.Constant) and key.value in SUCCESS_KEYS:
                            return self.resolve_flag(ReadExpression(value, step, {}))
                case ast.Assign(targets=[ast.Subscript(slice=ast.Constant(value=key))], value=value):
                    if key in SUCCESS_KEYS:
                        return self.resolve_flag(ReadExpression(value, step, {}))
        returned = self.definitions.list_results(self.definitions.find_function("is_success"))
        return self.resolve_flag(returned[0]) if returned else None

    def resolve_flag(self, place: ReadExpression) -> ReadExpression:
        """Follow names, calls and conversions to what a flag is computed by."""
        while True:
            match place.node:
                case ast.Call(func=ast.Name(id="bool" | "float" | "int"), args=[only]):
                    place = place.at(only)
                case _:
                    found = self.definitions.follow(place)
                    if len(found) != 1:
                        return place
                    place = found[0]

    def is_success(self, test: ast.expr, place: ReadExpression) -> bool:
        """Say whether a test asks for success."""
        asked = self.resolve_flag(place.at(test)).node
        return any(asked is part.node for part in self.success_parts)

    @functools.cached_property
    def success_parts(self) -> Sequence[ReadExpression]:
        """What tells success, and what all has to be true for it."""
        success = self.read_success()
        parts = [success] if success is not None else []
        for part in parts:
            parts += [self.resolve_flag(part.at(one)) for one in read_joined(part.node)]
        return parts

    def ends_at_success(self) -> bool:
        """Say whether a success is a part of what `terminated` is."""
        success, step = self.read_success(), self.definitions.find_function("step")
        if success is None or step is None:
            return False
        flags = [
            returned.at(returned.node.elts[2])
            for returned in self.definitions.list_results(step)
            if isinstance(returned.node, ast.Tuple) and len(returned.node.elts) == 5
        ]
        flags += self.definitions.list_results(self.definitions.find_function("is_terminated"))
        return any(self._has_success(flag, success) for flag in flags)

    def _has_success(self, flag: ReadExpression, success: ReadExpression) -> bool:
        for place in self.definitions.walk(flag):
            if any(place.node is part.node for part in self.success_parts):
                return True
            for one in self.definitions.list_before(place) if isinstance(place.node, ast.Name) else ():
                # `if success: terminated = True`
                parent = self.notes.source.parents.get(one.statement)
                is_set = isinstance(one.value, ast.Constant) and one.value.value is True
                if is_set and isinstance(parent, ast.If) and self.is_success(parent.test, place.at(parent.test)):
                    return True
        return False

    def read_income(self) -> float:
        """Return what each step pays near the goal at least, as far as it can be seen; NaN if it cannot."""
        total = 0.0
        for summand in self.reward.summands:
            if summand.conditions or summand.replaces:
                continue
            if math.isnan(summand.weight):
                return math.nan
            total += summand.weight * self._read_at_goal(summand)
        return total

    def _read_at_goal(self, summand: Summand) -> float:
        """Return what a summand is worth at the goal: the most for a cost, and the least otherwise."""
        resolved = self.definitions.resolve(summand.place)
        number = self.reward.numbers.read_constant(resolved.node)
        if number is not None:
            return number
        values = self.reward.numbers.list_values(resolved.node)
        is_kernel = isinstance(resolved.node, ast.Call) and read_name(resolved.node.func) in KERNELS - {"arrival"}
        if is_kernel and values.size and values.max() <= 1 + 1e-9:
            return 1.0
        if isinstance(resolved.node, ast.Call) and read_name(resolved.node.func) == "max" and summand.weight > 0:
            return 0.0
        if summand.weight < 0 and values.size and values.min() >= 0:
            is_size = {"norm", "abs", "arccos", "acos", "tanh", "sqrt", "hypot", "distance", "sum", "squared", "square"}
            is_small = isinstance(resolved.node, ast.Call) and read_name(resolved.node.func) in is_size
            is_power = isinstance(resolved.node, ast.BinOp) and isinstance(resolved.node.op, ast.Pow)
            return 0.0 if is_small or is_power else float(values.min())
        return 0.0

    def pays_for_time(self) -> bool:
        """Say whether a constant that is called after time is added in each step."""
        return any(
            one.weight * (self.reward.numbers.read_constant(one.place.node) or 0.0) > 0
            for one in self.reward.summands
            if is_about_time(one.name) and not one.conditions
        )

    def read_bonus(self) -> float | None:
        """Return what a success pays at once; None where nothing depends on it."""
        paid = [one for one in self.reward.summands if self._is_of_success(one)]
        total = 0.0
        for one in paid:
            number = self.reward.numbers.read_constant(one.place.node)
            number = 1.0 if number is None and self.is_success(one.place.node, one.place) else number
            if number is None or math.isnan(one.weight):
                return None
            total += one.weight * number
        return total if paid else None

    def _is_of_success(self, summand: Summand) -> bool:
        if any(is_true and self.is_success(test, summand.place) for test, is_true in summand.conditions):
            return True
        return self.is_success(summand.place.node, summand.place)

    def find_replaced(self) -> Iterator[tuple[Summand, float, float]]:
        """Yield numbers that replace the reward on success, with what they are, if steps before it may pay more."""
        income = self.read_income()
        for one in self.reward.summands:
            number = self.reward.numbers.read_constant(one.place.node)
            if one.replaces and number is not None and self._is_of_success(one) and one.weight * number < income:
                yield one, one.weight * number, income


def read_joined(node: ast.expr, is_either: bool = False) -> list[ast.expr]:
    """Return what all has to be true, or of which one is enough; nothing for other expressions."""
    bits, words = (ast.BitOr, "logical_or") if is_either else (ast.BitAnd, "logical_and")
    match node:
        case ast.BoolOp(op=operator, values=values) if isinstance(operator, ast.Or if is_either else ast.And):
            return values
        case ast.BinOp(left=left, op=operator, right=right) if isinstance(operator, bits):
            return [left, right]
        case ast.Call(func=ast.Attribute(attr=name), args=[left, right]) if name == words:
            return [left, right]
    return []
