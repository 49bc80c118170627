"""Reads of the first of several goals where others go on to the next ones."""

import ast
from collections.abc import Iterator

from rlctl.checking.assignments import Assignment, peel, read_key, read_name, read_words
from rlctl.checking.experiments.expressions import NotedEpisodes
from rlctl.checking.previous_values import is_goal
from rlctl.checking.source_code import Expression
from rlctl.checking.stale_values import FIRST_WORDS, StaleCopy
from rlctl.checking.term_names import split_name

PLAN_WORDS = {"plan", "schedule", "commands", "route", "poses", "points", "stages", "phases"}


class FirstGoals:
    """Finds them."""

    def __init__(self, noted: NotedEpisodes) -> None:
        self.noted, self.definitions, self.source = noted, noted.definitions, noted.source
        self._evaluated = {number for call in noted.steps for number in call.values}
        self._entries = [one for one in self.source.expressions if self._is_entry(one)]

    def _is_entry(self, one: Expression) -> bool:
        """Say whether an expression is an entry of an attribute that has goals, and steps read it."""
        key = read_key(one.node) if isinstance(one.node, ast.Subscript) else ""
        is_named = is_goal(key) or bool({*split_name(key)} & PLAN_WORDS)
        return is_named and one.number in self._evaluated and one.function in self.noted.of_steps

    def find(self) -> Iterator[StaleCopy]:
        """Yield reads of the first entry, and of copies of it that only resets make."""
        going = {read_key(one.node): one for one in self._entries if self._is_counted(one) or self._is_chosen(one)}
        for key, which in going.items():
            goal = ast.unparse(self._find_choice(which))
            first = [one for one in self._entries if read_key(one.node) == key and _read_index(one.node) == 0]
            for one in first:
                if not self._is_chosen(one) and not self._shows_others(one, key):
                    yield StaleCopy(one.text, goal, one)
                    return
            for copy, read in self._list_copies(key):
                yield StaleCopy(copy, goal, read)
                return

    def _is_counted(self, one: Expression) -> bool:
        """Say whether a step moves what an index is computed from."""
        assert isinstance(one.node, ast.Subscript)
        reads = self.definitions.list_reads(one.node.slice, one.function)
        several = [other for key in reads for other in self.definitions.assigned.get(key, ())]
        return any(other.function in self.noted.of_steps for other in several)

    def _is_chosen(self, one: Expression) -> bool:
        return self._find_choice(one) is not one.node

    def _find_choice(self, one: Expression) -> ast.expr:
        """Return the choice of which an entry is one side; else the entry."""
        above = self.source.parents[one.node]
        is_where = isinstance(above, ast.Call) and read_name(above.func) == "where" and one.node in above.args[1:]
        is_side = isinstance(above, ast.IfExp) and one.node is not above.test
        return above if is_where or is_side else one.node  # type: ignore[return-value]

    def _shows_others(self, one: Expression, key: str) -> bool:
        """Say whether the same function also reads another entry by its number, or goes through all."""
        others = [other for other in self._entries if other.function is one.function and read_key(other.node) == key]
        return any(_read_index(other.node) not in (0, None) for other in others if not self._is_chosen(other))

    def _list_copies(self, key: str) -> Iterator[tuple[str, Expression]]:
        """Yield the attributes that only resets set to the first entry, and where steps read them."""
        for copy, assignments in self.definitions.assigned.items():
            is_set = any(one.function in self.noted.of_steps for one in assignments)
            of_resets = [one for one in assignments if one.function in self.noted.of_resets]
            if is_set or len(of_resets) != 1 or read_words(copy) & FIRST_WORDS or copy == key:
                continue
            if not self._takes_first(of_resets[0], key):
                continue
            for read in self.source.expressions:
                if read_key(read.node) == copy and read.number in self._evaluated:
                    yield copy, read
                    break

    def _takes_first(self, one: Assignment, key: str) -> bool:
        node = peel(one.value)
        if not isinstance(node, ast.Subscript) or _read_index(node) != 0:
            return False
        if read_key(node) == key and not isinstance(node.value, ast.Name):
            return True
        names = {ast.unparse(other.value) for other in self.definitions.assigned[key] if other.function is one.function}
        return ast.unparse(node.value) in names


def _read_index(node: ast.expr) -> int | None:
    """Return which entry a constant index takes, of all worlds or of some: `goals[0]`, `goals[:, 0]`."""
    if not isinstance(node, ast.Subscript):
        return None
    match node.slice:
        case ast.Constant(value=int(number)):
            return number
        case ast.UnaryOp(op=ast.USub(), operand=ast.Constant(value=int(number))):
            return -number
        case ast.Tuple(elts=[ast.Slice() | ast.Name(id="worlds"), ast.Constant(value=int(number)), *_]):
            return number
    return None
