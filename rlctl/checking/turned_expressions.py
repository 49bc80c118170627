"""Where the source turns a vector of the world by an orientation, and in which direction."""

import ast
import collections
import dataclasses
import functools
import itertools
import re
from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from rlctl.checking.attitudes import compute_matrices
from rlctl.checking.expressions import Expression, NotedCall, Source, Value
from rlctl.checking.source_mistakes import SourceMistake
from rlctl.checking.term_names import split_name

Array = NDArray[np.float64]

PLACE_WORDS = {
    *("pos", "position", "positions", "place", "xpos", "goal", "goals", "target", "targets", "waypoint", "waypoints"),
    *("xy", "xyz", "site", "point", "origin", "base", "ball", "box", "cube", "object", "puck", "gate", "dock"),
    *("station", "drone", "robot", "com", "center", "centre", "beacon", "door", "hand", "tip", "handle", "qpos", "fix"),
}
JOINT_WORDS = {"joint", "joints", "leg", "legs", "finger", "fingers", "wheel", "wheels", "motor", "motors", "dof"}
OTHER_WORDS = {
    *("vel", "velocity", "speed", "cmd", "command", "commands", "omega", "rate", "qvel", "acc", "force", "torque"),
    *("wanted", "desired", "local", "body", "offset", "error", "err", "lin", "ang", "twist", "gain", "axis"),
}
DRAWN_WORDS = {"sun", "light", "star", "north", "magnetic", "field", "wind", "current", "beacon", "gust", "earth"}
GRAVITY_WORDS = {"gravity", "grav", "g"}
INVERSE_WORDS = {"inv", "inverse", "invert", "conj", "conjugate", "transpose"}
WATCH_WORDS = {"obs", "observe", "observation", "observations", "state", "sense", "features"}
WORLD_WORDS = {"world", "global", "inertial", "map"}
ANGLE_WORDS = {"yaw", "heading", "theta", "psi", "course", "euler", "rpy", "joint", "joints", "angle", "qpos", "turn"}
FREE_VELOCITY = r"qvel\[0?:3\](\.copy\(\)|\.astype\([^)]*\)|\))*$"
MATRIX_WORDS = {"xmat", "site_xmat", "geom_xmat", "ximat"}
WXYZ, XYZW = [1, 2, 3, 0], [0, 1, 2, 3]
"""Where the elements x, y, z and w are."""
SAME = 1e-6
FEWEST, NEARLY_ALL, MOSTLY, HARDLY_ANY = 10, 0.95, 0.7, 0.3
MOST_CALLS = 60  # in which orientations are compared
ALONG, ASIDE = 0.15, 0.4  # part of a motion that a velocity leaves over
LEAST_SPREAD = 0.1  # of an angle [rad], standard deviation
LEAST_TURN = 0.002  # of a vector's length, that a turn moves it


