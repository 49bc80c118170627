"""What a reward pays although it should cost: sizes of actions and of what is unwanted, and failures."""

import ast
import dataclasses
from collections.abc import Iterator

import numpy as np

from rlctl.checking.assignments import list_name_words, read_name
from rlctl.checking.definitions import ReadExpression
from rlctl.checking.experiments.expressions import NotedEpisodes
from rlctl.checking.paid_errors import EARLIER_WORDS, FEWEST, SIZES, read_summed
from rlctl.checking.paid_goals import read_joined
from rlctl.checking.products import list_product
from rlctl.checking.summands import REWARD_NAMES, Summand
from rlctl.checking.term_names import (
    ACTION_WORDS,
    CHANGE_WORDS,
    COST_WORDS,
    ENERGY_WORDS,
    OPPOSITE_WORDS,
    split_name,
)

UNWANTED_WORDS = {
    "asymmetry", "bounce", "bouncing", "deviation", "drift", "err", "error", "imbalance", "lean", "misalignment",
    "offset", "shake", "skew", "slam", "slant", "slip", "slipping", "spill", "sway", "tilt", "uneven", "vibration",
    "wobble",
}  # fmt: skip
COSTLY_WORDS = UNWANTED_WORDS | ACTION_WORDS | CHANGE_WORDS | COST_WORDS | ENERGY_WORDS
FAILURE_WORDS = {
    "collided", "crash", "crashed", "failed", "failure", "fall", "fallen", "fell", "lost", "tipped", "toppled",
}  # fmt: skip
MEANT_WORDS = (OPPOSITE_WORDS - {"exp"}) | {
    "ahead", "along", "enemy", "forward", "gain", "height", "not", "opponent", "potential", "up", "upright", "upward",
}  # fmt: skip
"""With which a size, or a failure, may be wanted."""
FALLING = {"exp", "tanh", "cos", "closeness", "tolerance", "arrival", "near_limits"}
MINIMA = {"min", "minimum", "fmin"}
PLAIN_SIZES = SIZES - {"distance", "dist", "arccos", "acos"}
DEEPEST = 6


@dataclasses.dataclass(frozen=True, eq=False)
class PaidCost:
    """A summand that pays."""

    summand: Summand
    place: ReadExpression
    why: str

    @property
    def is_of_error(self) -> bool:
        """Whether it is the size of a difference: what is far from where it should be."""
        return any(isinstance(node, ast.BinOp) and isinstance(node.op, ast.Sub) for node in ast.walk(self.place.node))


