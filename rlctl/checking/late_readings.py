"""Values that a step reads before it has moved the robot, and that the observation or the reward has afterwards."""

import ast
import dataclasses
import functools
import itertools
import re
from collections.abc import Iterator, Sequence

import numpy as np

from rlctl.checking.assignments import Assignment, list_name_words, list_parameters, read_key, read_name, read_words
from rlctl.checking.definitions import ReadExpression
from rlctl.checking.early_readings import CHANCE_WORDS, CLOCKS, PHYSICS
from rlctl.checking.experiments.expressions import NotedEpisodes
from rlctl.checking.expressions import Value
from rlctl.checking.previous_values import PREVIOUS_WORDS, TIME_NAMES, is_goal, read_sides
from rlctl.checking.source_code import Expression
from rlctl.checking.term_names import ACTION_WORDS, split_name

ENTRIES = {"step", "act"}  # of an environment, which moves the robot itself; of a task, before the robot moves
MEANT_WORDS = {
    *("delay", "delayed", "fifo", "lag", "latency", "pending", "queue", "history", "buffer", "start", "begin", "entry"),
    *("initial", "was", "were", "had", "filtered", "smooth", "smoothed", "mean", "average", "planned", "reference"),
    *PREVIOUS_WORDS,
}
"""What names a value that is meant to be older."""
DONE_WORDS = {"action", "actions", "torque", "torques", "ctrl", "effort"}
STATES = {"qpos", "qvel", "mocap", "xfrc", "qfrc"}  # of MuJoCo
ENGINE = (
    r"\b(qpos|qvel|qacc|xi?pos|xquat|xmat|cvel|sensordata|(site|geom)_x\w+|subtree_\w+|get(Base|Link|Joint|Contact)\w+"
    r"|mj_object\w+|mj_contactForce|ncon|data\.contact|(base|link)_(position|orientation|velocity|angular_velocity)|joint_(positions|velocities))\b"
)
"""What MuJoCo, PyBullet and the robots of tasks return of the state."""
TURNS = {"cos", "sin", "arctan2", "atan2", "rotate", "rotate_inverse", "matmul", "dot", "einsum"}
DEEPEST = 3  # attributes that are computed from others
FEWEST, MOST_CALLS = 20, 60  # steps
NEARLY_ALL, SOME = 0.9, 0.1  # parts of them
SAME = 1e-9  # relative


@dataclasses.dataclass(frozen=True, eq=False)
class LateReading:
    """A value that is one step old where it is used."""

    value: Expression
    read: Expression


@dataclasses.dataclass(frozen=True, eq=False)
class _Pair:
    """What a value was worth in a step and in the next one, before the robot was moved, and what was evaluated in the
    first one after that."""

    later: Sequence[tuple[int, Value]]
    old: Value
    new: Value


