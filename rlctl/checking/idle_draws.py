"""What a reset draws, and that nothing reads, or that changes nothing that follows."""

import ast
import functools
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from rlctl.checking.assignments import read_key, read_name, read_words
from rlctl.checking.definitions import ReadExpression
from rlctl.checking.episode import Moment
from rlctl.checking.experiments.expressions import NotedEpisodes
from rlctl.checking.expressions import Value
from rlctl.checking.goal_draws import has_draw, is_draw, is_drawn
from rlctl.checking.goal_starts import UNUSED
from rlctl.checking.hinged_bases import has_engine
from rlctl.checking.previous_values import is_goal
from rlctl.checking.source_code import Expression, FaultyCode, Function, write_code
from rlctl.checking.term_names import split_name
from rlctl.checking.values import flatten

PHYSICAL_WORDS = {
    "wind", "current", "friction", "mass", "payload", "grip", "drag", "damping", "disturbance", "slope", "inertia",
    "stiffness", "tide", "flow", "mu", "viscosity", "density", "buoyancy", "ballast", "traction",
}  # fmt: skip
"""What decides how a robot moves."""
KEPT_WORDS = PHYSICAL_WORDS | {"bias", "backlash", "deadband"}
MEASURED_WORDS = {"bias", "noise", "sensor", "measured", "estimated", "std"}
STEPS, EPISODES = 30, 2  # that are played with other draws
FEWEST = 10  # steps of an episode that ends
PLACING = {"resetJointState", "resetBasePositionAndOrientation", "resetBaseVelocity", "resetJointStatesMultiDof"}
PLACED = {"qpos", "qvel"}  # of MuJoCo
SET_BACK = {"mj_resetData", "mj_resetDataKeyframe", "resetSimulation", "restoreState"}
"""What sets back the whole world."""
MOST_TRIED = 4


