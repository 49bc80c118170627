"""Summands of a reward that rise with the distance to what is to be reached, whatever function they are of it."""

import ast
import dataclasses
import math
from collections.abc import Iterator

import numpy as np

from rlctl.checking.assignments import read_name
from rlctl.checking.definitions import ReadExpression
from rlctl.checking.experiments.expressions import NotedEpisodes
from rlctl.checking.expressions import NotedCall
from rlctl.checking.forced_rewards import ForcedRewards
from rlctl.checking.goal_distances import DistanceReader, GoalDistance
from rlctl.checking.paid_goals import GoalReader
from rlctl.checking.summands import Summand

PARTS = (0.02, 0.25, 0.5, 0.75, 1.0, 1.5)  # of the largest distance that was noted
LOW, HIGH = 0, 4  # of these parts
EPISODES, LATER = (0, 3), (0, 3)  # that are played again, and steps in them
LASTING = 3  # steps at one distance, in which there is no progress
SAME, LEAST = 1e-3, 1e-6  # of a rise: how much it may differ between steps; of rewards: the least that counts


@dataclasses.dataclass(frozen=True, eq=False)
class RisingReward:
    """What a step pays at a small and at a large distance."""

    distance: GoalDistance
    place: ReadExpression
    near: tuple[float, float]  # the distance, and the reward
    far: tuple[float, float]


class RiseReader:
    """Finds rewards that rise with a distance, in steps in which nothing else changes."""

    def __init__(self, notes: NotedEpisodes) -> None:
        self.notes, self.goals = notes, notes.share(GoalReader)
        self.forced = ForcedRewards(notes)

    def find_rises(self) -> Iterator[RisingReward]:
        """Yield them."""
        for one in self.notes.share(DistanceReader).distances:
            if self._rises_first(one) and self._rises_everywhere(one):
                found = self._describe(one)
                if found is not None:
                    yield found

    def find_paid(self) -> Iterator[tuple[GoalDistance, Summand]]:
        """Yield summands that are a distance itself, or a function that rises with it, and are added: also those that
        count only where something is true that steps hardly ever reach."""
        for one in self.notes.share(DistanceReader).distances:
            for summand in one.summands:
                place = self.notes.definitions.resolve(summand.place)
                if summand.weight > 0 and not self.goals.is_of_progress(summand) and self._is_function(place, one):
                    yield one, summand

    def _is_function(self, place: ReadExpression, one: GoalDistance) -> bool:
        """Say whether an expression is a distance, times a constant, or the hyperbolic tangent or the root of it."""
        place = self.notes.definitions.resolve(place)
        if place.node is one.expression.node:
            return True
        match place.node:
            case ast.Call(func=function, args=[inner]) if read_name(function) in ("tanh", "sqrt", "log1p", "float"):
                return self._is_function(place.at(inner), one)
            case ast.BinOp(left=left, op=ast.Mult() | ast.Div(), right=right):
                constants = [self.notes.reward.numbers.read_constant(side) is not None for side in (left, right)]
                return sum(constants) == 1 and self._is_function(place.at(right if constants[0] else left), one)
        return False

    def _pay(self, one: GoalDistance, number: int, last: int, part: float, lasting: int = LASTING) -> float:
        return self.forced.pay(number, last, {one.expression.number: part * one.largest}, lasting)[0]

    def _rises_first(self, one: GoalDistance) -> bool:
        last = self.forced.find_last(EPISODES[0])
        if last is None:
            return False
        near, far = (self._pay(one, EPISODES[0], last, PARTS[part]) for part in (LOW, HIGH))
        return far > near + LEAST * max(1.0, abs(near))

    def _rises_everywhere(self, one: GoalDistance) -> bool:
        """Say whether the reward never falls with the distance, and rises by the same in each step of an episode."""
        for number in EPISODES:
            rises = []
            for later in LATER:
                last = self.forced.find_last(number, later)
                if last is None:
                    return False
                paid = np.array([self._pay(one, number, last, part) for part in PARTS])
                least = LEAST * max(1.0, float(np.abs(paid).max()))
                if not np.isfinite(paid).all() or np.diff(paid).min() < -least or paid[HIGH] < paid[LOW] + least:
                    return False
                rises.append(paid[HIGH] - paid[LOW])
            if np.ptp(rises) > SAME * max(rises):
                return False
        return True

    def _describe(self, one: GoalDistance) -> RisingReward | None:
        """Return where the reward rises; None where it falls if only the last distance is larger, as progress does, and
        no summand of its own rises."""
        number = EPISODES[0]
        last = self.forced.find_last(number) or 0
        distances = [PARTS[part] * one.largest for part in (LOW, HIGH)]
        ends = [self.forced.pay(number, last, {one.expression.number: value}) for value in distances]
        (near, before), (far, after) = ends
        if before is None or after is None:
            return None
        rising = [summand for summand in one.summands if self._is_rising(summand, before, after)]
        if far <= near and not rising:
            return None
        place = rising[0].place if rising else ReadExpression(one.expression.node, one.expression.function, {})
        paid = [self._pay(one, number, last, PARTS[part]) for part in (LOW, HIGH)]
        return RisingReward(one, place, (distances[0], paid[0]), (distances[1], paid[1]))

    def _is_rising(self, summand: Summand, before: NotedCall, after: NotedCall) -> bool:
        if math.isnan(summand.weight) or self.goals.is_of_progress(summand):
            return False
        noted = self.notes.source.find(summand.place.node)
        if noted is None:
            return False
        near, far = (call.values.get(noted.number, [None])[-1] for call in (before, after))
        if near is None or far is None or np.shape(near) != np.shape(far):
            return False
        rise = summand.weight * float(np.mean(np.subtract(far, near)))
        return rise > LEAST * max(1.0, float(np.max(np.abs(near))))
