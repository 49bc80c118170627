"""Kernels in the source of a reward, such as exp(-d / width), that are given another quantity than their name says, or
the width in place of the quantity."""

import ast
import dataclasses
import functools
from collections.abc import Iterator

import numpy as np

from rlctl.checking.assignments import list_name_words, list_parameters, list_returned, read_key, read_name
from rlctl.checking.definitions import ReadExpression
from rlctl.checking.experiments.expressions import NotedEpisodes
from rlctl.checking.paid_errors import FEWEST
from rlctl.checking.products import list_product
from rlctl.checking.source_code import Function
from rlctl.checking.term_names import split_name

KINDS = {
    "distance": {
        *("near", "nearness", "dist", "distance", "close", "closeness", "reach", "proximity", "d", "gap", "range"),
    },
    "heading": {"turn", "heading", "yaw", "bearing", "facing", "align", "aligned", "alignment", "direction"},
    "tilt": {"tilt", "upright", "level", "lean", "roll", "pitch"},
    "speed": {"speed", "vel", "velocity", "still", "slow", "rest", "stop", "stopped"},
    "height": {"height", "altitude", "z"},
}
"""By which words quantities are called."""
OTHER_WORDS = {
    *("rate", "cost", "action", "actions", "effort", "energy", "torque", "change", "smooth", "acc", "progress"),
    *("total", "limit", "max", "min", "limits", "width", "scale", "sigma", "std", "tolerance", "tol"),
}
"""Words next to which the others may mean something else."""
KERNELS = {"exp", "tanh", "closeness", "gauss", "gaussian", "rbf", "bell"}
MOST_NODES = 60  # of a function that is a kernel


@dataclasses.dataclass(frozen=True, eq=False)
class _Term:
    """A kernel in a product that is called something."""

    name: str
    call: ast.Call
    given: ast.expr  # the quantity
    function: Function
    product: list[ast.expr]


@dataclasses.dataclass(frozen=True, eq=False)
class OtherQuantity:
    """A kernel of another quantity than its name says."""

    name: str
    named: str  # the kind of quantity that the name says
    call: ast.Call
    given: ast.expr
    kind: str
    meant: str  # an expression of the kind that the name says


