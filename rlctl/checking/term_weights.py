"""Finds in the source of an environment which reward terms have a weight that is not 0."""

import ast
import contextlib
import dataclasses
import functools
import inspect
import math
import sys
import textwrap
from collections.abc import Iterator
from typing import Any

from rlctl.checking.assignments import list_assignments, list_values, read_converted
from rlctl.checking.values import NUMBERS, find_author, list_own_classes

DEEPEST = 6  # names and methods that are followed
SHALLOW = 3  # the same, from a term to the action: what is further away is the robot, which the action moves
LIMITS = {"clip", "fmax", "fmin", "heaviside", "max", "maximum", "min", "minimum", "relu", "where"}
"""Functions with which a term may be 0 where nothing exceeds a limit."""
COMPUTED, UNKNOWN = "computed", math.nan  # what else than a known number a factor may be
Factor = float | str
Place = tuple[str, int]


@dataclasses.dataclass(frozen=True)
class _TermSource:
    """The methods of an object, in which expressions are read."""

    author: Any
    methods: list[tuple[str, ast.FunctionDef]]

    @functools.cached_property
    def states(self) -> frozenset[str]:
        """The attributes that other methods than the constructor assign."""
        return frozenset(
            node.attr
            for _, method in self.methods
            if method.name != "__init__"
            for node in ast.walk(method)
            if isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Store)
        )

    def list_entries(self) -> Iterator[tuple[str, list[Factor], Place]]:
        """Yield each value that gets a constant key in a dictionary, as its key, its factors and its place."""
        for file, method in self.methods:
            for node in ast.walk(method):
                for key, value in _read_entries(node):
                    yield key, self.list_factors(value, method), (file, value.lineno)

    def list_factors(self, value: ast.expr, function: ast.FunctionDef, depth: int = 0) -> list[Factor]:
        """Return the factors of a product; of anything else, the value itself is the only one."""
        if depth > DEEPEST:
            return [UNKNOWN]

        def follow(part: ast.expr, inside: ast.FunctionDef = function) -> list[Factor]:
            return self.list_factors(part, inside, depth + 1)

        match value:
            case ast.UnaryOp(operand=operand):
                return follow(operand)
            case ast.BinOp(left=left, op=ast.Mult(), right=right):
                return follow(left) + follow(right)
            case ast.BinOp(left=left, op=ast.Div()):
                return follow(left)
            case ast.Constant(value=str()):
                return []  # a unit, or a name
            case ast.Constant(value=number):
                return [float(number) if isinstance(number, NUMBERS) else UNKNOWN]
            case ast.Call() if (inner := read_converted(value)) is not None:
                return follow(inner)
            case ast.Call(func=ast.Attribute(value=ast.Name(id="self"), attr=name)):
                method = next((one for _, one in self.methods if one.name == name), None)
                returned = [node.value for node in ast.walk(method) if isinstance(node, ast.Return)] if method else []
                return follow(returned[0], method) if method and len(returned) == 1 and returned[0] else [UNKNOWN]
            case ast.Name(id=name):
                assigned = list_values(function, name)
                if assigned:
                    return follow(assigned[0]) if len(assigned) == 1 else [UNKNOWN]
                return [self._read_number(value)]
            case ast.Attribute(value=ast.Name(id="self"), attr=name) if name in self.states:
                return [COMPUTED]
            case ast.Attribute() | ast.Subscript():
                return [self._read_number(value)]
            case ast.BinOp() | ast.Call() | ast.Compare():
                return [COMPUTED]
        return [UNKNOWN]

    def is_of_action(self, value: ast.expr, function: ast.FunctionDef, depth: int = 0) -> bool | None:
        """Say whether a value is computed from the action; None where a limit or a condition decides what counts."""
        found = False
        for node in ast.walk(value):
            parts: list[tuple[ast.expr, ast.FunctionDef]] = []
            match node:
                case ast.Compare() | ast.IfExp() | ast.BoolOp():
                    return None
                case ast.Call(func=ast.Name(id=name) | ast.Attribute(attr=name)) if name in LIMITS:
                    return None
                case ast.Name(id=name, ctx=ast.Load()) if name in {"action", "actions"}:
                    found = True
                case ast.Name(id=name, ctx=ast.Load()):
                    parts = [(assigned, function) for assigned in list_values(function, name)]
                case ast.Attribute(value=ast.Name(id="self"), attr=name, ctx=ast.Load()):
                    parts = self._list_sources(name)
            for part, inside in parts if depth < SHALLOW else ():
                is_part = self.is_of_action(part, inside, depth + 1)
                if is_part is None:
                    return None
                found |= is_part
        return found

    def _list_sources(self, name: str) -> list[tuple[ast.expr, ast.FunctionDef]]:
        """Return what the methods assign to an attribute, and what a method of this name returns."""
        found: list[tuple[ast.expr, ast.FunctionDef]] = []
        for _, method in self.methods:
            several = [one for one in list_assignments(method) if ast.unparse(one.target) == f"self.{name}"]
            found += [(one.value, method) for one in several if one.element is None and one.is_known]
            returns = [node for node in ast.walk(method) if isinstance(node, ast.Return) and method.name == name]
            found += [(node.value, method) for node in returns if node.value is not None]
        return found

    def _read_number(self, value: ast.expr) -> float:
        """Return the present number of a name, an attribute or an entry; `UNKNOWN` where it is none."""
        found = self._look_up(value)
        return float(found) if isinstance(found, NUMBERS) else UNKNOWN

    def _look_up(self, value: ast.expr) -> Any:
        match value:
            case ast.Name(id="self"):
                return self.author
            case ast.Name(id=name):
                module = sys.modules[type(self.author).__module__]
                return vars(module).get(name)
            case ast.Attribute(value=owner, attr=name):
                found = self._look_up(owner)
                return inspect.getattr_static(found, name, None) if found is not None else None
            case ast.Subscript(value=owner, slice=ast.Constant(value=key)):
                found = self._look_up(owner)
                return found.get(key) if isinstance(found, dict) else None
        return None


