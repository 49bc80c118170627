"""How often the loops of a step repeat their bodies, by the source: so many substeps a step may have."""

import ast
import itertools
import math
import operator
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from typing import Any

from rlctl.checking.values import find_author, list_own_classes, parse_sources

FIRST_CALLED = ("step", "act", "simulate", "do_simulation")
"""What begins a step of an environment, or of a task of rlctl."""
BINARY: Mapping[type[ast.operator], Callable[[float, float], float]] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.truediv,
    ast.FloorDiv: operator.floordiv,
}
ROUNDING: Mapping[str, Callable[[list[float]], float]] = {
    "int": lambda values: int(values[0]),
    "round": lambda values: round(values[0]),
    "max": max,
    "min": min,
}


def find_repeats(env: Any, declared: Mapping[str, float]) -> dict[str, int]:
    """Return how often loops that do not use their variable repeat, by what their `range` has: `SUB`, `round(DT / H)`.

    `declared` has the numbers of the object, its class and its module by name. Only loops in what a step calls count.
    """
    numbers = {name.rpartition(".")[2]: value for name, value in declared.items()}
    found: dict[str, int] = {}
    own = {cls.__name__ for cls in list_own_classes(find_author(env))}
    for function in _find_called(parse_sources(env).values(), own):
        local = numbers | _read_local(function, numbers)
        for repeats in _find_loops(function):
            value = _evaluate(repeats, local)
            if value is not None and math.isfinite(value) and value == int(value) > 1:
                found[ast.unparse(repeats)] = int(value)
    return found


def find_control_times(env: Any, declared: Mapping[str, float], repeats: Collection[int]) -> set[float]:
    """Return which declared times the source divides by how often a loop repeats, and the products of times and of such
    a number: how long a whole step takes, as its author means it [s]."""
    numbers = {name.rpartition(".")[2]: value for name, value in declared.items()}
    found: set[float] = set()
    for tree in parse_sources(env).values():
        for node in ast.walk(tree):
            if not isinstance(node, ast.BinOp) or not isinstance(node.op, ast.Div | ast.Mult):
                continue
            one, two = (_evaluate(part, numbers) if _name(part) else None for part in (node.left, node.right))
            if one is None or two is None:
                continue
            if isinstance(node.op, ast.Mult):
                found |= {one * two for count, time in ((one, two), (two, one)) if count in repeats and 0 < time < 1}
            elif two in repeats and 0 < one < 1:
                found.add(one)
    return found


def _find_called(trees: Iterable[ast.Module], own: Collection[str]) -> list[ast.FunctionDef]:
    """Return the functions, and methods of classes of some names, that a step calls as far as their names tell."""
    functions: dict[str, list[ast.FunctionDef]] = {}
    for tree in trees:
        bodies = [tree.body, *(node.body for node in tree.body if isinstance(node, ast.ClassDef) and node.name in own)]
        for node in itertools.chain.from_iterable(bodies):
            if isinstance(node, ast.FunctionDef):
                functions.setdefault(node.name, []).append(node)
    waiting, called = list(FIRST_CALLED), set[str]()
    while waiting:
        name = waiting.pop()
        if name in called or name not in functions:
            continue
        called.add(name)
        nodes = [node for function in functions[name] for node in ast.walk(function)]
        waiting += [_name(node.func) for node in nodes if isinstance(node, ast.Call)]
    return [function for name in called for function in functions[name]]


def _name(node: ast.expr) -> str:
    """Return the name of a variable, or the last one of an attribute; empty for anything else."""
    if isinstance(node, ast.Attribute):
        return node.attr
    return node.id if isinstance(node, ast.Name) else ""


def _read_local(function: ast.FunctionDef, numbers: Mapping[str, float]) -> dict[str, float]:
    """Return the variables of a function that are computed from known numbers."""
    found: dict[str, float] = {}
    for node in ast.walk(function):
        if isinstance(node, ast.Assign) and len(node.targets) == 1 and isinstance(node.targets[0], ast.Name):
            value = _evaluate(node.value, {**numbers, **found})
            if value is not None:
                found[node.targets[0].id] = value
    return found


def _find_loops(function: ast.FunctionDef) -> Iterator[ast.expr]:
    """Yield how often each loop repeats whose variable its body does not use."""
    for loop in ast.walk(function):
        if not isinstance(loop, ast.For) or not isinstance(loop.target, ast.Name):
            continue
        call = loop.iter
        is_range = isinstance(call, ast.Call) and _name(call.func) == "range" and len(call.args) == 1
        used = {node.id for part in loop.body for node in ast.walk(part) if isinstance(node, ast.Name)}
        if is_range and loop.target.id not in used:
            assert isinstance(call, ast.Call)
            yield call.args[0]


def _evaluate(node: ast.expr, numbers: Mapping[str, float]) -> float | None:
    """Return the value of an expression; None where it has anything but known numbers."""
    if isinstance(node, ast.Constant):
        return node.value if isinstance(node.value, int | float) else None
    if isinstance(node, ast.BinOp) and type(node.op) in BINARY:
        left, right = _evaluate(node.left, numbers), _evaluate(node.right, numbers)
        if left is None or right is None or (right == 0 and isinstance(node.op, ast.Div | ast.FloorDiv)):
            return None
        return BINARY[type(node.op)](left, right)
    if isinstance(node, ast.Call) and _name(node.func) in ROUNDING and node.args:
        values = [_evaluate(part, numbers) for part in node.args]
        known = [value for value in values if value is not None and math.isfinite(value)]
        return ROUNDING[_name(node.func)](known) if len(known) == len(values) else None
    return numbers.get(_name(node))