class KernelReader:
    """Finds them."""

    def __init__(self, notes: NotedEpisodes) -> None:
        self.notes, self.definitions = notes, notes.definitions

    def find_others(self) -> Iterator[OtherQuantity]:
        """Yield kernels of another quantity, where the source pays this one by its own name, too."""
        for term in self._terms:
            named, kind = _read_kind({*split_name(term.name)}), self._find_kind(term)
            if not named or not kind or named == kind or self._has_kind(term, named):
                continue
            others = [one for one in self._terms if ast.unparse(one.given) == ast.unparse(term.given)]
            is_paid = any(_read_kind({*split_name(one.name)}) == kind for one in others)
            meant = self._find_meant(term, named)
            if is_paid and meant:
                yield OtherQuantity(term.name, named, term.call, term.given, kind, meant)

    def find_exchanged(self) -> Iterator[ast.Call]:
        """Yield calls of own kernels that are given a constant as the quantity, and the quantity as the width."""
        for one in self.notes.source.expressions:
            match one.node:
                case ast.Call(func=ast.Name() | ast.Attribute(), args=[first, second]) if places := self._find_width(
                    one.node
                ):
                    quantity, width = (first, second) if places == (0, 1) else (second, first)
                    if self._is_constant(quantity) and self._varies(width):
                        yield one.node

    @functools.cached_property
    def _terms(self) -> list[_Term]:
        found: list[_Term] = []
        for function in self.notes.functions:
            if function not in self.notes.of_steps:
                continue
            for several in self.definitions.list_assigned(function).values():
                for one in several:
                    if one.element is None and not one.is_part:
                        found += self._list_kernels(read_key(one.target) or read_name(one.target), one.value, function)
            for node in ast.walk(function):
                if isinstance(node, ast.Dict):
                    for key, value in zip(node.keys, node.values, strict=True):
                        if isinstance(key, ast.Constant):
                            found += self._list_kernels(str(key.value), value, function)
        return found

    def _list_kernels(self, name: str, value: ast.expr, function: Function) -> Iterator[_Term]:
        factors = list_product(value)
        for factor in factors:
            if isinstance(factor, ast.Call) and factor.args and self._is_kernel(factor):
                yield _Term(name, factor, self._find_given(factor), function, factors)

    def _is_kernel(self, call: ast.Call) -> bool:
        if read_name(call.func) in KERNELS:
            return True
        own = self.definitions.find_function(read_name(call.func)) if len(call.args) <= 3 else None
        if own is None or not list_parameters(own) or sum(1 for _ in ast.walk(own)) > MOST_NODES:
            return False
        calls = [node for value in list_returned(own) for node in ast.walk(value) if isinstance(node, ast.Call)]
        return any(read_name(node.func) in KERNELS for node in calls)

    def _find_given(self, call: ast.Call) -> ast.expr:
        """Return the quantity of a kernel: of `exp(-(d / width) ** 2)` it is `d`."""
        node: ast.expr = call.args[0]
        while True:
            match node:
                case ast.UnaryOp(operand=inner) | ast.BinOp(left=inner, op=ast.Pow()):
                    node = inner
                case ast.BinOp(left=left, op=ast.Mult() | ast.Div(), right=right):
                    node = left if self._varies(left) else right
                case ast.Call(func=ast.Name(id="abs") | ast.Attribute(attr="abs" | "square"), args=[inner]):
                    node = inner
                case _:
                    return node

    def _find_kind(self, term: _Term) -> str:
        """Return the kind of quantity that a kernel is given, by its name or by that of what it stands for."""
        kind = _read_kind(list_name_words(term.given))
        place = ReadExpression(term.given, term.function)
        for _ in range(2):
            if kind or len(found := self.definitions.follow(place)) != 1:
                break
            place = found[0]
            kind = _read_kind(list_name_words(place.node))
        return kind

    def _has_kind(self, term: _Term, kind: str) -> bool:
        """Say whether another factor of the product is of a kind."""
        others = [factor for factor in term.product if factor is not term.call]
        return any(KINDS[kind] & list_name_words(factor) for factor in others)

    def _find_meant(self, term: _Term, kind: str) -> str:
        """Return another number of the same function that is of a kind, and is no term itself."""
        names = {one.name for one in self._terms}
        for one in self.notes.source.expressions:
            name = read_name(one.node) if isinstance(one.node, ast.Name | ast.Attribute | ast.Call) else ""
            is_other = name not in names and one.function is term.function and one.node not in ast.walk(term.call)
            if is_other and _read_kind(set(split_name(name))) == kind and self._varies(one.node):
                return one.text
        return ""

    def _find_width(self, call: ast.Call) -> tuple[int, int] | None:
        """Return at which places a kernel is given the quantity and the width."""
        own = self.definitions.find_function(read_name(call.func)) if self._is_kernel(call) else None
        if own is None and read_name(call.func) == "closeness":
            return 0, 1
        names = [] if own is None else list_parameters(own)
        for value in [] if own is None else list_returned(own):
            for node in ast.walk(value):
                if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Div):
                    above, below = _list_places(node.left, names), _list_places(node.right, names)
                    if len(above) == 1 and len(below) == 1 and above != below and max(*above, *below) < 2:
                        return above.pop(), below.pop()
        return None

    def _is_constant(self, node: ast.expr) -> bool:
        return self.notes.reward.numbers.read_constant(node) is not None

    def _varies(self, node: ast.expr) -> bool:
        values = self.notes.reward.numbers.list_values(node)
        return values.size >= FEWEST and float(np.ptp(values)) > 0


def _list_places(node: ast.expr, names: list[str]) -> set[int]:
    """Return which of some names an expression has, by their places."""
    return {names.index(one.id) for one in ast.walk(node) if isinstance(one, ast.Name) and one.id in names}


def _read_kind(words: set[str]) -> str:
    """Return the kind of quantity that words name; empty if they name none, or several."""
    kinds = [kind for kind, own in KINDS.items() if own & words]
    return kinds[0] if len(kinds) == 1 and not words & OTHER_WORDS else ""
