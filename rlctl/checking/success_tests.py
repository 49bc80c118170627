"""The comparisons that a success consists of, and which of them are true where the task is not done."""

import ast
import dataclasses
from collections.abc import Iterator, Sequence

import numpy as np

from rlctl.checking.assignments import LIBRARIES, Assignment, list_name_words, read_key, read_name
from rlctl.checking.definitions import ReadExpression
from rlctl.checking.experiments.expressions import NotedEpisodes
from rlctl.checking.goal_distances import TARGET_WORDS
from rlctl.checking.paid_errors import (
    COMMAND_WORDS,
    EARLIER_WORDS,
    FEWEST,
    PART,
    SIZES,
    WANTED_WORDS,
    Numbers,
    read_summed,
)
from rlctl.checking.paid_goals import GoalReader, read_joined

BELOW = 0.1  # part of the values that are on the side without an end
FAR = 2.0  # times the tolerance
MOSTLY = 0.5  # part of the values
DEEPEST = 24  # expressions that are followed
SIGNED_WORDS = {
    "bearing", "delta", "deviation", "dist", "distance", "err", "error", "errors", "gap", "heading", "misalignment",
    "miss", "offset", "rate", "remaining", "speed", "tilt", "vel", "velocity",
}  # fmt: skip
"""What a success wants near 0."""
OTHER_WORDS = {"clearance", "cost", "height", "improvement", "progress", "reward", "score"}


@dataclasses.dataclass(frozen=True, eq=False)
class OneSidedTest:
    """A comparison of a number of both signs that is true however far below 0 it is."""

    place: ReadExpression
    least: float
    tolerance: float


