"""Which vectors of the source are in the axes of the world."""

import ast
import dataclasses
import functools
import itertools
import re

import numpy as np
from numpy.typing import NDArray

from rlctl.checking.assignments import list_words, peel
from rlctl.checking.bullet_fields import BulletFields
from rlctl.checking.definitions import Definitions, ReadExpression
from rlctl.checking.term_names import split_name
from rlctl.checking.turned_expressions import VectorTurn
from rlctl.checking.vector_series import FEWEST, MOSTLY, NEARLY_ALL, SAME, Array, VectorSeries
from rlctl.checking.world_places import AXES, FREE_PLACE, PLACE_WORDS, is_of_engine, is_place

OTHER_WORDS = {
    *("vel", "velocity", "speed", "cmd", "command", "commands", "omega", "rate", "qvel", "acc", "force", "torque"),
    *("wanted", "desired", "local", "body", "offset", "error", "err", "lin", "ang", "twist", "gain", "axis"),
}
DRAWN_WORDS = {"sun", "light", "star", "north", "magnetic", "field", "wind", "current", "beacon", "gust", "earth"}
GRAVITY_WORDS = {"gravity", "grav", "g"}
WATCH_WORDS = {"obs", "observe", "observation", "observations", "state", "sense", "features"}
FREE_VELOCITY = r"qvel\[0?:3\](\.copy\(\)|\.astype\([^)]*\)|\))*$"
VELOCITY_FIELDS = {*(("getBaseVelocity", field) for field in (0, 1)), *(("getLinkState", field) for field in (6, 7))}
PLACE_FIELDS = {("getBasePositionAndOrientation", 0), *(("getLinkState", field) for field in (0, 4))}
FREE_BASE = ("getBaseVelocity", ".set_base(", ".base_velocity")
TASK_VELOCITIES = {"base_velocity", "base_angular_velocity"}
"""Of a body of a task: both are in the axes of the world, as PyBullet's."""
ALONG, ASIDE = 0.15, 0.4  # part of a motion that a velocity leaves over
WORSE = 20.0  # times what the right one leaves over; small turns leave 4 times as much after two as after one


