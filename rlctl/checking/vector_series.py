"""What the expressions of a source that are vectors are worth, call by call."""

import ast
import dataclasses
import functools
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from rlctl.checking.assignments import list_words
from rlctl.checking.expressions import NotedCall
from rlctl.checking.source_code import Expression, SourceCode

Array = NDArray[np.float64]

MATRIX_WORDS = {"xmat", "site_xmat", "geom_xmat", "ximat"}
SAME = 1e-6
FEWEST, NEARLY_ALL, MOSTLY, HARDLY_ANY = 10, 0.95, 0.7, 0.3


@dataclasses.dataclass(frozen=True, eq=False)
class VectorDifference:
    """A vector that is what two others differ by, also where it is written by elements: (calls, worlds, elements)."""

    text: str
    nodes: tuple[ast.BinOp, ...]  # of the vector, or of its elements
    rows: Array
    sides: tuple[Array, ...]  # the two others, where they are known


class VectorSeries:
    """What each expression that is a vector was worth at the end of each call: (calls, worlds, elements)."""

    def __init__(self, source: SourceCode, episodes: Sequence[Sequence[NotedCall]]) -> None:
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
    def differences(self) -> list[VectorDifference]:
        """All vectors that are differences of two."""
        found, before = list[VectorDifference](), None
        for one in self.source.expressions:
            node = one.node
            if not isinstance(node, ast.BinOp) or not isinstance(node.op, ast.Sub):
                continue
            for rows in (rows for size in (2, 3) if (rows := self.read(node, size=size)) is not None):
                parts = [self.read(side, size=rows.shape[2]) for side in (node.left, node.right)]
                found.append(
                    VectorDifference(one.text, (node,), rows, tuple(part for part in parts if part is not None))
                )
            if before is not None and before.function is one.function and isinstance(before.node, ast.BinOp):
                found += self._join(before.node, node)
            before = one
        return found

    def _join(self, x: ast.BinOp, y: ast.BinOp) -> list[VectorDifference]:
        """Return the vector of two numbers that are computed one after the other."""
        rows = self._stack(x, y)
        sides = [self._stack(x.left, y.left), self._stack(x.right, y.right)]
        text = f"({ast.unparse(x)}, {ast.unparse(y)})"
        known = tuple(side for side in sides if side is not None)
        return [] if rows is None else [VectorDifference(text, (x, y), rows, known)]

    def _stack(self, x: ast.AST, y: ast.AST) -> Array | None:
        """Return the vector of two numbers: (calls, worlds, 2)."""
        one, other = self.read(x), self.read(y)
        is_known = one is not None and other is not None and one.shape == other.shape
        return np.stack([one, other], axis=-1) if is_known else None  # type: ignore[list-item]

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