def find_weighed_terms(env: Any) -> dict[str, Place]:
    """Return file and line of what is computed for each key of a dictionary that the source has, where it is multiplied
    by known numbers other than 0, and the key has no other weight."""
    author = find_author(env)
    entries: dict[str, list[tuple[list[Factor], Place]]] = {}
    for key, factors, place in _TermSource(author, list_methods(author)).list_entries():
        entries.setdefault(key, []).append((factors, place))
    spaces = [vars(sys.modules[cls.__module__]) | vars(cls) for cls in reversed(list_own_classes(author))]
    dictionaries = [one for space in [*spaces, vars(author)] for one in space.values() if isinstance(one, dict)]
    held = {key: value for one in dictionaries for key, value in one.items() if isinstance(key, str)}
    found = {}
    for key, listed in entries.items():
        factors = [factor for some, _ in listed for factor in some]
        factors += [float(held[key])] if isinstance(held.get(key), NUMBERS) else []
        weights = [factor for factor in factors if factor != COMPUTED]
        if COMPUTED in factors and weights and all(isinstance(w, float) and w and math.isfinite(w) for w in weights):
            found[key] = next(place for some, place in listed if COMPUTED in some)
    return found


def find_action_terms(env: Any) -> set[str]:
    """Return the keys of dictionaries whose values the source computes from the action, without a limit or a
    condition."""
    author = find_author(env)
    source = _TermSource(author, list_methods(author))
    found: dict[str, list[bool | None]] = {}
    for _, method in source.methods:
        for node in ast.walk(method):
            for key, value in _read_entries(node):
                found.setdefault(key, []).append(source.is_of_action(value, method))
    return {key for key, each in found.items() if all(each)}


def list_methods(author: Any) -> list[tuple[str, ast.FunctionDef]]:
    """Return the methods that an object has of its own classes, each with its file; line numbers are those of the
    file."""
    methods: dict[str, Any] = {}
    for cls in list_own_classes(author):
        for name, member in vars(cls).items():
            methods.setdefault(name, member.__func__ if isinstance(member, staticmethod | classmethod) else member)
    found = []
    for method in methods.values():
        with contextlib.suppress(OSError, TypeError, SyntaxError, ValueError):
            lines, first = inspect.getsourcelines(method)
            (node,) = ast.parse(textwrap.dedent("".join(lines))).body
            if isinstance(node, ast.FunctionDef):
                ast.increment_lineno(node, first - 1)
                found.append((str(inspect.getsourcefile(method)), node))
    return found


def _read_entries(node: ast.AST) -> Iterator[tuple[str, ast.expr]]:
    match node:
        case ast.Dict(keys=keys, values=values):
            for key, value in zip(keys, values, strict=True):
                if isinstance(key, ast.Constant) and isinstance(key.value, str):
                    yield key.value, value
        case ast.Assign(targets=[ast.Subscript(slice=ast.Constant(value=str(key)))], value=value):
            yield key, value
        case ast.Call(func=ast.Name(id="dict"), keywords=keywords):
            for keyword in keywords:
                if keyword.arg:
                    yield keyword.arg, keyword.value