class CostReader:
    """Finds them."""

    def __init__(self, notes: NotedEpisodes) -> None:
        self.notes, self.reward, self.definitions = notes, notes.reward, notes.reward.definitions

    def find(self) -> Iterator[PaidCost]:
        """Yield sizes and failures that are paid, and limits of which a cost has the wrong side."""
        for summand in self.reward.summands:
            if summand.weight > 0 and not self._is_taken_away(summand):
                core = self._find_size(self.definitions.resolve(summand.place))
                if core is not None and self._is_unwanted(summand, core):
                    yield PaidCost(summand, core, "is a size that is never negative, and is paid")
                elif self._is_failure(summand):
                    yield PaidCost(summand, summand.place, "is paid where the robot fails")
            elif summand.weight < 0 and self._is_below_limit(self.definitions.resolve(summand.place)):
                yield PaidCost(summand, summand.place, "is never above 0, and is subtracted")

    def _is_taken_away(self, summand: Summand) -> bool:
        """Say whether it is what something was before, or the same is subtracted: that is progress."""
        text = ast.unparse(self.definitions.resolve(summand.place).node)
        costs = [one for one in self.reward.summands if one.weight < 0]
        is_same = any(ast.unparse(self.definitions.resolve(one.place).node) == text for one in costs)
        return is_same or bool(self._list_words(summand) & EARLIER_WORDS)

    def _list_values(self, place: ReadExpression) -> np.ndarray:
        return self.reward.numbers.list_values(place.node)

    def _find_size(self, place: ReadExpression, depth: int = 0) -> ReadExpression | None:
        """Return the size of a number, or the sum of sizes or of numbers that are never negative."""
        if depth > DEEPEST:
            return None
        for factor in list_product(place.node):
            one = self.definitions.resolve(place.at(factor))
            match one.node:
                case ast.BinOp(left=base, op=ast.Pow(), right=ast.Constant(value=int(power))) if power % 2 == 0:
                    return None if self._falls(one.at(base)) else one
                case ast.BinOp(left=left, op=ast.Mult() | ast.MatMult(), right=right) if ast.dump(left) == ast.dump(
                    right
                ):
                    return None if self._falls(one.at(left)) else one
                case ast.Call(func=function) if read_name(function) in PLAIN_SIZES:
                    return None if self._falls(one) else one
            if (summed := read_summed(one.node)) is not None:
                inner = self.definitions.resolve(one.at(summed))
                values = self._list_values(one)
                is_size = values.size >= FEWEST and bool(values.min() >= 0)
                is_plain = not isinstance(inner.node, ast.BinOp) or isinstance(inner.node.op, ast.Mult)
                found = self._find_size(inner, depth + 1)
                return found if found is not None or not is_size or not is_plain or self._falls(inner) else one
        return None

    def _falls(self, place: ReadExpression) -> bool:
        """Say whether a function that falls with what it is given is inside, such as an exponential or 1 - x."""
        for one in self.definitions.walk(place):
            match one.node:
                case ast.Call(func=function) if read_name(function) in FALLING:
                    return True
                case ast.BinOp(left=left, op=ast.Sub()) if self.reward.numbers.read_constant(left) is not None:
                    return True
                case ast.BinOp(op=ast.Div(), right=right):
                    values = self.reward.numbers.list_values(right)
                    if values.size and float(np.ptp(values)) > 0:
                        return True
        return False

    def _is_unwanted(self, summand: Summand, core: ReadExpression) -> bool:
        """Say whether a size is that of an action or of an error by its names, or has the weight of a cost."""
        values = self._list_values(summand.place)
        if values.size < FEWEST or values.min() < 0 or not np.ptp(values) > 0:
            return False
        words = self._list_words(summand) | list_name_words(core.node)
        has_weight = self.reward.weights.get(summand.name, 0.0) < 0
        return has_weight or bool(words & COSTLY_WORDS and not words & MEANT_WORDS)

    def _list_words(self, summand: Summand) -> set[str]:
        return {word for name in (summand.name, *summand.names) for word in split_name(name)} - REWARD_NAMES

    def _is_failure(self, summand: Summand) -> bool:
        """Say whether it is a flag that is called after a failure, or a constant that counts where one is true."""
        values = self._list_values(summand.place)
        constant = self.reward.numbers.read_constant(summand.place.node)
        if constant is not None:
            tests = [test for test, is_true in summand.conditions if is_true]
            tests += [part for test in tests for part in read_joined(test)]
            named = any(isinstance(test, ast.Name) and _is_named_failure(test.id) for test in tests)
            return constant > 0 and named
        is_flag = bool(values.size) and set(values.tolist()) <= {0.0, 1.0}
        words = self._list_words(summand)
        is_meant = isinstance(summand.place.node, ast.UnaryOp) or bool(words & MEANT_WORDS)
        return is_flag and bool(words & FAILURE_WORDS) and not is_meant

    def _is_below_limit(self, place: ReadExpression) -> bool:
        match place.node:
            case ast.Call(func=function, args=[one, other]) if read_name(function) in MINIMA:
                limits = [self.reward.numbers.read_constant(side) for side in (one, other)]
                values = self._list_values(place)
                return 0.0 in limits and values.size >= FEWEST and bool(values.max() <= 0) and float(np.ptp(values)) > 0
        return False


def _is_named_failure(name: str) -> bool:
    words = {*split_name(name)}
    return bool(words & FAILURE_WORDS) and not words & MEANT_WORDS
