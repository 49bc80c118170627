"""Where a success pays less than steps that lack only a part of it: both are played, and the goal is near in both."""

import ast
import dataclasses
import math
from collections.abc import Iterator, Mapping

import numpy as np

from rlctl.checking.assignments import list_name_words
from rlctl.checking.definitions import ReadExpression
from rlctl.checking.experiments.expressions import NotedEpisodes
from rlctl.checking.forced_rewards import ForcedRewards
from rlctl.checking.goal_distances import DistanceReader
from rlctl.checking.paid_goals import GoalReader
from rlctl.checking.previous_values import PREVIOUS_WORDS

PARTS = (0.03, 0.06, 0.12, 0.25)  # of the largest distance to the goal that was noted
EPISODES = (0, 3)  # that are played again
NEAR_PARTS = PARTS[:3]
LASTING = 2  # steps at one distance, in which there is no progress
CLEARLY, LEAST = 0.02, 1e-6  # part of the rewards, by which success pays less
MOST_FLAGS = 5
Flags = dict[int, bool]


@dataclasses.dataclass(frozen=True, eq=False)
class LowSuccess:
    """What a success pays, and what a step pays before it."""

    place: ReadExpression  # of what tells success
    paid: ReadExpression  # of what is paid for it
    success: float
    before: float
    lacks: str  # what is not true before it, besides success; may be empty