class IdleDraws:
    """Finds them."""

    def __init__(self, noted: NotedEpisodes) -> None:
        self.noted, self.definitions, self.source = noted, noted.definitions, noted.source
        self._functions = [one for one in noted.of_resets if isinstance(one, Function) and one.name != "__init__"]

    def find(self) -> Iterator[FaultyCode]:
        """Yield what is computed for nothing, then draws that nothing reads, then those that change nothing."""
        yield from self._find_lost()
        yield from self._find_set_back()
        yield from self._find_unread()
        yield from self._find_idle()

    def _find_lost(self) -> Iterator[FaultyCode]:
        """Yield statements that are only an expression, such as `a * b` or `a == b` instead of an assignment."""
        for function in self.noted.functions:
            for node in ast.walk(function):
                if isinstance(node, ast.Expr) and _is_lost(node.value):
                    what = f"{write_code(node)}: it is computed, and nothing gets it"
                    yield FaultyCode(node, what, self.source.find_place(node))

    def _find_set_back(self) -> Iterator[FaultyCode]:
        """Yield calls that set back the world after the robot was placed in it, and not again afterwards."""
        for function in self._functions:
            backs = [
                statement
                for statement in function.body
                if isinstance(statement, ast.Expr)
                and isinstance(statement.value, ast.Call)
                and read_name(statement.value.func) in SET_BACK
            ]
            if not backs:
                continue
            place = function.body.index(backs[-1])
            before = [one for one in function.body[:place] if self._places(one, function)]
            before = [one for one in before if is_drawn(self.definitions, one, function)]
            after = [one for one in function.body[place + 1 :] if self._places(one, function)]
            if before and not after:
                what = f"{write_code(backs[-1])} sets back what {write_code(before[-1])} has placed"
                yield FaultyCode(backs[-1], what, self.source.find_place(backs[-1]))

    def _places(self, statement: ast.stmt, function: Function) -> bool:
        """Say whether a statement places something, also in functions that it calls."""
        for top, _ in self.definitions.list_sources(statement, function):
            for node in ast.walk(top):
                is_field = isinstance(node, ast.Attribute) and node.attr in PLACED
                if is_field and self._is_stored(node):
                    return True
                if isinstance(node, ast.Call) and read_name(node.func) in PLACING | {"set_state"}:
                    return True
        return False

    def _is_stored(self, node: ast.AST) -> bool:
        above = self.source.parents[node]
        return isinstance(above, ast.Subscript) and above.value is node and isinstance(above.ctx, ast.Store)

    def _find_unread(self) -> Iterator[FaultyCode]:
        for function in self._functions:
            for text, several in self.definitions.list_assigned(function).items():
                one = several[0]
                if one.is_part or not is_drawn(self.definitions, one.statement, function):
                    continue
                if isinstance(one.target, ast.Name):
                    is_drawn_here = has_draw(one.value)
                    is_unread = is_drawn_here and self._is_name_unread(function, text)
                else:
                    key = read_key(one.target)
                    is_unread = bool(read_words(key) & KEPT_WORDS) and not self._is_attribute_read(key)
                if is_unread:
                    what = f"{write_code(one.statement)}: it is drawn, and nothing reads it"
                    yield FaultyCode(one.statement, what, self.source.find_place(one.statement))

    def _is_physical(self, keys: set[str]) -> bool:
        words = {word for key in keys for word in split_name(key)}
        return bool(words & PHYSICAL_WORDS) and not words & MEASURED_WORDS

    def _is_name_unread(self, function: Function, name: str) -> bool:
        """Say whether nothing reads a local name; RL306 has goals."""
        nodes = [node for node in ast.walk(function) if isinstance(node, ast.Name) and node.id == name]
        is_read = any(isinstance(node.ctx, ast.Load) for node in nodes)
        is_outer = any(isinstance(node, ast.Global | ast.Nonlocal) for node in ast.walk(function))
        return not is_read and not is_outer and name not in UNUSED and not name.startswith("_") and not is_goal(name)

    def _is_attribute_read(self, key: str) -> bool:
        return any(read_key(one.node) == key for one in self.source.expressions) or self._is_unpacked_elsewhere(key)

    def _is_unpacked_elsewhere(self, key: str) -> bool:
        """Say whether the source reads attributes by their names as texts."""
        texts = [
            node.value
            for tree in self.source.trees.values()
            for node in ast.walk(tree)
            if isinstance(node, ast.Constant)
        ]
        return key in texts

    def _find_idle(self) -> Iterator[FaultyCode]:
        """Yield draws of what decides how the robot moves, with which an episode pays the same whatever they are."""
        tried = 0
        for one in self.source.expressions:
            if one.function not in self._functions or not is_draw(one.node) or tried == MOST_TRIED:
                continue
            keys = self._list_keys(one)
            words = {word for key in keys for word in read_words(key)}
            is_mass = bool(words & {"mass", "payload"})
            if not self._is_physical(keys) or (self._has_engine and not is_mass):
                continue
            values = self._read(one)
            if values is None:
                continue
            tried += 1
            if self._changes_nothing(one, values):
                statement = self.source.find_statement(one.node)
                what = f"{write_code(statement)}: with other draws {EPISODES} episodes of {STEPS} steps have the same"
                what += " rewards and ends: it is never applied"
                yield FaultyCode(statement, what, one.where)

    @functools.cached_property
    def _has_engine(self) -> bool:
        return has_engine(self.noted.instance)

    def _list_keys(self, draw: Expression) -> set[str]:
        """Return what is set from a draw: names, attributes, and the words of the calls that get it."""
        found = set[str]()
        for function in self._functions:
            for one in (part for several in self.definitions.list_assigned(function).values() for part in several):
                place = ReadExpression(one.value, one.function)
                if any(inner.node is draw.node for inner in self.definitions.walk(place)):
                    found.add(read_key(one.target) or ast.unparse(one.target))
        return found

    def _read(self, draw: Expression) -> list[Value] | None:
        """Return what was drawn in each reset; None unless it was drawn once in each, and no loop draws again."""
        node: ast.AST = draw.node
        while not isinstance(node, Function):
            if isinstance(node, ast.While | ast.For):
                return None
            node = self.source.parents[node]
        values = [episode[0].values.get(draw.number, []) for episode in self.noted.episodes]
        if len(values) < EPISODES + 1 or any(len(one) != 1 or one[0] is None for one in values):
            return None
        return [one[0] for one in values]

    def _changes_nothing(self, draw: Expression, values: Sequence[Value]) -> bool:
        """Say whether episodes pay the same, and end at once, with what another reset has drawn."""
        moving = False
        for number in range(EPISODES):
            played = [
                self.noted.play(number, STEPS, {0: {draw.number: _thaw(value)}})
                for value in (values[number], values[number + 1])
            ]
            one, other = ([moment for _, moment in episode] for episode in played)
            if len(one) < FEWEST or [*map(_pay, one)] != [*map(_pay, other)]:
                return False
            if self._has_engine and not _see_same(one, other):
                return False
            moving |= len({_pay(moment) for moment in one[1:]}) > len(one) // 2
        return moving


def _is_lost(node: ast.expr) -> bool:
    """Say whether nothing gets what an operator computes; `done and self.log()` is a condition of a call."""
    if isinstance(node, ast.BoolOp):
        return not any(isinstance(part, ast.Call | ast.NamedExpr) for one in node.values[1:] for part in ast.walk(one))
    return isinstance(node, ast.BinOp | ast.Compare)


def _thaw(value: Value) -> Any:
    return value.copy() if isinstance(value, np.ndarray) else value


def _pay(moment: Moment) -> tuple[float, bool, bool]:
    return (moment.reward_number, *moment.flags)


def _see_same(one: Sequence[Moment], other: Sequence[Moment]) -> bool:
    return all(
        np.array_equal(flatten(before.observation), flatten(after.observation), equal_nan=True)
        for before, after in zip(one, other, strict=True)
    )
