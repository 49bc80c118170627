"""Which numbers of a command, or a goal, the source of a reward compares with what."""

import ast
import dataclasses
from collections.abc import Iterator, Sequence

import numpy as np

from rlctl.checking.assignments import list_name_words, read_name
from rlctl.checking.definitions import ReadExpression
from rlctl.checking.experiments.expressions import NotedEpisodes
from rlctl.checking.lengths import read_vector
from rlctl.checking.paid_errors import COMMAND_WORDS, WANTED_WORDS, ErrorReader, has_both_signs
from rlctl.checking.summands import Summand
from rlctl.checking.term_names import split_name

ANGULAR_WORDS = {"ang", "angular", "angvel", "gyro", "gyroscope", "omega", "rates"}
LINEAR_WORDS = {"lin", "linear", "linvel", "v", "vel", "velocity", "velocities"}
TURN_AXES = {"roll": 0, "wx": 0, "pitch": 1, "wy": 1, "yaw": 2, "turn": 2, "turning": 2, "heading": 2, "wz": 2}
WAY_AXES = {"vx": 0, "vy": 1, "lateral": 1, "sideways": 1, "vz": 2}
AXES = "xyz"
FEWEST_ALIKE = 2
LENGTHS = {"norm", "hypot"}


@dataclasses.dataclass(frozen=True, eq=False)
class Compared:
    """A number of a command, and what a summand of the reward compares it with."""

    summand: Summand
    command: str
    index: int
    other: ReadExpression
    place: ReadExpression  # of the difference