class Series:
    """What each expression that is a vector was worth at the end of each call: (calls, worlds, elements)."""

    def __init__(self, source: Source, episodes: Sequence[Sequence[NotedCall]]) -> None:
        self.source = source
        self.calls = [call for episode in episodes for call in episode]
        self.episodes = np.concatenate([np.full(len(one), number) for number, one in enumerate(episodes)])
        self._last = [{number: values[-1] for number, values in call.values.items()} for call in self.calls]

    @functools.cache  # noqa: B019  # lives as long as one experiment
    def read(self, node: ast.AST, *, size: int | None = None) -> Array | None:
        """Return the last values of an expression, NaN where it was not evaluated; numbers are of (calls, worlds)."""
        one = self.source.find(node)
        if one is None:
            return None
        values = [last.get(one.number) for last in self._last]
        shapes = {np.shape(value) for value in values if value is not None}
        if len(shapes) != 1:
            return None
        shape = shapes.pop()
        rows = np.full((len(values), *shape), np.nan)
        for place, value in enumerate(values):
            if value is not None:
                rows[place] = value
        if size is None:
            return rows.reshape(len(rows), -1) if len(shape) <= 1 else None
        if not shape or shape[-1] != size or len(shape) > 2:
            return None
        return rows.reshape(len(rows), -1, size)

    @functools.cached_property
    def vectors(self) -> list[tuple[Expression, Array]]:
        """All expressions of two or three elements."""
        found = [(one, self.read(one.node, size=size)) for one in self.source.expressions for size in (2, 3)]
        return [(one, rows) for one, rows in found if rows is not None]

    @functools.cached_property
    def orientations(self) -> list[Expression]:
        """All expressions that are unit quaternions, and change; and MuJoCo's matrices."""
        found = [one for one in self.source.expressions if MATRIX_WORDS & list_words(one.node) and self._is_matrix(one)]
        for one in self.source.expressions:
            rows = self.read(one.node, size=4)
            if rows is not None and np.isfinite(rows).any():
                lengths = np.linalg.norm(rows[np.isfinite(rows).all(axis=2)], axis=-1)
                moves = np.nanstd(rows, axis=(0, 1)).max()
                if len(lengths) >= FEWEST and np.abs(lengths - 1).max() < 1e-4 and moves > SAME:
                    found.append(one)
        return found

    def read_matrices(self, one: Expression) -> Array | None:
        """Return the matrices of an expression that has nine elements, (calls, 3, 3); None for others."""
        if not self._is_matrix(one):
            return None
        values = [last.get(one.number) for last in self._last]
        return np.array([np.full(9, np.nan) if v is None else np.ravel(v) for v in values]).reshape(-1, 3, 3)

    def _is_matrix(self, one: Expression) -> bool:
        values = [last[one.number] for last in self._last if one.number in last]
        return len(values) >= FEWEST and all(np.size(value) == 9 for value in values if value is not None)


@dataclasses.dataclass(frozen=True, eq=False)
class Turn:
    """An expression that turns a vector: (calls, worlds, elements)."""

    whole: Expression
    part: ast.expr | None  # the vector; None where it has only elements
    text: str  # of the vector
    before: Array
    after: Array

    @property
    def turned_back(self) -> "Turn":
        """The opposite turn."""
        return dataclasses.replace(self, before=self.after, after=self.before)


def find_turns(series: Series) -> Iterator[Turn]:
    """Yield the expressions whose value is as long as one of its operands or arguments, and another vector."""
    for one in series.source.expressions:
        parts: list[ast.expr] = []
        match one.node:
            case ast.BinOp(left=left, op=ast.MatMult(), right=right):
                parts = [left, right]
            case ast.Call(args=args, keywords=keywords, func=function):
                parts = [*args, *(keyword.value for keyword in keywords)]
                parts += [function.value] if isinstance(function, ast.Attribute) else []
        for part, size in itertools.product(parts, (2, 3)):
            before, after = series.read(part, size=size), series.read(one.node, size=size)
            if before is not None and after is not None and _is_turn(before, after):
                yield Turn(one, part, ast.unparse(part), before, after)
    yield from _find_written_out(series)


def _is_turn(before: Array, after: Array) -> bool:
    if before.shape != after.shape:
        return False
    both = np.isfinite(before).all(axis=2) & np.isfinite(after).all(axis=2)
    old, new = before[both], after[both]
    lengths = np.linalg.norm(old, axis=-1)
    if (lengths > SAME).sum() < FEWEST:
        return False
    same = np.abs(np.linalg.norm(new, axis=-1) - lengths) <= SAME * (1e-3 + lengths)
    moved = np.linalg.norm(new - old, axis=-1) > LEAST_TURN * lengths
    return bool(same.mean() > NEARLY_ALL and moved[lengths > SAME].mean() > HARDLY_ANY)


@dataclasses.dataclass(frozen=True)
class _Sum:
    """A sum of two products of two factors."""

    one: Expression
    factors: tuple[tuple[ast.expr, ast.expr], tuple[ast.expr, ast.expr]]


