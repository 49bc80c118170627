"""Successes that measure how far the hand is from the goal, and not the object that it has to bring there."""

import ast
import dataclasses
from collections.abc import Iterable, Iterator

from rlctl.checking.assignments import read_name
from rlctl.checking.definitions import ReadExpression
from rlctl.checking.experiments.expressions import NotedEpisodes
from rlctl.checking.goal_distances import OBJECT_WORDS, TARGET_WORDS
from rlctl.checking.paid_goals import AVOIDED_WORDS
from rlctl.checking.success_tests import SuccessTests
from rlctl.checking.term_names import split_name

Pair = frozenset[str]  # the names of two places whose difference is taken


@dataclasses.dataclass(frozen=True)
class ExchangedObject:
    """What a success compares with the goal, and what it should compare with it."""

    place: ReadExpression  # of the difference
    goal: str
    hand: str
    thing: str


class ObjectReader:
    """Finds them."""

    def __init__(self, notes: NotedEpisodes) -> None:
        self.notes, self.definitions = notes, notes.reward.definitions
        self.tests = notes.share(SuccessTests).tests

    def find(self) -> Iterator[ExchangedObject]:
        """Yield differences of the goal and a hand in a success, where the reward pays the way from the hand to an
        object, and a step also computes that of the object to the goal, which the success does not read."""
        of_success = {pair: place for place, pair in self._list_pairs(self.tests)}
        paid = {pair for _, pair in self._list_pairs(one.place for one in self.notes.reward.summands)}
        of_steps = {
            _read_pair(one.node) for one in self.notes.source.expressions if one.function in self.notes.of_steps
        }
        for pair, place in of_success.items():
            goals = [name for name in pair if {*split_name(name)} & TARGET_WORDS]
            if len(goals) != 1:
                continue
            (goal,), (hand,) = goals, pair - {*goals}
            for thing in sorted({name for one in paid if hand in one for name in one - {hand, goal}}):
                words = {*split_name(thing)}
                is_object = bool(words & OBJECT_WORDS) and not words & AVOIDED_WORDS
                way = frozenset({goal, thing})
                if is_object and not {*split_name(hand)} & OBJECT_WORDS and way in of_steps and way not in of_success:
                    yield ExchangedObject(place, goal, hand, thing)

    def _list_pairs(self, places: Iterable[ReadExpression]) -> Iterator[tuple[ReadExpression, Pair]]:
        for top in places:
            for place in self.definitions.walk(top):
                if (pair := _read_pair(place.node)) is not None:
                    yield place, pair


def _read_pair(node: ast.expr) -> Pair | None:
    """Return the names of both sides of a difference; of a sum, such as a place above an object, that of the first."""
    match node:
        case ast.BinOp(left=left, op=ast.Sub(), right=right):
            sides = [side.left if isinstance(side, ast.BinOp) else side for side in (left, right)]
            pair = frozenset(read_name(side) for side in sides)
            return pair if len(pair) == 2 and "" not in pair else None
    return None