class SuccessTests:
    """Reads them."""

    def __init__(self, notes: NotedEpisodes) -> None:
        self.notes, self.goals, self.definitions = notes, notes.share(GoalReader), notes.definitions
        self.eithers: list[tuple[ReadExpression, list[list[ReadExpression]]]] = []
        """Where one of several is enough, and the comparisons of each."""
        self.anys: list[tuple[ReadExpression, ReadExpression]] = []
        """Where one number of an array is enough, and the comparison of all."""
        self._seen: set[ast.AST] = set()
        success = self.goals.read_success()
        self.tests = self._collect(success) if success is not None else []

    def _collect(self, place: ReadExpression) -> list[ReadExpression]:
        """Return the comparisons that make a success, also those under which a time or a number is counted up."""
        place = self.goals.resolve_flag(place)
        node = place.node
        if node in self._seen or len(self._seen) > DEEPEST:
            return []
        self._seen.add(node)
        for is_either in (False, True):
            if joined := read_joined(node, is_either):
                branches = [self._collect(place.at(part)) for part in joined]
                if is_either:
                    self.eithers.append((place, branches))
                return [test for branch in branches for test in branch]
        match node:
            case ast.Call(func=ast.Name(id="any" | "all" as name) | ast.Attribute(attr="any" | "all" as name)):
                inner = read_reduced(node)
                found = [] if inner is None else self._collect(place.at(inner))
                self.anys += [(place, one) for one in found if name == "any"]
                return found
            case ast.Compare(left=left):
                return [place, *self._collect_counted(place.at(left))]
            case ast.Name():
                set_true = [one for one in self.definitions.list_before(place) if _is_true(one)]
                return [test for one in set_true for test in self._collect_conditions(one)]
        return []

    def _collect_counted(self, place: ReadExpression) -> list[ReadExpression]:
        """Return the comparisons under which steps count up what is compared."""
        found: list[ReadExpression] = []
        for part in ast.walk(place.node):
            key = read_key(part) if isinstance(part, ast.Attribute) else ""
            for one in self.definitions.assigned.get(key, ()) if key else ():
                if one.function not in self.notes.of_steps:
                    continue
                match one.value:
                    case ast.IfExp(test=test) | ast.Call(func=ast.Attribute(attr="where"), args=[test, _, _]):
                        found += self._collect(ReadExpression(test, one.function))
                    case _ if one.added:
                        found += self._collect_conditions(one)
        return found

    def _collect_conditions(self, one: Assignment) -> list[ReadExpression]:
        tests = [test for test, is_met in self.definitions.list_conditions(one.statement) if is_met]
        return [found for test in tests for found in self._collect(ReadExpression(test, one.function))]

    def find_one_sided(self) -> Iterator[OneSidedTest]:
        """Yield comparisons of an error with its sign, which nothing bounds from below."""
        for place in self.tests:
            match place.node:
                case ast.Compare(left=left, ops=[ast.Lt() | ast.LtE()], comparators=[right]):
                    tolerance = self._read_tolerance(right)
                    episodes = self._list_episodes(place.at(left))
                    if tolerance is None or not episodes or self._is_bounded(left):
                        continue
                    is_wrong = _goes_below(episodes, tolerance) or self._is_below_command(left, episodes, tolerance)
                    if is_wrong and self._should_be_small(place.at(left)):
                        least = float(min(values.min() for values in episodes))
                        yield OneSidedTest(place, least, tolerance)

    def _list_episodes(self, place: ReadExpression) -> list[Numbers]:
        """Return what an expression was worth in each episode, wherever it is written: what stands behind `and` is
        evaluated now and then only. Local names are those of one function."""
        text = ast.unparse(place.node)
        names = {node.id for node in ast.walk(place.node) if isinstance(node, ast.Name)} - {"self", *LIBRARIES}
        same = [one for one in self.notes.source.expressions if one.text == text]
        same = [one for one in same if one.function is place.function or not names]
        found = []
        for episode in self.notes.episodes:
            values = [value for call in episode[1:] for one in same for value in call.values.get(one.number, ())]
            numbers = [np.ravel(value) for value in values if value is not None]
            found += [np.concatenate(numbers)] if numbers else []
        return found

    def _is_below_command(self, node: ast.expr, episodes: Sequence[Numbers], tolerance: float) -> bool:
        """Say whether a robot that does not move as a command says is below it, and so meets it."""
        match node:
            case ast.BinOp(left=left, op=ast.Sub(), right=right):
                words = list_name_words(right) & COMMAND_WORDS
                is_below = bool((np.concatenate([*episodes]) < -tolerance).mean() > MOSTLY)
                return bool(words) and not list_name_words(left) & WANTED_WORDS and is_below
        return False

    def _read_tolerance(self, node: ast.expr) -> float | None:
        values = self.notes.reward.numbers.list_values(node)
        constant = self.notes.reward.numbers.read_constant(node)
        if constant is None and values.size and (values == values[0]).all():
            constant = float(values[0])
        return constant if constant is not None and constant > 0 else None

    def _is_bounded(self, node: ast.expr) -> bool:
        """Say whether another comparison says how small a number may be."""
        text = ast.unparse(node)
        for one in self.notes.source.expressions:
            if isinstance(one.node, ast.Compare):
                sides = [one.node.left, *one.node.comparators]
                for before, operator, after in zip(sides, one.node.ops, sides[1:], strict=False):
                    larger = before if isinstance(operator, ast.Gt | ast.GtE) else after
                    if ast.unparse(larger) == text:
                        return True
        return False

    def _should_be_small(self, place: ReadExpression) -> bool:
        """Say whether it is a difference to what is wanted, or is called an error or a speed."""
        words: set[str] = set()
        for one in self._list_hops(place):
            words |= list_name_words(one.node)
            match one.node:
                case ast.BinOp(left=left, op=ast.Sub(), right=right):
                    wanted = [bool(list_name_words(side) & TARGET_WORDS) for side in (left, right)]
                    if sum(wanted) == 1 and not words & (OTHER_WORDS | EARLIER_WORDS):
                        return True
        return bool(words & SIGNED_WORDS) and not words & (OTHER_WORDS | EARLIER_WORDS)

    def _list_hops(self, place: ReadExpression) -> Iterator[ReadExpression]:
        for _ in range(DEEPEST):
            yield place
            found = self.definitions.follow(place)
            if len(found) != 1:
                if isinstance(place.node, ast.Subscript):
                    yield from self._list_hops(place.at(place.node.value))
                return
            place = found[0]

    def find_either(self) -> Iterator[tuple[ReadExpression, list[ReadExpression]]]:
        """Yield where one of two small errors is enough, with the tolerance of each."""
        for place, branches in self.eithers:
            small = [[test for test in branch if self._is_small(test)] for branch in branches]
            if not all(small):
                continue
            sides = [[self._read_sides(test) for test in branch] for branch in small]
            for parts in zip(*(([left for left, _ in one], [right for _, right in one]) for one in sides), strict=True):
                if len(set.union(*({*texts} for texts in parts))) != sum(len({*texts}) for texts in parts):
                    break  # the same quantity, or the same tolerance for several goals
            else:
                yield place, [branch[0] for branch in small]

    def _is_small(self, place: ReadExpression) -> bool:
        """Say whether a comparison is true where an error is small, or the cosine of one is large."""
        match place.node:
            case ast.Compare(left=left, ops=[operator], comparators=[right]):
                tolerance = self._read_tolerance(right)
                known = self._list_episodes(place.at(left))
                values = np.concatenate([np.zeros(0), *known])
                is_called = isinstance(left, ast.Call)
                if tolerance is None:
                    return False
                if isinstance(operator, ast.Lt | ast.LtE):
                    is_size = is_called and read_name(left.func) in SIZES  # type: ignore[attr-defined]
                    if values.size < FEWEST:  # what stands behind `and`, and was never evaluated
                        return bool(is_size)
                    is_error = bool(values.min() >= 0) or self._should_be_small(place.at(left))
                    return is_error and float(np.ptp(values)) > 0
                is_cosine = is_called and read_name(left.func) == "cos"  # type: ignore[attr-defined]
                if values.size >= FEWEST:
                    is_cosine |= float(np.abs(values).max()) <= 1 + 1e-6 and bool(values.min() < 0)
                return isinstance(operator, ast.Gt | ast.GtE) and bool(is_cosine) and 0.5 <= tolerance < 1
        return False

    def _read_sides(self, place: ReadExpression) -> tuple[str, str]:
        assert isinstance(place.node, ast.Compare)
        return ast.unparse(place.node.left), ast.unparse(place.node.comparators[0])

    def find_any(self) -> Iterator[ReadExpression]:
        """Yield where one small number of an array is enough, although the reward adds up all of them."""
        smallest = [(test, test) for test in self.tests if _read_smallest(test.node) is not None]
        for place, test in (*self.anys, *smallest):
            if not self._is_small(test) or not isinstance(test.node, ast.Compare):
                continue
            whole = _read_smallest(test.node) or test.node.left
            error = ast.unparse(self.definitions.resolve(test.at(whole)).node)
            for walked in self._walked:
                sums = [one.at(inner) for one in walked if (inner := read_summed(one.node)) is not None]
                if any(ast.unparse(part.node) == error for one in sums for part in self.definitions.walk(one)):
                    yield place
                    return

    @property
    def _walked(self) -> Iterator[list[ReadExpression]]:
        for summand in self.notes.reward.summands:
            yield list(self.definitions.walk(summand.place))