def _find_written_out(series: Series) -> Iterator[Turn]:
    """Yield turns in the plane that are written by elements: c * x - s * y and s * x + c * y."""
    sums: dict[ast.AST, list[_Sum]] = collections.defaultdict(list)
    for one in series.source.expressions:
        match one.node:
            case ast.BinOp(left=left, op=ast.Add() | ast.Sub(), right=right):
                products = [_read_product(left), _read_product(right)]
                if products[0] is not None and products[1] is not None:
                    sums[one.function].append(_Sum(one, (products[0], products[1])))
    for function, found in sums.items():
        parameters = {argument.arg for argument in function.args.args} - {"self"}  # type: ignore[attr-defined]
        for first, second in itertools.pairwise(found):
            turn = _read_pair(series, first, second, parameters)
            if turn is not None and _is_turn(turn.before, turn.after):
                yield turn


def _read_product(node: ast.expr) -> tuple[ast.expr, ast.expr] | None:
    if isinstance(node, ast.UnaryOp):
        node = node.operand
    if not isinstance(node, ast.BinOp) or not isinstance(node.op, ast.Mult):
        return None
    one = node.left.operand if isinstance(node.left, ast.UnaryOp) else node.left
    return one, node.right


def _read_pair(series: Series, first: _Sum, second: _Sum, parameters: set[str]) -> Turn | None:
    """Return the turn that two sums are: one factor of each product is a cosine or a sine, the other an element."""
    others = [{ast.unparse(node) for node in product} for product in second.factors]
    for flips in itertools.product((0, 1), repeat=2):
        (a, x), (b, y) = (
            product[::-1] if flip else product for product, flip in zip(first.factors, flips, strict=True)
        )
        names = [ast.unparse(node) for node in (a, x, b, y)]
        crossed = [{names[0], names[3]}, {names[2], names[1]}]
        if others not in (crossed, crossed[::-1]):
            continue
        values = [series.read(node) for node in (a, b, x, y, first.one.node, second.one.node)]
        if any(value is None for value in values):
            continue
        cosine, sine, *vectors = np.broadcast_arrays(*values)  # type: ignore[arg-type]
        known = np.isfinite(cosine) & np.isfinite(sine)
        if not known.any() or np.abs(cosine[known] ** 2 + sine[known] ** 2 - 1).max() > SAME:
            continue
        roots = {node.id for part in (x, y) for node in ast.walk(part) if isinstance(node, ast.Name)}
        if roots & parameters:  # those who call the function show which vector it is
            return None
        before, after = np.stack(vectors[:2], -1), np.stack(vectors[2:], -1)
        return Turn(first.one, None, f"({names[1]}, {names[3]})", before, after)
    return None


