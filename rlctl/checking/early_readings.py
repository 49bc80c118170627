"""Values that a reset reads and keeps before it sets what they are computed from: the robot is placed afterwards."""

import ast
import contextlib
import copy
import dataclasses
import sys
from collections.abc import Iterator, Mapping, Sequence
from types import FrameType
from typing import Any

import numpy as np

from rlctl.checking.assignments import Assignment, read_key, read_name, read_root, read_words
from rlctl.checking.definitions import Definitions
from rlctl.checking.experiments.expressions import NotedEpisodes
from rlctl.checking.expressions import NotedCall
from rlctl.checking.previous_values import PREVIOUS_WORDS, KeptDifference, KeptDifferences, is_goal
from rlctl.checking.source_code import Expression, Function
from rlctl.checking.term_names import split_name

NOMINAL_WORDS = {
    "nominal", "default", "home", "rest", "neutral", "stand", "standing", "reference", "ref", "base", "initial", "init",
    "mid", "center", "centre", "zero",
}  # fmt: skip
"""What may be meant to be the same in all episodes."""
START_WORDS = {"start", "started", "begin", "beginning", "first", "heading", "yaw", "launch", "takeoff", "spawn"}
CHANCE_WORDS = {
    "random",
    "uniform",
    "normal",
    "choice",
    "integers",
    "rand",
    "randn",
    "randint",
    "sample",
    "draw",
    "rng",
}
CLOCKS = {"time", "perf_counter", "monotonic", "time_ns", "now", "process_time"}
CHANGING = ("set", "reset", "add", "create", "load", "remove", "pop", "append", "next", "step", "save", "restore")
PHYSICS = {
    *("mj_step", "mj_step2", "stepSimulation", "step_simulation", "do_simulation", "simulate", "step", "settle"),
    *("advance", "_integrate", "integrate", "_simulate", "_settle", "_physics", "physics"),
}
RESETS = 5
FEWEST = 3  # resets
DEEPEST = 6  # calls
SAME, OTHER = 1e-9, 1e-4  # relative: what is the same, and what is another value


@dataclasses.dataclass(frozen=True, eq=False)
class EarlyReading:
    """A value that a reset keeps, and that is another one at the end of that reset."""

    assignment: Assignment
    value: Expression
    kept: float | np.ndarray[Any, Any]
    later: float | np.ndarray[Any, Any]  # what the same expression is worth at the end of the reset
    difference: KeptDifference  # in which steps subtract it


@dataclasses.dataclass(frozen=True, eq=False)
class Repeatable:
    """What a reset keeps, and the expression of it that may be evaluated once more."""

    key: str
    assignment: Assignment
    value: Expression
    again: ast.expr  # the value, with what its local names stand for
    origins: list[Expression]  # of these names
    differences: Sequence[KeptDifference] = ()


