"""Times in a source at which something would happen, such as a new command, and that come after each episode's end."""

import ast
import dataclasses
import functools
from collections.abc import Iterator, Sequence

import numpy as np

from rlctl.checking.assignments import LIBRARIES, read_key, read_name, read_root, read_words
from rlctl.checking.experiments.expressions import NotedEpisodes
from rlctl.checking.expressions import Value
from rlctl.checking.goal_draws import GoalDraws, is_drawn
from rlctl.checking.source_code import Expression, FaultyCode, Function

FEWEST = 8  # steps of an episode
EXACT = 1e-6  # relative
FAR = 20.0  # times the length of an episode: so late is meant never to come
MOST_FORCED = 6
FORCED_STEP = 2
TIMER_WORDS = {"left", "timer", "remaining", "countdown", "elapsed", "clock"}
PUSHES = {"applyExternalForce", "applyExternalTorque", "resetBaseVelocity", "apply_force"}
WHOLE = {"int", "floor", "trunc", "floor_divide"}


@dataclasses.dataclass(frozen=True)
class _Line:
    """A number that changes by the same in each step of an episode."""

    first: float  # in the first step
    slope: float  # in a step

    def reaches(self, other: "_Line") -> float:
        """Return in which step both are the same; infinity for never."""
        slope = self.slope - other.slope
        way = other.first - self.first
        return 1 + way / slope if slope and way / slope >= 0 else np.inf


