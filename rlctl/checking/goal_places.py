"""Which places the source compares with one goal: where they are always the same way apart, they are one place in two
frames, or two points of one body."""

import ast
import dataclasses
import itertools
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from rlctl.checking.assignments import read_key
from rlctl.checking.experiments.expressions import NotedEpisodes
from rlctl.checking.previous_values import is_goal
from rlctl.checking.source_code import Expression

FEWEST = 20  # steps
SAME = 1e-6  # how much a distance may change while both places move
LEAST = 1e-3  # by which both have to differ, and by which they have to move


@dataclasses.dataclass(frozen=True, eq=False)
class ComparedPlace:
    """A place of which the way to a goal is computed."""

    goal: str
    whole: Expression
    name: str
    values: NDArray[np.float64]  # Shape (steps, axes)


def find_two_places(noted: NotedEpisodes) -> Iterator[tuple[ComparedPlace, ComparedPlace]]:
    """Yield two places that are compared with one goal, and that are always the same way apart although both move."""
    places = list(_list_places(noted))
    for one, other in itertools.combinations(places, 2):
        if one.goal != other.goal or one.values.shape != other.values.shape:
            continue
        apart = one.values - other.values
        moves = min(float(np.ptp(one.values, axis=0).max()), float(np.ptp(other.values, axis=0).max()))
        if moves > LEAST and np.abs(apart).max() > LEAST and float(np.ptp(apart, axis=0).max()) < SAME * moves:
            yield one, other
            return


def _list_places(noted: NotedEpisodes) -> Iterator[ComparedPlace]:
    for whole in noted.source.expressions:
        match whole.node:
            case ast.BinOp(left=left, op=ast.Sub(), right=right):
                sides = ((left, right), (right, left))
            case _:
                continue
        for goal, place in sides:
            key = read_key(noted.definitions.find_origin(goal, whole.function))
            found = noted.source.find(place)
            if not key or not is_goal(key) or found is None or is_goal(read_key(place)):
                continue
            noted_values = [call.values[found.number][-1] for call in noted.steps if found.number in call.values]
            rows = [np.ravel(value) for value in noted_values if value is not None]
            is_array = any(isinstance(value, np.ndarray) for value in noted_values)
            if is_array and len(rows) == len(noted_values) >= FEWEST and len({row.shape for row in rows}) == 1:
                yield ComparedPlace(key, whole, found.text, np.stack(rows))
