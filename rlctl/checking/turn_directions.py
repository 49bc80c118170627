"""In which direction the source turns vectors, by the orientations that it reads."""

import ast
import functools
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from rlctl.checking.assignments import list_parameters, list_words
from rlctl.checking.attitudes import compute_matrices
from rlctl.checking.expressions import NotedCall, Value
from rlctl.checking.source_code import Expression
from rlctl.checking.turned_expressions import VectorTurn
from rlctl.checking.vector_series import FEWEST, HARDLY_ANY, MOSTLY, NEARLY_ALL, SAME, Array, VectorSeries
from rlctl.checking.world_places import is_of_engine, is_place

INVERSE_WORDS = {"inv", "inverse", "invert", "conj", "conjugate", "transpose"}
ANGLE_WORDS = {"yaw", "heading", "theta", "psi", "course", "euler", "rpy", "joint", "joints", "angle", "qpos", "turn"}
WXYZ, XYZW = [1, 2, 3, 0], [0, 1, 2, 3]
"""Where the elements x, y, z and w are."""
MOST_CALLS = 60  # in which orientations are compared
BETWEEN = 1.2  # part of a turn in a step by which the motion meanwhile may be apart from its middle
LEAST_SPREAD = 0.1  # of an angle [rad], standard deviation


class Directions:
    """In which direction vectors are turned, by the orientations that the source reads."""

    def __init__(self, series: VectorSeries) -> None:
        self.series = series
        numbers = set[int]().union(*(call.values for call in series.calls))
        files = {series.source.expressions[number].where[0] for number in numbers}  # that were run, not all of a folder
        nodes = (node for file, tree in series.source.trees.items() if file in files for node in ast.walk(tree))
        imports = [node for node in nodes if isinstance(node, ast.Import | ast.ImportFrom)]
        self._libraries = {word for node in imports for word in ast.unparse(node).replace(".", " ").split()}
        self.has_engine = bool(self._libraries & {"mujoco", "pybullet", "rlctl"})

    def find(self, turn: VectorTurn) -> tuple[int, str] | None:
        """Return 1 for a turn from the body to the world, -1 for the inverse, and by what; None where it is not
        known."""
        if turn.before.shape[2] == 3 and (found := self._find_by_quaternions(turn)):
            return found
        flat = turn.before.shape[2] == 2 or np.allclose(turn.before[..., 2], turn.after[..., 2], equal_nan=True)
        return self._find_by_angles(turn) if flat else None

    def _choose_calls(self, turn: VectorTurn) -> list[int]:
        known = np.isfinite(turn.before).all(axis=(1, 2)) & np.isfinite(turn.after).all(axis=(1, 2))
        lengths = np.linalg.norm(np.nan_to_num(turn.before), axis=-1).max(axis=1)
        moved = np.linalg.norm(np.nan_to_num(turn.after - turn.before), axis=-1).max(axis=1) > 1e-3 * lengths
        usable = np.flatnonzero(known & moved & (lengths > SAME))
        return usable[:: max(1, len(usable) // MOST_CALLS)].tolist()

    def _find_by_quaternions(self, turn: VectorTurn) -> tuple[int, str] | None:
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

    def _compare(self, turn: VectorTurn, place: int, orientations: Sequence[Value], order: Sequence[int]) -> Array:
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

    def _find_by_angles(self, turn: VectorTurn) -> tuple[int, str] | None:
        angles, usable = _measure_turn(turn)
        if usable.sum() < FEWEST:
            return None
        found = []
        for one, rows in self.angles:
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

    def read_yaw(self, turn: VectorTurn, text: str) -> Array | None:
        """Return the angle about the vertical of an orientation that `find` has named for a turn: (calls, worlds)."""
        for one in (one for one in self.series.orientations if one.text == text):
            if (matrices := self.series.read_matrices(one)) is not None:
                return np.arctan2(matrices[:, 1, 0], matrices[:, 0, 0])[:, None]
            rows = self.series.read(one.node, size=4)
            if rows is not None:
                order = WXYZ if "mujoco" in self._libraries else XYZW
                yaw = np.arctan2(*compute_matrices(rows.reshape(-1, 4)[:, order])[:, [1, 0], 0].T)
                return yaw.reshape(rows.shape[:2])
        angles, usable = _measure_turn(turn)

        def count(rows: Array) -> tuple[int, int]:
            """Count the calls in which an angle is that of the turn, and all: some are read at resets only."""
            fits = rows.shape[1] in (1, angles.shape[1])
            hits = np.abs(np.abs(np.cos(angles)) - np.abs(np.cos(rows)))[usable] < 1e-5 if fits else np.zeros(1)
            return int(hits.sum()), int(np.isfinite(rows).sum())

        return max((rows for one, rows in self.angles if one.text == text), key=count, default=None)

    @functools.cached_property
    def angles(self) -> list[tuple[Expression, Array]]:
        """What is called an angle about the vertical, and is no argument: that may be another one's opposite."""
        kinds = ast.Name | ast.Attribute | ast.Subscript | ast.Call
        named = [one for one in self.series.source.expressions if isinstance(one.node, kinds)]
        found = [(one, self.series.read(one.node)) for one in named]
        return [
            (one, rows)
            for one, rows in found
            if rows is not None
            and ((list_words(one.node) & ANGLE_WORDS and _rank(one) < 2) or (self._is_given(one) and self._grows(rows)))
        ]

    def _is_given(self, one: Expression) -> bool:
        """Say whether a function is called with an expression."""
        parents = self.series.source.parents
        call = parents[one.node]
        while isinstance(call, ast.UnaryOp):
            call = parents[call]
        return not isinstance(one.node, ast.Call) and isinstance(call, ast.Call) and one.node is not call.func

    @functools.cached_property
    def _places(self) -> list[Array]:
        vectors = self.series.vectors
        places = [rows for one, rows in vectors if is_place(one) or is_of_engine(one) or _is_slice(one.node)]
        places += [side for way in self.series.differences for side in way.sides]
        return list({rows.tobytes(): rows for rows in places}.values())

    def counts_forwards(self, text: str) -> bool:
        """Say whether the motion of the robot shows that a rotation by an angle is the one from it to the world."""
        return any(self._grows(rows) for one, rows in self.angles if one.text == text)

    def moves_by(self, node: ast.expr, text: str) -> bool:
        """Say whether a vector moves as the place of a robot does that an angle turns."""
        places = [rows for size in (2, 3) if (rows := self.series.read(node, size=size)) is not None]
        return any(self._grows(rows, places) for one, rows in self.angles if one.text == text)

    def _grows(self, angles: Array, places: Sequence[Array] | None = None) -> bool:
        """Say whether a place goes round the vertical as an angle grows, or moves straight ahead by it."""
        if np.nanstd(angles) < LEAST_SPREAD:
            return False
        turned = np.diff(angles, axis=0)
        for rows in (rows for rows in (self._places if places is None else places) if rows.shape[:2] == angles.shape):
            x, y = np.diff(rows[..., :2], axis=0).transpose(2, 0, 1)
            round_it = np.diff(np.arctan2(rows[..., 1], rows[..., 0]), axis=0)
            ahead = np.arctan2(y, x)
            for off, moving in (
                ((round_it - turned) / 2, np.abs(turned) > SAME),
                (ahead - angles[1:], np.hypot(x, y) > SAME),
                (ahead - angles[:-1], np.hypot(x, y) > SAME),
                (_leave_out(ahead - angles[:-1] - turned / 2, turned / 2), np.hypot(x, y) > SAME),
            ):
                known = moving & np.isfinite(off) & (np.abs(turned) > SAME)
                if known.sum() >= FEWEST and (np.abs(np.sin(off[known])) < 1e-5).mean() > MOSTLY:
                    return True
        return False


def _measure_turn(turn: VectorTurn) -> tuple[Array, NDArray[np.bool_]]:
    """Return the angles about the vertical of a turn, and where they are known."""
    x, y = turn.before[..., 0], turn.before[..., 1]
    u, v = turn.after[..., 0], turn.after[..., 1]
    angles = np.arctan2(x * v - y * u, x * u + y * v)
    return angles, np.isfinite(angles) & (np.hypot(x, y) > 1e-3)


def _choose(found: Sequence[tuple[int, int, str]]) -> tuple[int, str] | None:
    """Return the direction by the best of some orientations; None where these do not agree."""
    best = [entry for entry in found if entry[0] == min(found)[0]]
    return (best[0][1], best[0][2]) if len({sign for _, sign, _ in best}) == 1 else None


def _rank(one: Expression) -> int:
    """Return 0 for what is stored, 1 for what is read, and 2 for what may be the inverse of an orientation."""
    parameters = set(list_parameters(one.function))
    names = {node.id for node in ast.walk(one.node) if isinstance(node, ast.Name)}
    is_turned = any(isinstance(node, ast.Attribute) and node.attr == "T" for node in ast.walk(one.node))
    is_computed = isinstance(one.node, ast.BinOp | ast.UnaryOp)
    if names & parameters or list_words(one.node) & INVERSE_WORDS or is_turned or is_computed:
        return 2
    return 0 if isinstance(one.node, ast.Attribute | ast.Subscript) and "self" in names else 1


def _leave_out(off: Array, turned: Array) -> Array:
    """Return by how much angles are off, forwards or backwards, beyond what was turned meanwhile in several steps."""
    least = (off + np.pi / 2) % np.pi - np.pi / 2
    return np.maximum(np.abs(least) - BETWEEN * np.abs(turned), 0.0)


def _is_slice(node: ast.expr) -> bool:
    return isinstance(node, ast.Subscript) and isinstance(node.slice, ast.Slice)


def _list_values(call: NotedCall, one: Expression) -> list[Value]:
    values = call.values.get(one.number, [])
    return values if len(values) <= 3 else [values[0], *values[-2:]]
