"""Costs of a reward that are a number with its sign, such as the sine of a tilt: half of the time they pay."""

import ast
from collections.abc import Iterator

import numpy as np

from rlctl.checking.assignments import list_name_words, read_name
from rlctl.checking.definitions import ReadExpression
from rlctl.checking.experiments.expressions import NotedEpisodes
from rlctl.checking.paid_errors import CLEAR, EARLIER_WORDS, FEWEST, ErrorReader, has_both_signs
from rlctl.checking.summands import REWARD_NAMES, Summand
from rlctl.checking.term_names import COST_WORDS, OPPOSITE_WORDS, split_name

SMALL_WORDS = COST_WORDS | {
    "across", "attitude", "balance", "bank", "bearing", "center", "centering", "centre", "cross", "crosstrack", "cte",
    "asymmetry", "deviation", "drift", "err", "error", "heading", "imbalance", "lateral", "lean", "level",
    "misalignment", "off", "offset", "pitch", "posture", "roll", "side", "sideways", "skew", "slant", "straight",
    "sway", "swing", "tilt", "turn", "turned", "twist", "unbalanced", "unequal", "uneven", "upright", "wobble", "yaw",
}  # fmt: skip
"""What a cost is named after that should be 0."""
MEANT_WORDS = (OPPOSITE_WORDS - {"exp"}) | {
    "ahead", "along", "cos", "energy", "forward", "gain", "height", "potential", "power", "torque", "up", "upward",
    "work", "dot", "advantage",
}  # fmt: skip
"""Numbers whose signs are meant."""
SINES = {"sin", "arcsin", "asin", "arctan2", "atan2"}
DEEPEST = 6
AT_START = 0.5  # part of the largest size: what is small and has both signs does not begin with one of them, and large


class SignedCostReader:
    """Finds them."""

    def __init__(self, notes: NotedEpisodes) -> None:
        self.notes, self.reward = notes, notes.reward
        self.errors = notes.share(ErrorReader)
        self.definitions = self.reward.definitions

    def find(self) -> Iterator[tuple[Summand, ReadExpression]]:
        """Yield the summand, and what it is."""
        for summand in (*self.reward.summands, *self.reward.differences):
            if summand.weight < 0 and not _is_beyond(summand):
                hops = self._list_hops(summand.place)
                if self._has_both_signs(summand.place) and self._should_be_small(summand, hops) and self._is_one(hops):
                    yield summand, hops[-1]

    def _list_hops(self, place: ReadExpression) -> list[ReadExpression]:
        """Return what a summand stands for, one after the other."""
        hops = [place]
        while len(hops) < DEEPEST:
            found = self.definitions.follow(hops[-1])
            if len(found) != 1:
                break
            hops.append(found[0])
        return hops

    def _has_both_signs(self, place: ReadExpression) -> bool:
        values = self.reward.numbers.list_values(place.node)
        if values.size < FEWEST or not has_both_signs(values, CLEAR):
            return False
        low, high = float(-values.min()), float(values.max())
        noted = self.notes.source.find(place.node)
        assert noted is not None
        first = [
            np.ravel(value)
            for episode in self.notes.episodes
            for value in (episode[1].values.get(noted.number, ()) if len(episode) > 1 else ())
            if value is not None
        ]
        begins = np.concatenate(first) if first else np.zeros(1)
        is_meant = abs(float(np.sign(begins).sum())) == begins.size and np.abs(begins).min() > AT_START * max(low, high)
        return min(low, high) > CLEAR * max(low, high) and not is_meant

    def _should_be_small(self, summand: Summand, hops: list[ReadExpression]) -> bool:
        """Say whether it is named so, or whether the source takes its size elsewhere."""
        words = {word for name in (summand.name, *summand.names) for word in split_name(name)} - REWARD_NAMES
        words = words.union(*(list_name_words(hop.node) for hop in hops))
        if words & (MEANT_WORDS | EARLIER_WORDS):
            return False
        arguments = [
            ast.unparse(hop.node.args[0])
            for hop in hops
            if isinstance(hop.node, ast.Call) and read_name(hop.node.func) in SINES and hop.node.args
        ]
        return bool(words & SMALL_WORDS) or any(self.errors.is_sized(text) for text in arguments)

    def _is_one(self, hops: list[ReadExpression]) -> bool:
        """Say whether it is one number, or the difference of two of an array, and neither a product nor a change."""
        last = hops[-1]
        differences = [hop for hop in hops if isinstance(hop.node, ast.BinOp) and isinstance(hop.node.op, ast.Sub)]
        if any(map(self.errors.is_between_steps, differences)):
            return False
        match last.node:
            case ast.Call(func=function):
                return read_name(function) not in ("cos", "sum", "mean", "dot", "vdot", "einsum", "cross", "max", "min")
            case ast.BinOp(op=ast.Mod()):
                return True
            case ast.BinOp(left=ast.Subscript(value=one), op=ast.Sub(), right=ast.Subscript(value=other)):
                return ast.unparse(one) == ast.unparse(other)
            case ast.BinOp(left=left, op=ast.Sub() | ast.Add()):
                # (a - b + pi) % (2 * pi) - pi
                return isinstance(left, ast.BinOp) and isinstance(left.op, ast.Mod)
            case ast.Name() | ast.Attribute() | ast.Subscript():
                return True
        return False


def _is_beyond(summand: Summand) -> bool:
    """Say whether it counts on one side of a limit only: `if roll > limit: cost += roll - limit`."""
    compared = [node for test, _ in summand.conditions for node in ast.walk(test) if isinstance(node, ast.Compare)]
    sides = {ast.unparse(side) for node in compared for side in (node.left, *node.comparators)}
    parts = [node for node in ast.iter_child_nodes(summand.place.node) if isinstance(node, ast.expr)]
    own = {*summand.names, *(ast.unparse(node) for node in (summand.place.node, *parts))}
    return bool(own & sides)