class WorldVectors:
    """Which vectors are those of the world, and why."""

    def __init__(self, series: VectorSeries, definitions: Definitions) -> None:
        self.series, self._definitions = series, definitions
        self._fields = BulletFields(definitions)

    def explain(self, turn: VectorTurn) -> str | None:
        """Return what the vector is that is turned; None where it is not known to be one of the world."""
        words = list_words(turn.part) if turn.part is not None else set(split_name(turn.text))
        context = words | self._find_context(turn.whole.node)
        vectors = turn.before
        if self.is_gravity(vectors) and context & GRAVITY_WORDS:
            return "gravity"
        if words & DRAWN_WORDS and not words & OTHER_WORDS and self._is_drawn(vectors):
            return "a direction that stays the same in an episode"
        if turn.whole.function in self._watchers and (way := self.find_way(turn)) is not None:
            return f"the way {way}"
        if self.is_engine_velocity(turn.part):
            return "the velocity that the engine returns"
        if self.is_velocity(turn):
            return "the velocity that moves a position"
        return None

    def is_engine_velocity(self, node: ast.expr | None) -> bool:
        """Say whether PyBullet, or a body of a task, returns an expression as a velocity in the axes of the world."""
        if node is None or self.series.source.find(node) is None:
            return False
        place = ReadExpression(peel(node), self.series.source.find_function(node))
        return self._is_velocity(self._definitions.resolve(place))

    def _is_velocity(self, place: ReadExpression) -> bool:
        node = peel(place.node)
        match node:
            case ast.Attribute(attr=name):
                return name in TASK_VELOCITIES and name not in self._definitions.assigned
            case ast.Name(id=name):
                several = self._definitions.list_assigned(place.function).get(name, ())
                calls = [ast.unparse(one.value) for one in several if one.element is not None]
                return bool(calls) and all("getBaseVelocity(" in text for text in calls)
            case ast.Subscript():
                field = self._fields.find_field(node)
                return field is not None and (field.function, field.field) in VELOCITY_FIELDS
        return False

    @functools.cached_property
    def _watchers(self) -> set[ast.AST]:
        """The functions that an observation is made of."""
        functions = self.series.source.functions
        waiting = [one for name, found in functions.items() if set(split_name(name)) & WATCH_WORDS for one in found]
        watchers = set[ast.AST]()
        while waiting:
            function = waiting.pop()
            if function not in watchers:
                watchers.add(function)
                calls = [node.func for node in ast.walk(function) if isinstance(node, ast.Call)]
                names = [call.attr if isinstance(call, ast.Attribute) else ast.unparse(call) for call in calls]
                waiting += [one for name in names for one in functions.get(name, ())]
        return watchers

    def _find_context(self, node: ast.AST) -> set[str]:
        """Return the words of what a value is assigned to, or of its key."""
        parents = self.series.source.parents
        while not isinstance(node, ast.stmt):
            above = parents[node]
            if isinstance(above, ast.Dict):
                keys = [k for k, v in zip(above.keys, above.values, strict=True) if v is node and k is not None]
                return list_words(keys[0]) if keys else set()
            node = above
        targets = node.targets if isinstance(node, ast.Assign) else []
        return {word for target in targets for word in list_words(target)}

    def is_gravity(self, vectors: Array) -> bool:
        """Say whether vectors always point straight down."""
        known = vectors[np.isfinite(vectors).all(axis=2)]
        return vectors.shape[2] == 3 and bool((known[:, :2] == 0).all() and (known[:, 2] < 0).all())

    def _is_drawn(self, vectors: Array) -> bool:
        firsts = []
        for number in np.unique(self.series.episodes):
            rows = vectors[self.series.episodes == number, 0]
            rows = rows[np.isfinite(rows).all(axis=1)]
            if len(rows) and np.ptp(rows, axis=0).max() > SAME:
                return False
            firsts += [rows[0]] if len(rows) else []
        return len(firsts) > 1 and float(np.ptp(np.array(firsts), axis=0).max()) > SAME

    def find_way(self, turn: VectorTurn, *, needs_goal: bool = True) -> str | None:
        """Return the difference of places that a vector is, up to its length."""
        for way in self.series.differences:
            words = {word for node in way.nodes for word in list_words(node)}
            if way.rows.shape != turn.before.shape or words & OTHER_WORDS or not words & (PLACE_WORDS | AXES):
                continue
            if not _is_parallel(way.rows, turn.before):
                continue
            if not needs_goal or any(self._is_goal(side) or self._is_of_engine(side) for side in way.sides):
                return way.text
        return None

    def _is_of_engine(self, places: Array) -> bool:
        """Say whether an engine has returned places, in the axes of the world."""
        return any(_is_same(places, rows) for rows in self._engine_places)

    @functools.cached_property
    def _engine_places(self) -> list[Array]:
        found = [rows for one, rows in self.series.vectors if is_of_engine(one) or self.is_place_field(one.node)]
        if self._has_free_joint:
            free = [rows for one, rows in self.series.vectors if re.search(FREE_PLACE, one.text.replace(" ", ""))]
            found += free
        return found

    def is_place_field(self, node: ast.expr) -> bool:
        """Say whether an expression is the field of a tuple of PyBullet that is a place."""
        field = self._fields.find_field(peel(node)) if isinstance(node, ast.Subscript | ast.Call | ast.Name) else None
        return field is not None and (field.function, field.field) in PLACE_FIELDS

    def _is_goal(self, places: Array) -> bool:
        """Say whether a place stays where it is in an episode, but for some steps, and is another one in others."""
        same_episode = np.diff(self.series.episodes) == 0
        stays = np.nanmax(np.abs(np.diff(places, axis=0)), axis=2, initial=0.0)[same_episode] < SAME
        firsts = [places[self.series.episodes == number][0] for number in np.unique(self.series.episodes)]
        is_drawn = len(firsts) > 1 and np.ptp(np.array(firsts), axis=0).max() > SAME
        return bool(stays.mean() > MOSTLY and is_drawn)

    @functools.cached_property
    def has_free_base(self) -> bool:
        """Whether a robot of an engine can move freely, as far as the source shows it."""
        texts = [ast.unparse(tree) for tree in self.series.source.trees.values()]
        return self._has_free_joint or any(word in text for text in texts for word in FREE_BASE)

    @functools.cached_property
    def _has_free_joint(self) -> bool:
        """Whether MuJoCo's first joint is a free one, as far as the source shows it."""
        texts = [ast.unparse(tree) for tree in self.series.source.trees.values()]
        return any(re.search(r"freejoint|type=.free|qpos\[3:7\]", text) for text in texts)

    def find_compared(self, turn: VectorTurn) -> str | None:
        """Return the way of the world with which a turned axis of a body is multiplied, the vector being constant."""
        known = turn.before[np.isfinite(turn.before).all(axis=2)]
        if np.ptp(known, axis=0).max() > SAME:
            return None
        for one in self.series.source.expressions:
            sides: list[ast.expr] = []
            match one.node:
                case ast.BinOp(left=left, op=ast.MatMult() | ast.Mult(), right=right):
                    sides = [left, right]
                case ast.Call(func=ast.Attribute(attr="dot" | "inner" | "vdot"), args=[left, right]):
                    sides = [left, right]
            for axis, other in itertools.permutations(sides, 2):
                turned, way = (self.series.read(node, size=3) for node in (axis, other))
                if turned is None or way is None or turned.shape != turn.after.shape or way.shape != turned.shape:
                    continue
                if np.array_equal(turned, turn.after, equal_nan=True):
                    facing = dataclasses.replace(turn, before=way)
                    if (text := self.find_way(facing, needs_goal=False)) is not None:
                        return text
        return None

    def is_velocity(self, turn: VectorTurn) -> bool:
        """Say whether a position moves along the vector, and not along what it is turned into."""
        if self._has_free_joint and re.search(FREE_VELOCITY, turn.text.replace(" ", "")):
            return True
        size, steps = turn.before.shape[2], np.diff(self.series.episodes) == 0
        changes = np.abs(np.diff(turn.before, axis=0)[steps])
        if not (changes[np.isfinite(changes)] > SAME).any():
            return False  # a place that does not move, towards which the robot does
        for one, rows in self.series.vectors:
            if rows.shape != turn.before.shape or not is_place(one):
                continue
            moved = np.diff(rows, axis=0)[steps].reshape(-1, size)
            old, new = (vectors[1:][steps].reshape(-1, size) for vectors in (turn.before, turn.after))
            known = np.isfinite(moved).all(axis=1) & np.isfinite(old).all(axis=1) & np.isfinite(new).all(axis=1)
            if known.sum() < 2 * FEWEST or not moved[known].any():
                continue
            episodes = np.repeat(self.series.episodes[1:][steps], rows.shape[1])[known]
            changing = [_center(vectors[known], episodes) for vectors in (moved, old)]
            rest, other = (_measure_rest(moved[known], vectors[known]) for vectors in (old, new))
            if rest < ALONG and _measure_rest(*changing) < ASIDE and other > min(ASIDE, WORSE * rest + SAME):
                return True
        return False