class Directions:
    """In which direction vectors are turned, by the orientations that the source reads."""

    def __init__(self, series: Series) -> None:
        self.series = series
        nodes = (node for tree in series.source.trees.values() for node in ast.walk(tree))
        imports = [node for node in nodes if isinstance(node, ast.Import | ast.ImportFrom)]
        self._libraries = {word for node in imports for word in ast.unparse(node).replace(".", " ").split()}
        self.has_engine = bool(self._libraries & {"mujoco", "pybullet", "rlctl"})

    def find(self, turn: Turn) -> tuple[int, str] | None:
        """Return 1 for a turn from the body to the world, -1 for the inverse, and by what; None where it is not
        known."""
        if turn.before.shape[2] == 3 and (found := self._find_by_quaternions(turn)):
            return found
        flat = turn.before.shape[2] == 2 or np.allclose(turn.before[..., 2], turn.after[..., 2], equal_nan=True)
        return self._find_by_angles(turn) if flat else None

    def _choose_calls(self, turn: Turn) -> list[int]:
        known = np.isfinite(turn.before).all(axis=(1, 2)) & np.isfinite(turn.after).all(axis=(1, 2))
        lengths = np.linalg.norm(np.nan_to_num(turn.before), axis=-1).max(axis=1)
        moved = np.linalg.norm(np.nan_to_num(turn.after - turn.before), axis=-1).max(axis=1) > 1e-3 * lengths
        usable = np.flatnonzero(known & moved & (lengths > SAME))
        return usable[:: max(1, len(usable) // MOST_CALLS)].tolist()

    def _find_by_quaternions(self, turn: Turn) -> tuple[int, str] | None:
        calls, found = self._choose_calls(turn), list[tuple[int, int, str]]()
        for one in self.series.orientations if len(calls) >= FEWEST else ():
            for order in (WXYZ, XYZW):
                hits = np.zeros(2)
                for number, place in enumerate(calls):
                    hits += self._compare(turn, place, _list_values(self.series.calls[place], one), order)
                    if number == FEWEST // 2 and not hits.any():
                        break
                for sign, hit, other in ((1, 0, 1), (-1, 1, 0)):
                    if hits[hit] >= NEARLY_ALL * len(calls) and hits[other] <= HARDLY_ANY * len(calls):
                        found.append((_rank(one), sign, one.text))
        return _choose(found)

    def _compare(self, turn: Turn, place: int, orientations: Sequence[Value], order: Sequence[int]) -> Array:
        before, after = turn.before[place], turn.after[place]
        hits = np.zeros(2)
        for value in orientations:
            elements = np.zeros(0) if value is None else np.asarray(value, float)
            if elements.size == 9:
                matrices = elements.reshape(1, 3, 3)
            elif elements.shape in ((4,), (len(before), 4)):
                matrices = compute_matrices(elements.reshape(-1, 4)[:, order])
            else:
                continue
            for side, turned in enumerate(
                (np.einsum("nij,nj->ni", matrices, before), np.einsum("nji,nj->ni", matrices, before))
            ):
                near = np.linalg.norm(turned - after, axis=1) <= 1e-5 * np.linalg.norm(before, axis=1)
                hits[side] = max(hits[side], float(near.all()))
        return hits

    def _find_by_angles(self, turn: Turn) -> tuple[int, str] | None:
        x, y = turn.before[..., 0], turn.before[..., 1]
        u, v = turn.after[..., 0], turn.after[..., 1]
        angles = np.arctan2(x * v - y * u, x * u + y * v)
        usable = np.isfinite(angles) & (np.hypot(x, y) > 1e-3)
        if usable.sum() < FEWEST:
            return None
        found = []
        for one, rows in self._angles:
            if rows.shape[1] not in (1, angles.shape[1]):
                continue
            known = np.broadcast_to(rows, angles.shape)
            both = usable & np.isfinite(known)
            if both.sum() < max(FEWEST, 0.5 * usable.sum()) or np.std(known[both]) < LEAST_SPREAD:
                continue
            hits = [float((np.abs(np.sin((angles - sign * known)[both] / 2)) < 1e-5).mean()) for sign in (1, -1)]
            for sign, hit, other in ((1, 0, 1), (-1, 1, 0)):
                if hits[hit] >= NEARLY_ALL and hits[other] <= HARDLY_ANY:
                    found.append((_rank(one), sign, one.text))
        return _choose(found)

    def read_yaw(self, text: str) -> Array | None:
        """Return the angle about the vertical of an orientation that `find` has named: (calls, worlds)."""
        for one in (one for one in self.series.orientations if one.text == text):
            if (matrices := self.series.read_matrices(one)) is not None:
                return np.arctan2(matrices[:, 1, 0], matrices[:, 0, 0])[:, None]
            rows = self.series.read(one.node, size=4)
            if rows is not None:
                order = WXYZ if "mujoco" in self._libraries else XYZW
                yaw = np.arctan2(*compute_matrices(rows.reshape(-1, 4)[:, order])[:, [1, 0], 0].T)
                return yaw.reshape(rows.shape[:2])
        return next((rows for one, rows in self._angles if one.text == text), None)

    @functools.cached_property
    def _angles(self) -> list[tuple[Expression, Array]]:
        """What is called an angle about the vertical, and is no argument: that may be another one's opposite."""
        kinds = ast.Name | ast.Attribute | ast.Subscript | ast.Call
        named = [one for one in self.series.source.expressions if isinstance(one.node, kinds)]
        named = [one for one in named if list_words(one.node) & ANGLE_WORDS and _rank(one) < 2]
        found = [(one, self.series.read(one.node)) for one in named]
        return [(one, rows) for one, rows in found if rows is not None]


def _choose(found: Sequence[tuple[int, int, str]]) -> tuple[int, str] | None:
    """Return the direction by the best of some orientations; None where these do not agree."""
    best = [entry for entry in found if entry[0] == min(found)[0]]
    return (best[0][1], best[0][2]) if len({sign for _, sign, _ in best}) == 1 else None


def _rank(one: Expression) -> int:
    """Return 0 for what is stored, 1 for what is read, and 2 for what may be the inverse of an orientation."""
    parameters = {argument.arg for argument in one.function.args.args} - {"self"}
    names = {node.id for node in ast.walk(one.node) if isinstance(node, ast.Name)}
    if names & parameters or list_words(one.node) & INVERSE_WORDS or isinstance(one.node, ast.BinOp | ast.UnaryOp):
        return 2
    return 0 if isinstance(one.node, ast.Attribute | ast.Subscript) and "self" in names else 1


def _list_values(call: NotedCall, one: Expression) -> list[Value]:
    values = call.values.get(one.number, [])
    return values if len(values) <= 3 else [values[0], *values[-2:]]


def list_words(node: ast.AST) -> set[str]:
    """Return the words of all names in a piece of code."""
    names = [one.id for one in ast.walk(node) if isinstance(one, ast.Name)]
    names += [one.attr for one in ast.walk(node) if isinstance(one, ast.Attribute)]
    names += [one.value for one in ast.walk(node) if isinstance(one, ast.Constant) and isinstance(one.value, str)]
    return {word for name in names for word in split_name(name)}


class WorldVectors:
    """Which vectors are those of the world, and why."""

    def __init__(self, series: Series) -> None:
        self.series = series

    def explain(self, turn: Turn) -> str | None:
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
        if self.is_velocity(turn):
            return "the velocity that moves a position"
        return None

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

    def find_way(self, turn: Turn, *, needs_goal: bool = True) -> str | None:
        """Return the difference of places that a vector is, up to its length."""
        for one, rows in self.series.vectors:
            node = one.node
            if not isinstance(node, ast.BinOp) or not isinstance(node.op, ast.Sub):
                continue
            words = list_words(node)
            if rows.shape != turn.before.shape or words & OTHER_WORDS or not words & PLACE_WORDS:
                continue
            sides = [self.series.read(side, size=rows.shape[2]) for side in (node.left, node.right)]
            has_goal = any(side is not None and self._is_goal(side) for side in sides) or not needs_goal
            if has_goal and _is_parallel(rows, turn.before):
                return one.text
        return None

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
        return self._has_free_joint or any("getBaseVelocity" in text for text in texts)

    @functools.cached_property
    def _has_free_joint(self) -> bool:
        """Whether MuJoCo's first joint is a free one, as far as the source shows it."""
        texts = [ast.unparse(tree) for tree in self.series.source.trees.values()]
        return any(re.search(r"freejoint|type=.free|qpos\[3:7\]", text) for text in texts)

    def find_compared(self, turn: Turn) -> str | None:
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

    def is_velocity(self, turn: Turn) -> bool:
        """Say whether a position moves along the vector, and not along what it is turned into."""
        if self._has_free_joint and re.search(FREE_VELOCITY, turn.text.replace(" ", "")):
            return True
        size, steps = turn.before.shape[2], np.diff(self.series.episodes) == 0
        for one, rows in self.series.vectors:
            if rows.shape != turn.before.shape or not _is_place(one):
                continue
            moved = np.diff(rows, axis=0)[steps].reshape(-1, size)
            old, new = (vectors[1:][steps].reshape(-1, size) for vectors in (turn.before, turn.after))
            known = np.isfinite(moved).all(axis=1) & np.isfinite(old).all(axis=1) & np.isfinite(new).all(axis=1)
            if known.sum() < 2 * FEWEST or not moved[known].any():
                continue
            if _measure_rest(moved[known], old[known]) < ALONG and _measure_rest(moved[known], new[known]) > ASIDE:
                return True
        return False


def _is_place(one: Expression) -> bool:
    """Say whether an expression is called a place, and not the angles of joints."""
    words = list_words(one.node)
    if isinstance(one.node, ast.BinOp) or words & JOINT_WORDS:
        return False
    return bool(words & (PLACE_WORDS - {"qpos"})) or bool(re.search(r"qpos\[0?:[23]\]", one.text.replace(" ", "")))


def _measure_rest(moved: Array, velocity: Array) -> float:
    """Return which part of a motion a velocity does not explain, with one factor."""
    factor = (moved * velocity).sum() / max((velocity**2).sum(), 1e-12)
    return float(((moved - factor * velocity) ** 2).sum() / max((moved**2).sum(), 1e-12))


def _is_parallel(one: Array, other: Array) -> bool:
    both = np.isfinite(one).all(axis=2) & np.isfinite(other).all(axis=2)
    lengths = np.linalg.norm(one, axis=2), np.linalg.norm(other, axis=2)
    usable = both & (lengths[0] > SAME) & (lengths[1] > SAME)
    if usable.sum() < FEWEST:
        return False
    units = one[usable] / lengths[0][usable][:, None], other[usable] / lengths[1][usable][:, None]
    return bool((np.abs(units[0] - units[1]).max(axis=1) < SAME).mean() > NEARLY_ALL)


class TurnedVectors:
    """All turns of vectors in a source, with their directions."""

    def __init__(self, series: Series) -> None:
        self.series, self.directions, self.world = series, Directions(series), WorldVectors(series)
        self.turns = list(find_turns(series))
        self.known = [(turn, self.directions.find(turn)) for turn in self.turns]


def find_wrong_turns(turned: TurnedVectors) -> Iterator[SourceMistake]:
    """Yield the turns of vectors of the world by the orientation itself, instead of its inverse."""
    series, directions, world, known = turned.series, turned.directions, turned.world, turned.known
    explained = [(turn, found, world.explain(turn)) for turn, found in known if found is not None]
    rights = {found[1] for _, found, what in explained if found[0] < 0 and what is not None}
    rights |= {found[1] for turn, found, _ in explained if found[0] > 0 and world.is_velocity(turn.turned_back)}
    seen, rights_3d = set[int](), {one.text for one in series.orientations}
    for turn, by in ((turn, found[1]) for turn, found in known if found is not None and found[0] < 0):
        if by in rights_3d and (other := world.find_compared(turn)) is not None:
            message = (
                f"{turn.whole.text} turns {turn.text} by the inverse of {by}, from the world to the body, and it is"
            )
            message += f" multiplied with {other}, which is of the world"
            yield SourceMistake("RL124", message, {"element": turn.whole.text, "value": turn.text}, turn.whole.where)
    for turn, (sign, by), what in explained:
        if sign < 0 or what is None or turn.whole.number in seen:
            continue
        is_angle = turn.before.shape[2] == 2 or by not in rights_3d
        is_told = bool(list_words(turn.whole.node) & WORLD_WORDS) or by in rights or directions.has_engine
        if is_angle and not is_told:
            continue  # the angle may count the other way round, as that of a compass
        seen.add(turn.whole.number)
        rule = "RL125" if what.startswith("the way") else "RL124"
        message = (
            f"{turn.whole.text} turns {turn.text}, {what}, by the orientation {by}: from the body to the world, and"
        )
        message += " the vector is one of the world already"
        yield SourceMistake(rule, message, {"element": turn.whole.text, "value": turn.text}, turn.whole.where)