def _goes_below(episodes: Sequence[Numbers], tolerance: float) -> bool:
    """Say whether a number was far below 0, and above a tolerance, in many steps; or where episodes end, which such a
    success may do at once."""
    values = np.concatenate([*episodes])
    if values.size >= FEWEST and (values < -tolerance).mean() >= BELOW:
        return bool((values > tolerance).mean() >= PART)
    ends = np.array([one[-1] for one in episodes])
    return bool((ends < -FAR * tolerance).any() and (ends > tolerance).any())


def read_reduced(call: ast.Call) -> ast.expr | None:
    """Return what `np.any(x)` or `x.any()` is called with."""
    if isinstance(call.func, ast.Attribute) and read_name(call.func.value) not in ("np", "numpy", "jnp"):
        return call.func.value
    return call.args[0] if call.args else None


def _read_smallest(node: ast.expr) -> ast.expr | None:
    """Return the array whose smallest number is compared, as in `x.min() < tolerance`."""
    match node:
        case ast.Compare(left=ast.Call(func=function) as call, ops=[ast.Lt() | ast.LtE()]) if read_name(function) in (
            "min",
            "amin",
        ):
            return read_reduced(call) if len(call.args) < 2 else None
    return None


def _is_true(one: Assignment) -> bool:
    return isinstance(one.value, ast.Constant) and one.value.value is True