class LateReadings:
    """Those of a source."""

    def __init__(self, noted: NotedEpisodes) -> None:
        self.noted, self.definitions = noted, noted.definitions
        self._functions = [one for one in noted.functions if one in noted.of_steps]
        entries = [one for one in self._functions if one.name in ENTRIES]
        self._parameters = {(one, name) for one in entries for name in list_parameters(one)}
        is_task = not any(one.name == "step" for one in entries)
        self._moves = {
            one.number
            for one in noted.source.expressions
            if (is_task and one.function.name == "act")
            or (isinstance(one.node, ast.Call) and read_name(one.node.func) in PHYSICS)
        }

    def find(self) -> Iterator[LateReading]:
        """Yield what only the state before the step decides."""
        for function in self._functions:
            for several in self.definitions.list_assigned(function).values():
                one = several[-1]
                value = self._find_value(one)
                if len(several) == 1 and value is not None and self._may_be_late(one):
                    pairs = self._list_pairs(value, one)
                    if len(pairs) >= FEWEST and not self._is_read_again(one, pairs):
                        yield from self._find_uses(one, value, pairs)

    def _find_value(self, one: Assignment) -> Expression | None:
        """Return the expression whose numbers are assigned."""
        if one.is_part or one.added:
            return None
        parts = self.definitions.select(ReadExpression(one.value, one.function), one.element)
        return self.noted.source.find(parts[0].node) if len(parts) == 1 else None

    def _may_be_late(self, one: Assignment) -> bool:
        """Say whether a value follows from the state alone: from no action, no time, and not from what it was."""
        name = read_key(one.target) or read_name(one.target)
        sources = self.definitions.list_sources(one.value, one.function)
        is_meant = bool(read_words(name) & (MEANT_WORDS | ACTION_WORDS | TIME_NAMES))
        if not name or is_meant or (is_goal(name) and not is_relative(sources)):
            return False
        if any(self._is_meant(top, function) for top, function in sources):
            return False
        return name not in self._list_reads(one) and (bool(self._list_own_moves(one)) or self._reads_engine(one))

    def _list_reads(self, one: Assignment) -> set[str]:
        """Return the keys of the attributes that a value is computed from, also of what is unpacked for it."""
        tops = [one.value, *self._list_unpacked(one)]
        return {key for top in tops for key in self.definitions.list_reads(top, one.function)}

    def _list_unpacked(self, one: Assignment) -> Iterator[ast.expr]:
        """Yield what the names of a value are unpacked from, and the calls that are given them to write into."""
        names = {
            node.id
            for top, function in self.definitions.list_sources(one.value, one.function)
            for node in ast.walk(top)
            if isinstance(node, ast.Name) and function is one.function
        }
        for name in names:
            yield from (other.value for other in self.definitions.list_assigned(one.function).get(name, ()))
        for node in ast.walk(one.function):
            if isinstance(node, ast.Call) and any(isinstance(arg, ast.Name) and arg.id in names for arg in node.args):
                yield node

    def _reads_engine(self, one: Assignment) -> bool:
        """Say whether a value is computed from what an engine moves."""
        tops = [one.value, *self._list_unpacked(one)]
        return any(
            re.search(ENGINE, ast.unparse(inner))
            for top in tops
            for inner, _ in self.definitions.list_sources(top, one.function)
        )

    @functools.cached_property
    def _driven(self) -> set[str]:
        """The keys of the attributes that steps compute from the action, or from others that they do, or read from the
        engine."""
        assigned = [
            (key, {name for top, _ in sources for name in list_name_words(top)}, reads)
            for key, several in self.definitions.assigned.items()
            for one in several
            if one.function in self.noted.of_steps
            for sources in [self.definitions.list_sources(one.value, one.function)]
            for reads in [self._list_reads(one)]
        ]
        driven = {key for key, words, _ in assigned if words & DONE_WORDS}
        driven |= {
            key
            for key, several in self.definitions.assigned.items()
            for one in several
            if one.function in self.noted.of_steps and one.element is None and self._reads_engine(one)
        }
        for call, _ in self.definitions.calls["append"] + self.definitions.calls["put"]:  # to a queue
            if isinstance(call.func, ast.Attribute) and any(list_name_words(arg) & DONE_WORDS for arg in call.args):
                driven.add(read_key(call.func.value))
        for _ in range(DEEPEST):
            driven |= {key for key, _, reads in assigned if reads & driven}
        return driven

    def _is_meant(self, top: ast.AST, function: ast.AST) -> bool:
        """Say whether code has an action, chance or the time."""
        nodes = list(ast.walk(top))
        if any((function, node.id) in self._parameters for node in nodes if isinstance(node, ast.Name)):
            return True
        names = [read_name(node.func) for node in nodes if isinstance(node, ast.Call)]
        drawn = any({*split_name(name)} & CHANCE_WORDS for name in names)
        return drawn or bool(CLOCKS & {*names}) or bool(list_name_words(top) & DONE_WORDS)

    def _list_pairs(self, value: Expression, one: Assignment) -> list[_Pair]:
        """Return steps in which the value is computed once, before the robot is moved, and other than in the next
        one."""
        own = self._list_own_moves(one)
        if any(value.node in ast.walk(self.noted.source.expressions[number].node) for number in own):
            return []  # it is what the robot is moved to
        moves, is_copied = own or self._moves, bool(own) and not self._reads_engine(one)
        found: list[_Pair] = []
        for episode in self.noted.episodes:
            for call, following in itertools.pairwise(episode[1:]):
                old, new = call.values.get(value.number, []), following.values.get(value.number, [])
                numbers = [number for number, _ in call.events]
                moved = max((place for place, number in enumerate(numbers) if number in moves), default=-1)
                if len(old) != 1 or len(new) != 1 or old[0] is None or new[0] is None:
                    continue
                by_engine = max((place for place, number in enumerate(numbers) if number in self._moves), default=moved)
                if numbers.index(value.number) > (moved if is_copied else min(moved, by_engine)):
                    return []
                if not _is_same(old[0], new[0]):
                    found.append(_Pair(call.events[moved + 1 :], old[0], new[0]))
        return found[:: max(1, len(found) // MOST_CALLS)]

    def _list_own_moves(self, one: Assignment) -> set[int]:
        """Return the expressions that steps assign to what a value is computed from, but for an engine's arrays."""
        keys = self._list_reads(one)
        others = TIME_NAMES | ACTION_WORDS | STATES | PREVIOUS_WORDS
        keys = {key for key in keys & self._driven if not read_words(key) & others and not is_goal(key)}
        own = [other for key in keys for other in self.definitions.assigned.get(key, ())]
        values = [self.noted.source.find(other.value) for other in own if other.function in self.noted.of_steps]
        return {value.number for value in values if value is not None}

    def _is_read_again(self, one: Assignment, pairs: Sequence[_Pair]) -> bool:
        """Say whether the observation, or a difference to the value, also has the present value: it is no mistake to
        keep the one before."""
        used = self._observed | {node for _, node in self._list_differences(one)}
        numbers = {found.number for node in used if (found := self.noted.source.find(node)) is not None}
        hits = [any(which in numbers and _is_same(value, pair.new) for which, value in pair.later) for pair in pairs]
        return bool(np.mean(hits) > SOME)

    def _list_differences(self, one: Assignment) -> Iterator[tuple[ast.expr, ast.expr]]:
        """Yield the two sides of the differences to what is assigned."""
        for whole in self.noted.source.expressions:
            sides = read_sides(whole.node)
            for kept, other in (sides, sides[::-1]) if sides else ():
                if any(self._reads(node, whole.function, one) for node in ast.walk(kept)):
                    yield kept, other

    def _reads(self, node: ast.AST, function: ast.AST, one: Assignment) -> bool:
        if isinstance(one.target, ast.Name):
            return isinstance(node, ast.Name) and node.id == one.target.id and function is one.function
        return isinstance(node, ast.Attribute | ast.Subscript) and read_key(node) == read_key(one.target)

    def _find_uses(self, one: Assignment, value: Expression, pairs: Sequence[_Pair]) -> Iterator[LateReading]:
        """Yield where the value is read after the robot was moved."""
        for read in self.noted.source.expressions:
            if read.node in self._observed and self._reads(read.node, read.function, one):
                hits = [
                    any(which == read.number and _is_same(found, pair.old) for which, found in pair.later)
                    for pair in pairs
                ]
                if np.mean(hits) > NEARLY_ALL:
                    yield LateReading(value, read)
                    return

    @functools.cached_property
    def _observed(self) -> set[ast.AST]:
        """The code of which the observation is made, also what is subtracted or turned for it, and what its local names
        stand for."""
        waiting = list(self.noted.observed.nodes)
        found = set[ast.AST]()
        while waiting:
            node = waiting.pop()
            if node not in found:
                found.add(node)
                waiting += [part for part in ast.walk(node) if isinstance(part, ast.expr) and part not in found]
                if isinstance(node, ast.Name):
                    waiting += [*self.definitions.read(node), *self.definitions.read_parts(node)]
        return found


def is_relative(sources: Sequence[tuple[ast.AST, ast.AST]]) -> bool:
    """Say whether a value is a difference, or is turned, by what it is computed from: seen from something."""
    return any(
        (isinstance(node, ast.BinOp) and isinstance(node.op, ast.Sub | ast.MatMult))
        or (isinstance(node, ast.Call) and read_name(node.func) in TURNS)
        for top, _ in sources
        for node in ast.walk(top)
    )


def _is_same(one: Value, other: Value) -> bool:
    if one is None or other is None or np.shape(one) != np.shape(other):
        return False
    return bool(np.allclose(one, other, rtol=SAME, atol=SAME))
