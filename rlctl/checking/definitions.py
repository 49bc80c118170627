"""What the names, attributes and calls in an environment's source stand for: the expressions that define them."""

import ast
import dataclasses
from collections.abc import Iterator, Mapping, Sequence

from rlctl.checking.expressions import Function, NotedCall, SourceCode

CONVERSIONS = {
    "array", "asarray", "astype", "atleast_1d", "copy", "flatten", "float", "float32", "float64", "item",
    "nan_to_num", "ravel", "squeeze",
}  # fmt: skip
"""Functions and methods that return the numbers they are given."""
LIBRARIES = {"jnp", "math", "mujoco", "np", "numpy", "p", "pybullet", "torch"}
DEEPEST = 12  # names and calls that are followed
BEGINNINGS = {"__init__", "reset", "reset_model", "__post_init__"}


@dataclasses.dataclass(frozen=True, eq=False)
class ReadExpression:
    """An expression, and what the function in which it stands was called with."""

    node: ast.expr
    function: Function
    arguments: Mapping[str, "ReadExpression"]
    depth: int = 0

    def at(self, node: ast.expr) -> "ReadExpression":
        """Return the place of another expression of the same call."""
        return dataclasses.replace(self, node=node)


@dataclasses.dataclass(frozen=True, eq=False)
class Assigned:
    """A statement that gives a value to a name, an attribute, or an entry of a dictionary."""

    statement: ast.stmt
    value: ast.expr
    element: int | None  # of the value, where it is assigned to several names
    sign: float = 1.0  # of what `+=` and `-=` add
    adds: bool = False


class Definitions:
    """Finds the expressions that define others."""

    def __init__(self, source: SourceCode, calls: Sequence[NotedCall]) -> None:
        self.source = source
        self._first: dict[Function, int] = {}
        for call in [*calls[:3], *calls[-3:]]:
            for order, (number, _) in enumerate(call.events):
                self._first.setdefault(source.expressions[number].function, order)
        self._assigned: dict[Function, dict[str, list[Assigned]]] = {}
        self.called = [one for one in self._first if one.name not in BEGINNINGS]

    def find_function(self, name: str) -> Function | None:
        """Return the function of a name that is called first; None if there is none."""
        named = self.source.functions.get(name, ())
        called = sorted((one for one in named if one in self._first), key=lambda one: self._first[one])
        return called[0] if called else named[0] if len(named) == 1 else None

    def list_assigned(self, function: Function) -> Mapping[str, Sequence[Assigned]]:
        """Return what a function assigns, by what stands to the left, in order."""
        if function not in self._assigned:
            found: dict[str, list[Assigned]] = {}
            for node in ast.walk(function):
                for target, assigned in _read_assigned(node):
                    found.setdefault(ast.unparse(target), []).append(assigned)
            for several in found.values():
                several.sort(key=lambda one: one.statement.lineno)
            self._assigned[function] = found
        return self._assigned[function]

    def list_before(self, place: ReadExpression) -> list[Assigned]:
        """Return what was assigned to a name or attribute before this place, from the last time on that it was
        replaced in any case."""
        text = ast.unparse(place.node)
        several = [
            one
            for one in self.list_assigned(place.function).get(text, ())
            if (one.statement.end_lineno or 0) < place.node.lineno
        ]
        for index in range(len(several) - 1, -1, -1):
            one = several[index]
            if not one.adds and self.source.parents.get(one.statement) is place.function:
                return several[index:]
        return several

    def follow(self, place: ReadExpression) -> list[ReadExpression]:
        """Return the expressions that a name, an attribute or a call of an own function stands for."""
        if place.depth > DEEPEST:
            return []
        place = dataclasses.replace(place, depth=place.depth + 1)
        node = place.node
        match node:
            case ast.Call(func=ast.Name(id=name) | ast.Attribute(attr=name)):
                return self._follow_call(place, node, name)
            case ast.Name() | ast.Attribute() | ast.Subscript():
                before = self.list_before(place)
                if before:
                    return [] if any(one.adds for one in before) else self._select_all(place, before)
                if isinstance(node, ast.Name):
                    return [place.arguments[node.id]] if node.id in place.arguments else []
                return self._follow_attribute(place)
        return []

    def _follow_call(self, place: ReadExpression, node: ast.Call, name: str) -> list[ReadExpression]:
        if name in CONVERSIONS:
            inner = node.args[0] if node.args and name not in ("astype", "item", "copy", "flatten", "ravel") else None
            if inner is None and isinstance(node.func, ast.Attribute):
                inner = node.func.value
            return [] if inner is None else [place.at(inner)]
        return self.list_returned(place)

    def list_returned(self, place: ReadExpression) -> list[ReadExpression]:
        """Return what the own function that is called returns."""
        node = place.node
        match node:
            case ast.Call(func=ast.Name(id=name)):
                function = self.find_function(name)
            case ast.Call(func=ast.Attribute(value=ast.Name() | ast.Attribute() as owner, attr=name)) if (
                _find_root(owner) not in LIBRARIES
            ):
                function = self.find_function(name)
            case _:
                return []
        if function is None or place.depth > DEEPEST:
            return []
        names = [one.arg for one in [*function.args.posonlyargs, *function.args.args]]
        if names[:1] in (["self"], ["cls"]):
            names = names[1:]
        arguments = {key: place.at(value) for key, value in zip(names, node.args, strict=False)}
        arguments |= {word.arg: place.at(word.value) for word in node.keywords if word.arg}
        returned = [one.value for one in ast.walk(function) if isinstance(one, ast.Return) and one.value is not None]
        return [ReadExpression(value, function, arguments, place.depth) for value in returned]

    def _follow_attribute(self, place: ReadExpression) -> list[ReadExpression]:
        text = ast.unparse(place.node)
        if isinstance(place.node, ast.Attribute):
            function = self.find_function(place.node.attr)
            if function is not None and any("property" in ast.unparse(one) for one in function.decorator_list):
                returned = [one.value for one in ast.walk(function) if isinstance(one, ast.Return) and one.value]
                return [ReadExpression(value, function, {}, place.depth) for value in returned]
        found: list[ReadExpression] = []
        for function in self.called:
            if function is not place.function:
                several = self.list_assigned(function).get(text, ())
                if any(one.adds for one in several):
                    return []
                inside = ReadExpression(place.node, function, {}, place.depth)
                found += self._select_all(inside, several)
        return found

    def _select_all(self, place: ReadExpression, several: Sequence[Assigned]) -> list[ReadExpression]:
        return [part for one in several for part in self.select(place.at(one.value), one.element)]

    def select(self, place: ReadExpression, element: int | None) -> list[ReadExpression]:
        """Return the element of a tuple that an expression is worth, as far as it can be seen."""
        if element is None:
            return [place]
        if isinstance(place.node, ast.Tuple | ast.List):
            return [place.at(place.node.elts[element])] if element < len(place.node.elts) else []
        return [part for one in self.follow(place) for part in self.select(one, element)]

    def resolve(self, place: ReadExpression) -> ReadExpression:
        """Follow names and calls as long as each stands for one expression only."""
        while True:
            found = self.follow(place)
            if len(found) != 1:
                return place
            place = found[0]

    def walk(self, place: ReadExpression, most: int = 60) -> Iterator[ReadExpression]:
        """Yield an expression, its parts, and those of what they stand for."""
        waiting, seen = [place], set[ast.AST]()
        while waiting and len(seen) < most * 10:
            one = waiting.pop()
            if one.node in seen:
                continue
            seen.add(one.node)
            yield one
            waiting += self.follow(one) or self._list_iterated(one)
            waiting += [one.at(part) for part in _list_parts(one.node)]

    def _list_iterated(self, place: ReadExpression) -> list[ReadExpression]:
        """Return through what a comprehension goes whose variable a name is."""
        node: ast.AST = place.node
        while isinstance(place.node, ast.Name) and isinstance(node, ast.expr | ast.comprehension):
            for loop in getattr(node, "generators", ()):
                if any(isinstance(one, ast.Name) and one.id == place.node.id for one in ast.walk(loop.target)):
                    return [place.at(loop.iter)]
            node = self.source.parents[node]
        return []