class SuccessReader:
    """Compares them."""

    def __init__(self, notes: NotedEpisodes) -> None:
        self.notes, self.goals, self.definitions = notes, notes.share(GoalReader), notes.definitions
        self.forced = ForcedRewards(notes)
        self.distances = {one.expression.number: one.largest for one in notes.share(DistanceReader).distances}

    def find(self) -> LowSuccess | None:
        """Return a success that pays less in each episode that is looked at."""
        place = self.goals.read_success()
        number = self._find_number(place) if place is not None else None
        if place is None or number is None or not self._decides(place):
            return None
        found: LowSuccess | None = None
        for episode in EPISODES:
            found = self._compare(episode, place)
            if found is None:
                break
        return found

    def read_incomes(self) -> tuple[float, float] | None:
        """Return what a step next to the goal pays, with all that is paid for besides success, and what a success pays.

        None where this cannot be played, or success does not change the reward.
        """
        place = self.goals.read_success()
        if place is None or not self.distances or self._find_number(place) is None or not self._decides(place):
            return None
        found = [one for episode in EPISODES if (one := self._read_incomes(episode, place)) is not None]
        return min(found, key=lambda one: one[0]) if found else None

    def _read_incomes(self, episode: int, place: ReadExpression) -> tuple[float, float] | None:
        last = self.forced.find_last(episode)
        if last is None:
            return None
        success = dict.fromkeys(self._list_same(place), True)
        met = {number: value for _, one in self._list_flags() for number, value in one.items()}
        kept = self._list_paid_flags() | met | dict.fromkeys(success, False)
        nearest = {number: PARTS[0] * largest for number, largest in self.distances.items()}
        paid = self._pay(episode, last, nearest | kept, success)
        staying = []
        for part in NEAR_PARTS:
            near = {number: part * largest for number, largest in self.distances.items()}
            if not self._succeeds(episode, last, near, place):
                staying.append(self._pay(episode, last, near | kept, {}))  # for a change of a flag nothing is paid then
        return (min(staying), paid) if staying and math.isfinite(paid) else None  # the least: others may pay once

    def _list_paid_flags(self) -> Flags:
        """Return the flags that last, such as a grasp, for which the reward pays besides success; and what they are."""
        found: Flags = {}
        for summand in self.goals.reward.summands:
            for test, is_true in ((summand.place.node, True), *summand.conditions) if summand.weight > 0 else ():
                flag = self.goals.resolve_flag(summand.place.at(test))
                if self._lasts(flag) and not self.goals.is_success(test, summand.place):
                    found |= dict.fromkeys(self._list_same(flag), is_true)
        return found

    def _lasts(self, flag: ReadExpression) -> bool:
        """Say whether it is a flag that neither a distance nor a change tells."""
        if isinstance(flag.node, ast.BoolOp) or self.notes.source.find(flag.node) is None:
            return False
        parts = [place.node for place in self.definitions.walk(flag)]
        numbers = {one.number for node in parts if (one := self.notes.source.find(node)) is not None}
        is_of_change = any(list_name_words(node) & PREVIOUS_WORDS for node in parts)
        values = self.goals.reward.numbers.list_values(flag.node)
        return bool(values.size) and set(values) <= {0.0, 1.0} and not (numbers & self.distances.keys() or is_of_change)

    def _decides(self, place: ReadExpression) -> bool:
        """Say whether the reward is another one where success is told otherwise."""
        last = self.forced.find_last(EPISODES[0])
        if last is None:
            return False
        paid = [self._pay(EPISODES[0], last, {}, dict.fromkeys(self._list_same(place), told)) for told in (False, True)]
        return all(map(math.isfinite, paid)) and paid[0] != paid[1]

    def _find_number(self, place: ReadExpression) -> int | None:
        one = self.notes.source.find(place.node)
        return one.number if one is not None else None

    def _find_paid(self, place: ReadExpression) -> ReadExpression:
        for one in self.goals.reward.summands:
            if any(is_true and self.goals.is_success(test, one.place) for test, is_true in one.conditions):
                return one.place
        return place

    def _list_same(self, place: ReadExpression) -> list[int]:
        """Return the numbers of an expression, wherever it is written in its function."""
        text = ast.unparse(place.node)
        return [
            one.number
            for one in self.notes.source.expressions
            if one.function is place.function and one.node.lineno >= place.node.lineno and one.text == text
        ]

    def _list_flags(self) -> list[tuple[str, Flags]]:
        """Return what is true of a success besides distances, each with its expressions and what these are then."""
        flags: list[tuple[str, Flags]] = []
        for part in self.goals.success_parts[1:]:
            inner, is_met, found = part, True, dict.fromkeys(self._list_same(part), True)
            while isinstance(inner.node, ast.UnaryOp) and isinstance(inner.node.op, ast.Not):
                is_met = not is_met
                inner = self.definitions.resolve(inner.at(inner.node.operand))
                found |= dict.fromkeys(self._list_same(inner), is_met)
            is_and = isinstance(part.node, ast.BoolOp) and isinstance(part.node.op, ast.And)
            nodes = {place.node for place in self.definitions.walk(part)}
            numbers = {one.number for node in nodes if (one := self.notes.source.find(node)) is not None}
            if found and not is_and and not numbers & self.distances.keys():
                flags.append((ast.unparse(part.node), found))
        return flags[:MOST_FLAGS]

    def _compare(self, episode: int, place: ReadExpression) -> LowSuccess | None:
        last = self.forced.find_last(episode)
        if last is None:
            return None
        success = dict.fromkeys(self._list_same(place), True)
        flags = self._list_flags()
        met = {number: value for _, one in flags for number, value in one.items()}
        best, before, lacks = -math.inf, -math.inf, ""
        for part in PARTS if self.distances else PARTS[:1]:
            near = {number: part * largest for number, largest in self.distances.items()}
            best = max(best, self._pay(episode, last, near, met | success))
            for text, without in self._list_failures(flags, met, success):
                is_natural = not text and self._succeeds(episode, last, near, place)
                paid = -math.inf if is_natural else self._pay(episode, last, near, without)
                if paid > before:
                    before, lacks = paid, text
        least = max(LEAST, CLEARLY * max(abs(best), abs(before)))
        is_known = math.isfinite(best) and math.isfinite(before)
        return (
            LowSuccess(place, self._find_paid(place), best, before, lacks)
            if is_known and before > best + least
            else None
        )

    def _list_failures(self, flags: list[tuple[str, Flags]], met: Flags, success: Flags) -> Iterator[tuple[str, Flags]]:
        """Yield what is true of steps without a success: nothing that is known, or all but one flag."""
        failure = dict.fromkeys(success, False)
        yield "", failure
        for text, one in flags:
            yield text, met | {number: not value for number, value in one.items()} | failure

    def _pay(self, episode: int, last: int, near: Mapping[int, float | bool], flags: Flags) -> float:
        paid = self.forced.pay(episode, last, near, LASTING, flags)[0]
        return paid if math.isfinite(paid) else -math.inf

    def _succeeds(self, episode: int, last: int, near: dict[int, float], place: ReadExpression) -> bool:
        """Say whether this is a success at such distances; or the episode ends before, as it does at one."""
        noted = self.forced.pay(episode, last, near, LASTING)[1]
        values = noted.values.get(self._find_number(place) or 0, []) if noted is not None else [1.0]
        return any(value is not None and bool(np.any(value)) for value in values)
