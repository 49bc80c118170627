"""Values that only a reset computes from what steps move, and that the observation shows in each step."""

import ast
import dataclasses
import functools
from collections.abc import Iterator

from rlctl.checking.assignments import Assignment, read_key, read_name, read_words
from rlctl.checking.early_readings import NOMINAL_WORDS, EarlyReadings, Repeatable, RepeatWatch, differ
from rlctl.checking.experiments.expressions import NotedEpisodes
from rlctl.checking.late_readings import MEANT_WORDS, is_relative
from rlctl.checking.source_code import Expression
from rlctl.checking.stale_values import FIRST_WORDS

COURSE_WORDS = {
    "path", "course", "line", "track", "route", "segment", "length", "norm", "scale", "max", "limit", "along", "across",
    "normal", "offset", "bias", "total",
}  # fmt: skip
"""What names a course, or a size, that is meant to be laid down at the start."""
STATE_WORDS = {"velocity", "vel", "speed", "twist", "gyro", "gravity", "qvel"}
"""What names a measurement, however it is used."""
EPISODES, STEPS = 3, 12  # that are played once more
FEWEST = 2  # episodes in which it is another value: with actions of 0 a robot may stand still
PASSED = (
    ast.BinOp | ast.UnaryOp | ast.Call | ast.List | ast.Tuple | ast.Dict | ast.Starred | ast.keyword | ast.Subscript
)


@dataclasses.dataclass(frozen=True, eq=False)
class StartReading:
    """A value of the start that the observation shows."""

    assignment: Assignment
    value: Expression
    read: Expression


class StartReadings:
    """Those of a source."""

    def __init__(self, noted: NotedEpisodes) -> None:
        self.noted, self.definitions, self.source = noted, noted.definitions, noted.source

    def find(self) -> Iterator[StartReading]:
        """Yield the values that the same expression no longer has after some steps."""
        candidates = dict(self._list_candidates())
        if not candidates:
            return
        counts = dict.fromkeys(candidates, 0)
        for number in range(min(EPISODES, len(self.noted.episodes))):
            watch = RepeatWatch(self.noted, list(candidates))
            with watch:
                self.noted.play(number, min(STEPS, len(self.noted.episodes[number]) - 1), {})
            for one in candidates:
                kept, now = watch.read_latest(one)
                counts[one] += kept is not None and now is not None and differ(kept, now)
        for one, read in candidates.items():
            if counts[one] >= FEWEST:
                yield StartReading(one.assignment, one.value, read)

    def _list_candidates(self) -> Iterator[tuple[Repeatable, Expression]]:
        early = self.noted.share(EarlyReadings)
        for key, assignments in self.definitions.assigned.items():
            of_resets = [one for one in assignments if one.function in self.noted.of_resets]
            is_set = any(one.function in self.noted.of_steps for one in assignments)
            is_meant = read_words(key) & (FIRST_WORDS | MEANT_WORDS | NOMINAL_WORDS | COURSE_WORDS)
            if len(of_resets) != 1 or is_set or is_meant:
                continue
            one = of_resets[0]
            if not is_relative(self.definitions.list_sources(one.value, one.function)):
                continue
            read, repeatable = self._find_read(key), early.open(key, one)
            if read is not None and repeatable is not None:
                yield repeatable, read

    @functools.cached_property
    def _roots(self) -> list[ast.expr]:
        return self.noted.observed.nodes

    def _find_read(self, key: str) -> Expression | None:
        """Return where the observation shows an attribute by itself, as it is or scaled."""
        roots, seen = list(self._roots), set[ast.AST]()
        while roots:
            root = roots.pop()
            if root in seen:
                continue
            seen.add(root)
            for node in ast.walk(root):
                found = self.source.find(node)
                is_state = bool(read_words(key) & STATE_WORDS)
                if isinstance(node, ast.Name) and self._is_shown(node, root, is_state):
                    roots += [*self.definitions.read(node), *self.definitions.read_parts(node)]
                is_read = isinstance(node, ast.Attribute) and read_key(node) == key and found is not None
                if is_read and self._is_shown(node, root, is_state):
                    return found
        return None

    def _is_shown(self, node: ast.AST, root: ast.AST, is_state: bool) -> bool:
        """Say whether what an expression is worth is that of a part of it, as it is or scaled."""
        while node is not root and not is_state:
            above = self.source.parents[node]
            match above:
                case ast.BinOp(op=ast.Add() | ast.Mult()) | ast.Subscript():
                    pass
                case ast.BinOp(left=left, op=ast.Div()) if left is node:
                    pass
                case ast.Call(func=called) if read_name(called) in self.definitions.functions:
                    return False
                case ast.BinOp() | ast.Compare() | ast.IfExp() | ast.comprehension():
                    return False
            node = above
        return True