def _find_root(node: ast.expr) -> str:
    """Return the name with which `a.b.c` begins."""
    while isinstance(node, ast.Attribute):
        node = node.value
    return node.id if isinstance(node, ast.Name) else ""


def _list_parts(node: ast.AST) -> Iterator[ast.expr]:
    for part in ast.iter_child_nodes(node):
        if isinstance(part, ast.expr):
            yield part
        else:
            yield from _list_parts(part)


def _read_assigned(node: ast.AST) -> Iterator[tuple[ast.expr, Assigned]]:
    match node:
        case ast.Assign(targets=targets, value=value):
            for target in targets:
                if isinstance(target, ast.Tuple | ast.List):
                    for element, part in enumerate(target.elts):
                        yield part, Assigned(node, value, element)
                else:
                    for part, sign, adds in _read_added(target, value):
                        yield target, Assigned(node, part, None, sign, adds)
        case ast.AnnAssign(target=target, value=value) if value is not None:
            yield target, Assigned(node, value, None)
        case ast.AugAssign(target=target, op=ast.Add() | ast.Sub() as operator, value=value):
            sign = 1.0 if isinstance(operator, ast.Add) else -1.0
            yield target, Assigned(node, value, None, sign, True)


def _read_added(target: ast.expr, value: ast.expr) -> list[tuple[ast.expr, float, bool]]:
    """Return what `x = x + a - b` adds to x, with the signs; otherwise the value itself."""
    text, node = ast.unparse(target), value
    parts: list[tuple[ast.expr, float, bool]] = []
    while isinstance(node, ast.BinOp) and isinstance(node.op, ast.Add | ast.Sub):
        parts.insert(0, (node.right, 1.0 if isinstance(node.op, ast.Add) else -1.0, True))
        node = node.left
    return parts if parts and ast.unparse(node) == text else [(value, 1.0, False)]