class CommandReader:
    """Finds what a reward compares with the numbers of commands."""

    def __init__(self, notes: NotedEpisodes) -> None:
        self.notes = notes
        self.errors = notes.share(ErrorReader)
        self.definitions = notes.reward.definitions
        self.walked = [(one, list(self.definitions.walk(one.place))) for one in notes.reward.summands]
        self.walked += [(one, list(self.definitions.walk(one.place))) for one in notes.reward.differences]

    def list_compared(self) -> Iterator[Compared]:
        """Yield the differences that have a number of a command on one side."""
        for summand, places in self.walked:
            for place in places:
                match place.node:
                    case ast.BinOp(left=left, op=ast.Sub(), right=right):
                        for side, other in ((left, right), (right, left)):
                            found = self.read_index(place.at(side))
                            if found is not None:
                                yield Compared(summand, *found, place.at(other), place)

    def read_index(self, place: ReadExpression) -> tuple[str, int] | None:
        """Return which number of which command an expression is; None if it is none."""
        for _ in range(4):
            node = place.node
            if isinstance(node, ast.Name):
                before = self.definitions.list_before(place)
                if len(before) == 1 and before[0].element is not None:
                    owner = self.definitions.resolve(place.at(before[0].value)).node
                    owner = before[0].value if not isinstance(owner, ast.Name | ast.Attribute) else owner
                    return (ast.unparse(owner), before[0].element) if _is_command(owner) else None
            index = read_last_index(node)
            if index is not None and isinstance(node, ast.Subscript):
                owner = self.definitions.resolve(place.at(node.value)).node
                owner = node.value if not isinstance(owner, ast.Name | ast.Attribute) else owner
                return (ast.unparse(owner), index) if _is_command(owner) or _is_command(node.value) else None
            found = self.definitions.follow(place)
            if len(found) != 1:
                return None
            place = found[0]
        return None

    def find_unpaid(self) -> Iterator[tuple[list[Compared], int]]:
        """Yield the differences with the same number of a command, while another of its numbers is in none."""
        compared = list({one.place.node: one for one in self.list_compared()}.values())
        for command in {one.command: None for one in compared}:
            used = [one for one in compared if one.command == command]
            rows = self._read_rows(command)
            if rows is None or self._is_used_whole(command):
                continue
            paid = self._list_paid(command)
            unpaid = [i for i in range(rows.shape[1]) if i not in paid and np.ptp(rows[:, i]) > 0]
            for index in sorted({one.index for one in used}):
                same = [one for one in used if one.index == index]
                others = {ast.unparse(self.definitions.resolve(one.other).node) for one in same}
                if len(others) >= FEWEST_ALIKE and len({one.summand.name for one in same}) >= FEWEST_ALIKE and unpaid:
                    yield same, unpaid[0]

    def _read_rows(self, command: str) -> np.ndarray | None:
        """Return what a command was worth wherever it is used as a whole, shape (n, numbers)."""
        rows: list[np.ndarray] = []
        for one in self.notes.source.expressions:
            if one.text == command:
                for call in self.notes.steps:
                    rows += [np.atleast_2d(v) for v in call.values.get(one.number, ()) if isinstance(v, np.ndarray)]
        rows = [row for row in rows if row.ndim == 2 and row.shape[1] == rows[0].shape[1]]
        return np.concatenate(rows) if rows and rows[0].shape[1] > 1 else None

    def _list_paid(self, command: str) -> set[int]:
        """Return the numbers of a command that the reward is computed from, and not only compared with limits."""
        found: set[int] = set()
        for _, places in self.walked:
            for place in places:
                index = self.read_index(place)
                if index is not None and index[0] == command and not self._is_in_comparison(place.node):
                    found.add(index[1])
        return found

    def _is_in_comparison(self, node: ast.AST) -> bool:
        while isinstance(node, ast.expr):
            if isinstance(node, ast.Compare):
                return True
            node = self.notes.source.parents[node]
        return False

    def _is_used_whole(self, command: str) -> bool:
        parents = self.notes.source.parents
        for _, places in self.walked:
            for place in places:
                if ast.unparse(place.node) == command:
                    parent = parents.get(place.node)
                    is_one = isinstance(parent, ast.Subscript) and read_last_index(parent) is not None
                    is_assigned = isinstance(parent, ast.Assign)  # it is followed from there
                    if not is_one and not is_assigned:
                        return True
                elif isinstance(place.node, ast.Subscript) and read_last_index(place.node) is None:
                    owner = self.definitions.resolve(place.at(place.node.value)).node
                    if ast.unparse(owner) == command:
                        return True
        return False

    def find_lengths(self) -> Iterator[tuple[Summand, ReadExpression]]:
        """Yield differences of the length of a command and another length, if nothing else compares the command."""
        for summand, places in self.walked:
            for place in places:
                match place.node:
                    case ast.BinOp(left=left, op=ast.Sub(), right=right):
                        vectors = [self._read_length(place.at(side)) for side in (left, right)]
                        if None in vectors:
                            continue
                        texts = [one for one in vectors if one is not None]
                        commands = [one for one in texts if self._has_command(one)]
                        values = [self.notes.reward.numbers.list_values(one.node) for one in texts]
                        is_turned = all(has_both_signs(numbers, 0.03) for numbers in values)
                        if len(commands) == 1 and is_turned and not self._is_compared(commands[0]):
                            yield summand, place

    def _read_length(self, place: ReadExpression) -> ReadExpression | None:
        """Return the vector of which an expression is the length."""
        place = self.definitions.resolve(place)
        parts = read_vector(place.node)
        return None if parts is None else place.at(parts[0])

    def _has_command(self, place: ReadExpression) -> bool:
        return any(_is_command(one.node, COMMAND_WORDS) for one in (place, self.definitions.resolve(place)))

    def _is_compared(self, command: ReadExpression) -> bool:
        """Say whether the reward also has a difference or a product with this vector, or its first two numbers."""
        root = self._read_root(command)
        for _, places in self.walked:
            for place in places:
                if isinstance(place.node, ast.BinOp) and not isinstance(place.node.op, ast.Div | ast.Pow):
                    for side in (place.node.left, place.node.right):
                        inside = self.definitions.resolve(place.at(side))
                        index = read_last_index(inside.node)
                        is_vector = isinstance(inside.node, ast.Name | ast.Attribute | ast.Subscript)
                        if is_vector and self._read_root(inside) == root and (index is None or index < FEWEST_ALIKE):
                            return True
        return False

    def _read_root(self, place: ReadExpression) -> str:
        place = self.definitions.resolve(place)
        while isinstance(place.node, ast.Subscript):
            place = self.definitions.resolve(place.at(place.node.value))
        return ast.unparse(place.node)

    def find_other_axes(self) -> Iterator[tuple[Summand, str, str, str]]:
        """Yield differences with a number of a vector along another axis than the names say: what it is called, the
        number, and the axis that is meant."""
        for summand, places in self.walked:
            for place in places:
                match place.node:
                    case ast.BinOp(left=left, op=ast.Sub(), right=right):
                        sides = [place.at(left), place.at(right)]
                        wanted = [side for side in sides if self.errors.is_wanted(side) or self.read_index(side)]
                        for side in sides:
                            if len(wanted) == 1 and side is not wanted[0]:
                                yield from self._find_other_axis(summand, places, place, side)

    def _find_other_axis(
        self, summand: Summand, places: Sequence[ReadExpression], place: ReadExpression, side: ReadExpression
    ) -> Iterator[tuple[Summand, str, str, str]]:
        resolved = self.definitions.resolve(side)
        found = self._read_component(resolved)
        if found is None:
            return
        axes, axis = found
        names = {summand.name, *(read_name(side.node) for side in (place.at(place.node.left), side))}  # type: ignore[attr-defined]
        names |= self._list_targets(place)
        words = {word for name in names for word in split_name(name)}
        meant = {axes[word] for word in words if word in axes}
        if len(meant) == 1 and axis not in meant:
            named = sorted(word for word in words if word in axes)[0]
            yield summand, named, ast.unparse(resolved.node), AXES[meant.pop()]

    def _list_targets(self, place: ReadExpression) -> set[str]:
        statement = self.notes.source.find_statement(place.node)
        targets = statement.targets if isinstance(statement, ast.Assign) else []
        return {read_name(target) for target in targets}

    def _read_component(self, place: ReadExpression) -> tuple[dict[str, int], int] | None:
        """Return by which words the axes of a vector are meant, and along which axis this number of it is."""
        index = read_last_index(place.node)
        if index is None or not isinstance(place.node, ast.Subscript):
            return None
        owner = place.at(place.node.value)
        if read_name(owner.node) == "qvel":
            return (TURN_AXES, index - 3) if 3 <= index < 6 else None
        resolved = self.definitions.resolve(owner)
        words = {word for one in (owner, resolved) for word in split_name(read_name(one.node))}
        if read_name(resolved.node) == "qvel":
            parts = {"3:6": ANGULAR_WORDS, ":3": LINEAR_WORDS, "0:3": LINEAR_WORDS}
            words |= parts.get(ast.unparse(resolved.node).partition("[")[2].rstrip("]"), set())
        if index > 2:
            return None
        if words & ANGULAR_WORDS:
            return TURN_AXES, index
        return (WAY_AXES, index) if words & LINEAR_WORDS else None


def read_last_index(node: ast.AST) -> int | None:
    """Return the constant index of `x[i]`, `x[:, i]` or `x[..., i]`."""
    if not isinstance(node, ast.Subscript):
        return None
    last = node.slice
    if isinstance(last, ast.Tuple) and len(last.elts) == 2 and isinstance(last.elts[0], ast.Slice | ast.Constant):
        if isinstance(last.elts[0], ast.Constant) and last.elts[0].value is not Ellipsis:
            return None
        last = last.elts[1]
    is_index = isinstance(last, ast.Constant) and type(last.value) is int and last.value >= 0
    return last.value if is_index else None  # type: ignore[attr-defined]


def _is_command(node: ast.expr, words: set[str] = WANTED_WORDS) -> bool:
    return bool(list_name_words(node) & words)
