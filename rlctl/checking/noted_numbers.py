"""The numbers that expressions of a source were worth in the steps that were noted, and which never change."""

import ast
import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from rlctl.checking.definitions import Definitions, ReadExpression
from rlctl.checking.expressions import NotedCall

MOST_HOPS = 6  # names that are followed to a value


class NotedNumbers:
    """Reads them."""

    def __init__(self, definitions: Definitions, calls: Sequence[NotedCall]) -> None:
        self.definitions, self.source, self.calls = definitions, definitions.source, calls
        self._values: dict[ast.expr, NDArray[np.float64]] = {}

    def read_constant(self, node: ast.expr) -> float | None:
        """Return the number of a constant, of a name in capitals, or of an attribute that `step` never assigns."""
        match node:
            case ast.Constant(value=bool() | str()):
                return None
            case ast.Constant(value=int() | float() as value):
                return float(value)
            case ast.UnaryOp(op=ast.USub(), operand=operand):
                inner = self.read_constant(operand)
                return None if inner is None else -inner
            case ast.BinOp(left=left, right=right):
                parts = self.read_constant(left), self.read_constant(right)
                if None in parts:
                    return None
            case ast.Name(id=name) if not name.isupper():
                return None
            case ast.Name(id=name):
                known = [vars(module)[name] for module in self.source.modules if name in vars(module)]
                if known and isinstance(known[0], int | float):
                    return float(known[0])
            case ast.Attribute() | ast.Subscript():
                text = ast.unparse(node)
                if any(text in self.definitions.list_assigned(one) for one in self.definitions.called):
                    return None
                if text.startswith("self.") and isinstance(node, ast.Attribute):
                    kept = getattr(self.source.author, node.attr, None)
                    if type(kept) in (int, float) and text.count(".") == 1:
                        return float(kept)  # type: ignore[arg-type]
            case _:
                return None
        values = self.list_values(node)
        return float(values[0]) if values.size and (values == values[0]).all() else None

    def list_values(self, node: ast.expr) -> NDArray[np.float64]:
        """Return all numbers that an expression was worth in the steps, in one row."""
        if node not in self._values:
            self._values[node] = self._join_values(node)
        return self._values[node]

    def _join_values(self, node: ast.expr) -> NDArray[np.float64]:
        one = self.source.find(node)
        if isinstance(node, ast.Constant) and isinstance(node.value, int | float):
            return np.array([float(node.value)])
        found = [value for call in self.calls for value in call.values.get(one.number, [])] if one is not None else []
        numbers = [np.ravel(value) for value in found if value is not None]
        return np.concatenate(numbers) if numbers else np.zeros(0)

    def list_arrays(self, place: ReadExpression) -> list[NDArray[np.float64]]:
        """Return what an expression was worth each time. The owner of an index, `x` of `x[0]`, is not noted itself:
        then it is what it stands for."""
        for _ in range(MOST_HOPS):
            one = self.source.find(place.node)
            found = [value for call in self.calls for value in call.values.get(one.number, ())] if one else []
            if found:
                return [np.asarray(value) for value in found if value is not None]
            followed = self.definitions.follow(place)
            if len(followed) != 1:
                break
            place = followed[0]
        return []

    def read_nth(self, node: ast.expr, order: int, count: int) -> float:
        """Return a number that is evaluated `count` times in a call, at one of these times; NaN if it is not."""
        if isinstance(node, ast.Constant) and isinstance(node.value, int | float):
            return float(node.value)
        one = self.source.find(node)
        for call in self.calls if one is not None else ():
            values = call.values.get(one.number, []) if one is not None else []
            if len(values) == count and isinstance(values[order], float):
                return float(values[order])  # type: ignore[arg-type]
        return math.nan