def _center(vectors: Array, episodes: NDArray[np.int_]) -> Array:
    """Return what vectors differ by from their mean in each episode."""
    centered = vectors.copy()
    for number in np.unique(episodes):
        centered[episodes == number] -= vectors[episodes == number].mean(axis=0)
    return centered


def _measure_rest(moved: Array, velocity: Array) -> float:
    """Return which part of a motion a velocity does not explain, with one factor."""
    factor = (moved * velocity).sum() / max((velocity**2).sum(), 1e-12)
    return float(((moved - factor * velocity) ** 2).sum() / max((moved**2).sum(), 1e-12))


def _is_same(one: Array, other: Array) -> bool:
    return one.shape == other.shape and np.allclose(one, other, rtol=SAME, atol=SAME, equal_nan=True)


def _is_parallel(one: Array, other: Array) -> bool:
    both = np.isfinite(one).all(axis=2) & np.isfinite(other).all(axis=2)
    lengths = np.linalg.norm(one, axis=2), np.linalg.norm(other, axis=2)
    usable = both & (lengths[0] > SAME) & (lengths[1] > SAME)
    if usable.sum() < FEWEST:
        return False
    units = one[usable] / lengths[0][usable][:, None], other[usable] / lengths[1][usable][:, None]
    return bool((np.abs(units[0] - units[1]).max(axis=1) < SAME).mean() > NEARLY_ALL)
