"""Comparisons of a success with some numbers of a goal only."""

import ast
import dataclasses
from collections.abc import Iterator, Sequence

import numpy as np

from rlctl.checking.assignments import list_name_words, read_name
from rlctl.checking.definitions import ReadExpression
from rlctl.checking.experiments.expressions import NotedEpisodes
from rlctl.checking.paid_errors import WANTED_WORDS
from rlctl.checking.success_tests import SuccessTests

CLEARLY = 0.05  # part of the range of a goal's largest number, by which another one differs between episodes


@dataclasses.dataclass(frozen=True, eq=False)
class PartialGoal:
    """A comparison with some numbers of a goal, of which others differ between episodes, too."""

    place: ReadExpression
    goal: str
    left_out: int


class PartialGoalReader:
    """Finds them."""

    def __init__(self, notes: NotedEpisodes) -> None:
        self.notes, self.definitions, self._tests = notes, notes.definitions, notes.share(SuccessTests).tests

    def find(self) -> Iterator[PartialGoal]:
        """Yield comparisons of a place with some numbers of a goal, although the source also takes the whole of their
        difference, and another number of the goal is drawn."""
        for test in self._tests:
            for place in self.definitions.walk(test):
                match place.node:
                    case ast.BinOp(left=ast.Subscript() as left, op=ast.Sub(), right=ast.Subscript() as right):
                        if ast.unparse(left.slice) != ast.unparse(right.slice) or not isinstance(left.slice, ast.Slice):
                            continue
                        sides = [left.value, right.value]
                        goals = [one for one in sides if list_name_words(one) & WANTED_WORDS]
                        number = self._find_left_out(place.at(goals[0]), left.slice) if len(goals) == 1 else None
                        if number is not None and self._is_whole_elsewhere(sides):
                            yield PartialGoal(place, ast.unparse(goals[0]), number)

    def _find_left_out(self, goal: ReadExpression, part: ast.Slice) -> int | None:
        """Return a number of a goal that is not in a slice, and differs between episodes as the others do."""
        rows = self._read_starts(goal.node)
        if rows is None:
            return None
        lower, upper = (one.value if isinstance(one, ast.Constant) else None for one in (part.lower, part.upper))
        if not isinstance(lower, int | None) or not isinstance(upper, int | None) or part.step is not None:
            return None
        numbers = list(range(rows.shape[1]))
        used = numbers[lower:upper]
        ranges = np.ptp(rows, axis=0)
        left = [one for one in numbers if one not in used and ranges[one] > CLEARLY * ranges.max()]
        return left[0] if left and used else None

    def _read_starts(self, node: ast.expr) -> np.ndarray | None:
        """Return a vector at the first step of each episode, shape (episodes, numbers)."""
        text = ast.unparse(node)
        for one in self.notes.source.expressions if isinstance(node, ast.Attribute) else ():
            if one.text != text:
                continue
            values = [
                episode[1].values.get(one.number, [None])[0] for episode in self.notes.episodes if len(episode) > 1
            ]
            rows = [value for value in values if isinstance(value, np.ndarray) and value.ndim == 1]
            if len(rows) == len(values) > 1 and len({row.shape for row in rows}) == 1:
                return np.array(rows)
        return None

    def _is_whole_elsewhere(self, sides: Sequence[ast.expr]) -> bool:
        """Say whether the source also subtracts these from each other as a whole."""
        names = {read_name(side) for side in sides}
        for one in self.notes.source.expressions:
            match one.node:
                case ast.BinOp(left=ast.Name() | ast.Attribute() as left, op=ast.Sub(), right=right):
                    if {read_name(left), read_name(right)} == names and isinstance(right, ast.Name | ast.Attribute):
                        return True
        return False
