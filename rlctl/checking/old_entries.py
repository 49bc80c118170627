"""Ways to a goal from the oldest entry of a history, where the newest one is where the robot is."""

import ast
import dataclasses
from collections.abc import Iterator

import numpy as np

from rlctl.checking.assignments import list_name_words, read_key, read_words
from rlctl.checking.experiments.expressions import NotedEpisodes
from rlctl.checking.late_readings import DONE_WORDS
from rlctl.checking.previous_values import is_goal, read_sides
from rlctl.checking.source_code import Expression, Function
from rlctl.checking.term_names import ACTION_WORDS

DELAY_WORDS = {"delay", "delayed", "lag", "latency", "queue", "fifo", "pending", "start", "first"}
OLDEST = {"append": 0, "appendleft": -1}
"""The place of the oldest entry, by what adds the newest one."""
FEWEST, MOSTLY = 20, 0.8  # steps in which the robot moves, and the part of them in which the oldest entry is another


@dataclasses.dataclass(frozen=True, eq=False)
class OldEntry:
    """The oldest entry of a history, from which a way to a goal is taken."""

    read: Expression
    way: Expression
    key: str


class OldEntries:
    """Finds them."""

    def __init__(self, noted: NotedEpisodes) -> None:
        self.noted, self.definitions, self.source = noted, noted.definitions, noted.source

    def find(self) -> Iterator[OldEntry]:
        """Yield reads of the oldest entry that are not the newest in most steps."""
        for name, place in OLDEST.items():
            for call, function in self.definitions.calls[name]:
                if not isinstance(call.func, ast.Attribute) or function not in self.noted.of_steps or not call.args:
                    continue
                key, added = read_key(call.func.value), self.source.find(call.args[0])
                words = read_words(key) | list_name_words(call.args[0])
                if not key or added is None or words & (DELAY_WORDS | DONE_WORDS | ACTION_WORDS):
                    continue
                for read in self._list_reads(key, place):
                    way = self._find_way(read, key) if self._is_old(read, added) else None
                    if way is not None:
                        yield OldEntry(read, way, key)

    def _list_reads(self, key: str, place: int) -> Iterator[Expression]:
        for one in self.source.expressions:
            match one.node:
                case ast.Subscript(value=ast.Attribute(), slice=index) if read_key(one.node) == key:
                    if ast.unparse(index) == str(place):
                        yield one

    def _is_old(self, read: Expression, added: Expression) -> bool:
        """Say whether an entry is another one than what the same step has added."""
        pairs = [
            (call.values[read.number][-1], call.values[added.number][-1])
            for call in self.noted.steps
            if read.number in call.values and added.number in call.values
        ]
        others = [one is None or other is None or not np.array_equal(one, other) for one, other in pairs]
        return len(pairs) >= FEWEST and all(one is not None for one, _ in pairs) and bool(np.mean(others) > MOSTLY)

    def _find_way(self, read: Expression, key: str) -> Expression | None:
        """Return a difference of the entry and a goal."""
        for one in self.source.expressions:
            sides = read_sides(one.node)
            for side, other in (sides, sides[::-1]) if sides else ():
                is_entry = self.definitions.find_origin(side, one.function) is read.node
                if is_entry and self._is_to_goal(other, one.function, key):
                    return one
        return None

    def _is_to_goal(self, node: ast.expr, function: Function, key: str) -> bool:
        reads = self.definitions.list_reads(node, function)
        return any(is_goal(one) for one in reads) and key not in reads