class EarlyReadings:
    """Those of a source."""

    def __init__(self, noted: NotedEpisodes) -> None:
        self.noted, self.definitions = noted, noted.definitions
        self._differences = noted.share(KeptDifferences).differences

    def find(self) -> Iterator[EarlyReading]:
        """Yield the values that were another one at the end of each reset, and that the first step subtracts."""
        candidates = list(self._list_candidates())
        if not candidates:
            return
        seen: dict[Expression, list[tuple[Any, Any]]] = {}
        for number in range(min(RESETS, len(self.noted.episodes))):
            watch = RepeatWatch(self.noted, candidates)
            with watch:
                played = self.noted.play(number, 0, {})
            for one in candidates if played else ():
                if (pair := watch.read(one, played[0][0])) is not None:
                    seen.setdefault(one.value, []).append(pair)
        for one in candidates:
            pairs = seen.get(one.value, [])
            is_early = len(pairs) >= FEWEST and all(differ(*pair) for pair in pairs[1:])
            if is_early and self._is_meant(one, pairs) and (difference := self._find_used(one)) is not None:
                yield EarlyReading(one.assignment, one.value, *pairs[-1], difference)

    def _list_candidates(self) -> Iterator[Repeatable]:
        subtracted = {one.key for one in self._differences}
        for key, assignments in self.definitions.assigned.items():
            for one in assignments if key in subtracted and not is_goal(key) else ():
                found = self.open(key, one) if not is_goal(read_key(one.value)) else None
                if found is not None:
                    its = [other for other in self._differences if other.key == key]
                    yield dataclasses.replace(found, differences=its)

    def open(self, key: str, one: Assignment) -> Repeatable | None:
        """Return what a reset keeps, with the expression that may be evaluated once more; None for what may not be."""
        value = self.noted.source.find(one.value)
        is_plain = one.element is None and not one.is_part and isinstance(one.statement, ast.Assign)
        is_plain &= isinstance(one.target, ast.Attribute | ast.Subscript)
        if value is None or not is_plain or one.function not in self.noted.of_resets:
            return None
        opened = _OpenedNames(self.definitions, one)
        again = opened.visit(copy.deepcopy(one.value))
        if not self._may_be_repeated(one, again) or not opened.is_known or not self._is_pure(again):
            return None
        origins = [found for node in opened.origins if (found := self.noted.source.find(node)) is not None]
        return Repeatable(key, one, value, again, origins)

    def _may_be_repeated(self, assignment: Assignment, again: ast.expr) -> bool:
        """Say whether the names of an expression have the same values at the end of its function."""
        parts = [*ast.walk(again), *ast.walk(assignment.target)]
        names = {node.id for node in parts if isinstance(node, ast.Name)}
        return not any(
            isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store) and node.id in names
            for node in ast.walk(assignment.function)
        )

    def _is_pure(self, top: ast.AST, depth: int = 0) -> bool:
        """Say whether code may be evaluated once more: it draws nothing and changes nothing."""
        for node in ast.walk(top):
            match node:
                case ast.NamedExpr() | ast.Lambda() | ast.Await() | ast.Yield() | ast.Global():
                    return False
                case ast.Attribute(ctx=ast.Store()) | ast.Subscript(ctx=ast.Store(), value=ast.Attribute()):
                    return False
                case ast.Call(func=function):
                    name = read_name(function)
                    if read_root(function) in {"np", "numpy"} and name in {"append", "add", "setdiff1d"}:
                        continue  # they return a new array
                    owners = set(split_name(ast.unparse(function)))
                    if not name or owners & CHANCE_WORDS or name in CLOCKS or name.lstrip("_").startswith(CHANGING):
                        return False
                    inner = self.definitions.functions.get(name, ())
                    if inner and (depth > DEEPEST or not all(self._is_pure(one, depth + 1) for one in inner)):
                        return False
        return True

    def _is_meant(self, one: Repeatable, pairs: list[tuple[Any, Any]]) -> bool:
        """Say whether a value is meant to be that of this episode: what is the same in all may be a nominal one."""
        words = read_words(one.key)
        if any(differ(pairs[0][0], kept) for kept, _ in pairs[1:]):
            return True
        return bool(words & (START_WORDS | PREVIOUS_WORDS)) and not words & NOMINAL_WORDS

    def _find_used(self, one: Repeatable) -> KeptDifference | None:
        """Return a difference of the first step that has what reset has kept."""
        for number in range(len(self.noted.episodes)):
            played = self.noted.play(number, 1, {})
            if len(played) < 2:
                continue
            kept = played[0][0].values.get(one.value.number)
            for difference in one.differences:
                values = played[1][0].values.get(difference.kept.number)
                if kept and values and kept[-1] is not None and values[0] is not None:
                    return difference if not differ(kept[-1], values[0], SAME) else None
        return None


class _OpenedNames(ast.NodeTransformer):
    """Replaces the local names of what is assigned by the expressions that they stand for."""

    def __init__(self, definitions: Definitions, assignment: Assignment) -> None:
        self.origins: list[ast.expr] = []
        self.is_known = True  # whether each name stands for one expression only
        self._assigned = definitions.list_assigned(assignment.function)
        self._depth = 0

    def visit_Name(self, node: ast.Name) -> ast.expr:
        """Replace a name that is assigned once."""
        several = self._assigned.get(node.id)
        if several is None:
            return node
        one = several[0]
        if len(several) > 1 or one.added or not one.is_known or self._depth > DEEPEST:
            self.is_known = False
            return node
        self.origins.append(one.value)
        self._depth += 1
        opened: ast.expr = self.visit(copy.deepcopy(one.value))
        self._depth -= 1
        return opened if one.element is None else ast.Subscript(opened, ast.Constant(one.element), ast.Load())