class LateEvents:
    """Finds them."""

    def __init__(self, noted: NotedEpisodes) -> None:
        self.noted, self.definitions, self.source = noted, noted.definitions, noted.source
        self._draws = noted.share(GoalDraws)

    def find(self) -> Iterator[FaultyCode]:
        """Yield conditions of an event that hold only after the time limit, or never: no step moves their timer."""
        for one in self.source.expressions:
            if one.function not in self.noted.of_steps:
                continue
            if isinstance(one.node, ast.Compare) and self._is_event(one):
                step = self._find_first(one) if self._is_constant(one) else None
                if step is not None and self._is_after_end(step):
                    what = f"{one.text} would change in step {step:.0f}, and an episode has {self._limit:.0f} steps:"
                    yield FaultyCode(one.node, f"{what} what it is for never comes", one.where)
                elif self._stands(one):
                    what = f"{one.text} never holds: no step moves {ast.unparse(one.node.left)}"
                    yield FaultyCode(one.node, what, one.where)
            elif (step := self._find_part(one)) is not None and self._is_after_end(step):
                what = f"{one.text} comes to 1 in step {step:.0f}, and an episode has {self._limit:.0f} steps:"
                yield FaultyCode(one.node, f"{what} all parts but the first never come", one.where)

    def _is_after_end(self, step: float) -> bool:
        return self._limit is not None and self._limit < step < FAR * self._limit

    @functools.cached_property
    def _limit(self) -> float | None:
        """The number of steps after which an episode is cut off; None where that is not known."""
        declared = self.noted.instance.max_steps
        if declared:
            return float(declared)
        found, tried = [], 0
        for one in self.source.expressions:
            if not isinstance(one.node, ast.Compare) or one.function not in self.noted.of_steps:
                continue
            step = self._find_first(one)
            if step is None or not np.isfinite(step) or tried >= MOST_FORCED:
                continue
            tried += 1
            played = self.noted.play(0, FORCED_STEP, {FORCED_STEP: {one.number: True}})
            if len(played) > FORCED_STEP and played[FORCED_STEP][1].flags[1]:
                found.append(step)
        return min(found, default=None)

    def _find_first(self, one: Expression) -> float | None:
        """Return in which step a comparison with a clock changes, in the episode in which that comes first."""
        match one.node:
            case ast.Compare(
                left=ast.BinOp(left=left, op=ast.Mod(), right=right),
                ops=[ast.Eq()],
                comparators=[ast.Constant(value=0)],
            ):
                pass
            case ast.Compare(left=left, ops=[ast.GtE() | ast.Gt() | ast.LtE() | ast.Lt()], comparators=[right]):
                pass
            case _:
                return None
        pairs = list(zip(self._read(left), self._read(right), strict=True))
        known = [(a, b) for a, b in pairs if a is not None and b is not None]
        if not known or len(known) < len(pairs) or not any(a.slope for a, _ in known):
            return None
        return min(a.reaches(b) for a, b in known)

    def _is_met(self, one: Expression) -> bool:
        """Say whether a condition has held in a step; also where it was never asked."""
        values = [value for call in self.noted.steps for value in call.values.get(one.number, ())]
        return not values or any(value is None or np.any(value) for value in values)

    def _read(self, node: ast.expr) -> list[_Line | None]:
        """Return what an expression is in each episode that is long enough."""
        found = self.source.find(node)
        episodes = [episode for episode in self.noted.episodes if len(episode) > FEWEST]
        if found is None:
            is_number = isinstance(node, ast.Constant) and isinstance(node.value, int | float)
            return [_Line(float(node.value), 0.0) if is_number else None] * len(episodes)  # type: ignore[attr-defined]
        return [_fit([call.values.get(found.number, [None])[0] for call in episode[1:]]) for episode in episodes]

    def _is_event(self, one: Expression) -> bool:
        """Say whether a condition is that of a draw, a push or a new goal."""
        node: ast.AST = one.node
        while not isinstance(node, ast.stmt):
            above = self.source.parents[node]
            if isinstance(above, ast.If) and node is above.test:
                return any(self._does_something(part, one.function) for part in above.body)
            if isinstance(above, ast.IfExp) and node is above.test:
                return is_drawn(self.definitions, above.body, one.function)
            if self._is_choice(node):
                return True
            if not isinstance(above, ast.BoolOp):
                return False
            node = above
        return False

    def _is_choice(self, node: ast.AST) -> bool:
        """Say whether a condition chooses between two entries: `np.where(time < SWITCH, goals[:, 0], goals[:, 1])`."""
        above = self.source.parents[node]
        if not isinstance(above, ast.Call) or read_name(above.func) != "where" or node is not above.args[0]:
            return False
        entries = above.args[1:]
        return len({ast.unparse(one) for one in entries}) == 2 and all(
            isinstance(one, ast.Subscript) for one in entries
        )

    def _is_constant(self, one: Expression) -> bool:
        """Say whether a condition never held; or always, where it chooses between two entries."""
        return not self._is_met(one) or (self._is_choice(one.node) and self._always_holds(one))

    def _always_holds(self, one: Expression) -> bool:
        values = [value for call in self.noted.steps for value in call.values.get(one.number, ())]
        return all(value is not None and bool(np.all(value)) for value in values)

    def _does_something(self, statement: ast.stmt, function: Function) -> bool:
        if is_drawn(self.definitions, statement, function):
            return True
        tops = [top for top, _ in self.definitions.list_sources(statement, function)]
        nodes = [node for top in tops for node in ast.walk(top)]
        if any(isinstance(node, ast.Call) and read_name(node.func) in PUSHES for node in nodes):
            return True
        inside = {*ast.walk(statement)}
        return any(
            self._draws.is_new_goal(key, one)
            for key, several in self.definitions.assigned.items()
            for one in several
            if one.statement in inside
        )

    def _stands(self, one: Expression) -> bool:
        """Say whether a timer is compared that is the same in all steps of all episodes."""
        match one.node:
            case ast.Compare(left=left, ops=[ast.GtE() | ast.Gt() | ast.LtE() | ast.Lt()], comparators=[right]):
                lines = [line for side in (left, right) for line in self._read(side)]
            case _:
                return False
        is_timer = bool(read_words(read_key(left)) & TIMER_WORDS)
        return (
            is_timer
            and not self._is_met(one)
            and bool(lines)
            and all(line is not None and not line.slope for line in lines)
        )

    def _find_part(self, one: Expression) -> float | None:
        """Return in which step a clock over a length of time comes to 1, where the whole part of it is an index."""
        match one.node:
            case ast.BinOp(left=left, op=ast.Div() | ast.FloorDiv(), right=right) if self._is_index(one.node):
                pairs = list(zip(self._read(left), self._read(right), strict=True))
                known = [(a, b) for a, b in pairs if a is not None and b is not None and b.slope == 0 and a.slope]
                is_all = bool(known) and len(known) == len(pairs)
                return min(a.reaches(b) for a, b in known) if is_all else None
        return None

    def _is_index(self, node: ast.expr) -> bool:
        """Say whether a quotient is made a whole number, and that an index."""
        is_whole = isinstance(node, ast.BinOp) and isinstance(node.op, ast.FloorDiv)
        function = self.source.find_function(node)
        inner: ast.AST = node
        while not isinstance(inner, ast.stmt):
            above = self.source.parents[inner]
            if isinstance(above, ast.Subscript) and inner is above.slice:
                return is_whole
            if isinstance(above, ast.Call):
                is_whole |= read_name(above.func) in WHOLE
            is_whole |= isinstance(above, ast.Attribute) and above.attr == "astype"
            is_known = isinstance(above, ast.Call | ast.Attribute | ast.BinOp | ast.Tuple | ast.stmt)
            if not is_known or (isinstance(above, ast.Call) and not _is_rounding(above)):
                return False
            inner = above
        match inner:
            case ast.Assign(targets=[ast.Name(id=name)]):
                indices = [part.slice for part in ast.walk(function) if isinstance(part, ast.Subscript)]
                return is_whole and any(
                    isinstance(part, ast.Name) and part.id == name for index in indices for part in ast.walk(index)
                )
        return False


def _is_rounding(call: ast.Call) -> bool:
    name = read_name(call.func)
    is_known = name in WHOLE | {"min", "minimum", "clip", "astype"}
    return is_known and (isinstance(call.func, ast.Name) or read_root(call.func) in LIBRARIES or name == "astype")


def _fit(values: Sequence[Value]) -> _Line | None:
    """Return the line on which the values of steps are; None for others. Some steps may not evaluate them."""
    known = [(place, value) for place, value in enumerate(values) if value is not None]
    numbers = [float(np.ravel(value)[0]) for _, value in known if np.size(value) and not np.ptp(value)]
    if len(numbers) < max(FEWEST, len(known)):
        return None
    places = np.array([place for place, _ in known])
    slopes = np.diff(numbers) / np.diff(places)
    slope, size = float(np.mean(slopes)), EXACT * (1 + max(map(abs, numbers)))
    slope = slope if abs(slope) > EXACT * size else 0.0
    return _Line(numbers[0] - slope * int(places[0]), slope) if np.ptp(slopes) < size else None