class RepeatWatch(contextlib.AbstractContextManager["RepeatWatch"]):
    """Evaluates what candidates keep once more, each time that a reset or a step returns."""

    def __init__(self, noted: NotedEpisodes, candidates: list[Repeatable]) -> None:
        self._noted, self._candidates = noted, candidates
        self._functions = {
            (file, one.name, min([one.lineno, *(part.lineno for part in one.decorator_list)])): one
            for named in noted.source.functions.values()
            for one in named
            for file in [noted.source.find_place(one)[0]]
        }
        self._depth = 0
        self._scopes: dict[Function, tuple[dict[str, Any], dict[str, Any]]] = {}
        self._found: dict[Repeatable, tuple[Any, Any]] = {}

    def __enter__(self) -> "RepeatWatch":
        self._before = sys.getprofile()
        sys.setprofile(self._watch)
        return self

    def __exit__(self, *_: object) -> None:
        sys.setprofile(self._before)

    def _watch(self, frame: FrameType, event: str, _: Any) -> None:
        if event not in ("call", "return"):
            return
        code = frame.f_code
        function = self._functions.get((code.co_filename, code.co_name, code.co_firstlineno))
        if function is None:
            return
        self._depth += 1 if event == "call" else -1
        if event == "return":
            self._scopes[function] = frame.f_globals, dict(frame.f_locals)
            if self._depth == 0:
                self._evaluate()

    def _evaluate(self) -> None:
        events, self._noted.recorder.events = self._noted.recorder.events, None
        for one in self._candidates:
            if (scope := self._scopes.get(one.assignment.function)) is not None:
                target = copy.deepcopy(one.assignment.target)
                target.ctx = ast.Load()  # type: ignore[attr-defined]
                self._found[one] = _run(target, scope), _run(one.again, scope)
        self._noted.recorder.events = events

    def read_latest(self, one: Repeatable) -> tuple[Any, Any]:
        """Return what an attribute is, and what its expression is worth, when the last call has returned; None for
        what is not known."""
        return self._found.get(one, (None, None))

    def read(self, one: Repeatable, call: NotedCall) -> tuple[Any, Any] | None:
        """Return what was kept, and what the same expression was worth at the end; None where the attribute has been
        set again, or the physics has gone on."""
        if one not in self._found or one.value.number not in call.values:
            return None
        early, (kept, later) = call.values[one.value.number][-1], self._found[one]
        if early is None or kept is None or later is None or differ(early, kept, SAME):
            return None
        latest = {number: place for place, (number, _) in enumerate(call.events)}
        first = min(latest.get(origin.number, len(call.events)) for origin in (one.value, *one.origins))
        nodes = [self._noted.source.expressions[number].node for number, _ in call.events[first:]]
        if any(isinstance(node, ast.Call) and read_name(node.func) in PHYSICS for node in nodes):
            return None
        if self._moves_on(one, {self._noted.source.expressions[number].function for number, _ in call.events[first:]}):
            return None
        return kept, later

    def _moves_on(self, one: Repeatable, run: set[Function]) -> bool:
        """Say whether one of the functions that were run moves the robot as steps do, such as to let it settle."""
        definitions = self._noted.definitions
        keys = definitions.list_reads(one.assignment.value, one.assignment.function)
        of_steps = [function for function in run if function in self._noted.of_steps]
        return any(definitions.list_sets(function) & keys for function in of_steps)


def _run(node: ast.expr, scope: tuple[dict[str, Any], Mapping[str, Any]]) -> Any:
    """Return what an expression is worth; None for what is no array of numbers."""
    code = compile(ast.fix_missing_locations(ast.Expression(copy.deepcopy(node))), "<again>", "eval")
    try:
        value = np.array(eval(code, scope[0], dict(scope[1])), np.float64)  # the author's own expression
    except Exception:  # of whatever kind: the author's code has run in other circumstances
        return None
    return value if np.isfinite(value).all() else None


def differ(one: Any, other: Any, part: float = OTHER) -> bool:
    """Say whether numbers are others."""
    one, other = np.asarray(one, float), np.asarray(other, float)
    if one.shape != other.shape:
        return True
    return bool(np.abs(one - other).max(initial=0.0) > part * (1 + np.abs(one).max(initial=0.0)))
