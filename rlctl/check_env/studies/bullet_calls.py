"""Finds calls of PyBullet in Python source, and those of them that are doubtful."""

from __future__ import annotations

import ast
import inspect
import re
from collections.abc import Iterator
from typing import Any

NO_CLIENT = re.compile(
    r"connect|error|getAPIVersion|isNumpyEnabled|submitProfileTiming|rotateVector|calculateVelocityQuaternion"
    r"|(multiply|invert)Transforms?|compute(View|Projection)Matrix\w*|get\w*Quaternion\w*|getEuler\w*|getMatrix\w*"
)
"""Functions that are the same for every client: mathematics, and what makes one."""
FIRST_IS_CLIENT = {
    "disconnect", "getConnectionInfo", "getNumBodies", "getNumConstraints", "isConnected", "performCollisionDetection",
    "getKeyboardEvents", "getMouseEvents", "getPhysicsEngineParameters", "removeAllUserDebugItems", "saveState",
    "stepSimulation",
}  # fmt: skip
"""Functions whose only positional argument is the client."""
CLIENT_WORDS = re.compile(r"client|\bcid\b|_cid\b|server", re.IGNORECASE)
"""How a client that is passed by its place is called."""

Found = tuple[str, ast.Call]


def takes_client(pybullet: Any) -> set[str]:
    """Return the names of PyBullet's functions that act on one client; empty where it is not loaded."""
    names = dir(pybullet) if pybullet is not None else []
    return {name for name in names if inspect.isbuiltin(getattr(pybullet, name)) and not NO_CLIENT.fullmatch(name)}


class Reader:
    """Reads parts of one file."""

    def __init__(self, tree: ast.Module, takes_client: set[str]) -> None:
        self._takes_client = takes_client
        self._modules: set[str] = set()
        """What PyBullet is called in the file."""
        self._functions: dict[str, str] = {}
        """What its functions are called that are imported by name."""
        for node in ast.walk(tree):
            self._import(node)
        self._rebound = _bound(tree.body)

    def _import(self, node: ast.AST) -> None:
        if isinstance(node, ast.Import):
            self._modules |= {each.asname or each.name for each in node.names if each.name == "pybullet"}
        elif isinstance(node, ast.ImportFrom):
            for each in node.names:
                if each.name == "pybullet":  # re-exported by another module
                    self._modules.add(each.asname or each.name)
                elif node.module == "pybullet" and each.name == "*":
                    self._functions |= {name: name for name in self._takes_client}
                elif node.module == "pybullet":
                    self._functions[each.asname or each.name] = each.name

    def read(self, node: ast.AST) -> Iterator[Found]:
        """Yield what is doubtful in a function or another part: what it is, and the call."""
        yield from self._read(node, self._rebound)

    def _read(self, node: ast.AST, rebound: set[str]) -> Iterator[Found]:
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            # A name that the function gives to something else (a BulletClient called p) is no module there.
            rebound = rebound | _arguments(node.args) | _bound(node.body)
            yield from (("centre_as_frame", call) for call in _centres(node))
        if isinstance(node, ast.Call):
            name = self._function(node.func, rebound)
            if name in self._takes_client and not _has_client(name, node):
                yield "without_client", node
            if _is_force_at_origin(node):
                yield "force_at_origin", node
        for child in ast.iter_child_nodes(node):
            yield from self._read(child, rebound)

    def _function(self, func: ast.expr, rebound: set[str]) -> str:
        """Return the name of PyBullet's function that is called; empty for another call."""
        if isinstance(func, ast.Attribute) and isinstance(func.value, ast.Name):
            known = func.value.id in self._modules and func.value.id not in rebound
            return func.attr if known else ""
        if isinstance(func, ast.Name) and func.id not in rebound:
            return self._functions.get(func.id, "")
        return ""


def _has_client(name: str, call: ast.Call) -> bool:
    if any(each.arg in (None, "physicsClientId") for each in call.keywords):
        return True
    if any(isinstance(each, ast.Starred) or CLIENT_WORDS.search(ast.unparse(each)) for each in call.args):
        return True
    return name in FIRST_IS_CLIENT and bool(call.args)


def _arguments(arguments: ast.arguments) -> set[str]:
    return {each.arg for each in (*arguments.posonlyargs, *arguments.args, *arguments.kwonlyargs)}


def _bound(statements: list[ast.stmt]) -> set[str]:
    """Return the names that statements give a value, functions and classes inside them left out."""
    names: set[str] = set()
    nodes: list[ast.AST] = list(statements)
    while nodes:
        node = nodes.pop()
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef | ast.Lambda):
            continue
        if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            names.add(node.id)
        nodes += ast.iter_child_nodes(node)
    return names


def _called(node: ast.AST) -> str:
    """Return the last part of the name of what is called."""
    if isinstance(node, ast.Call):
        func = node.func
        return func.attr if isinstance(func, ast.Attribute) else func.id if isinstance(func, ast.Name) else ""
    return ""


def _centres(function: ast.FunctionDef | ast.AsyncFunctionDef) -> Iterator[ast.Call]:
    """Yield the calls of getLinkState whose first element is used: at once, by a name, or by unpacking."""
    states: dict[str, ast.Call] = {}
    for node in ast.walk(function):
        if isinstance(node, ast.Assign) and isinstance(node.value, ast.Call) and _called(node.value) == "getLinkState":
            for target in node.targets:
                if isinstance(target, ast.Name):
                    states[target.id] = node.value
                elif isinstance(target, ast.Tuple) and _takes_first(target):
                    yield node.value
    taken = [node for node in ast.walk(function) if isinstance(node, ast.Subscript)]
    # Whoever takes the link frame too knows which of them is which.
    knows = {ast.unparse(node.value) for node in taken if _is_number(node.slice, 4)}
    for node in taken:
        if _is_number(node.slice, 0) and ast.unparse(node.value) not in knows:
            if isinstance(node.value, ast.Call) and _called(node.value) == "getLinkState":
                yield node.value
            elif isinstance(node.value, ast.Name) and node.value.id in states:
                yield states[node.value.id]


def _takes_first(target: ast.Tuple) -> bool:
    first = target.elts[0] if target.elts else None
    knows = len(target.elts) > 4 and isinstance(target.elts[4], ast.Name) and target.elts[4].id.strip("_")
    return isinstance(first, ast.Name) and bool(first.id.strip("_")) and not knows


def _is_force_at_origin(call: ast.Call) -> bool:
    """Say whether a force is applied at a literal (0, 0, 0) of the world."""
    if _called(call) != "applyExternalForce":
        return False
    given = dict(zip(("objectUniqueId", "linkIndex", "forceObj", "posObj", "flags"), call.args, strict=False))
    given.update({each.arg: each.value for each in call.keywords if each.arg})
    flags = ast.unparse(given["flags"]) if "flags" in given else ""
    return flags.endswith("WORLD_FRAME") and "posObj" in given and _is_origin(given["posObj"])


def _is_origin(node: ast.expr) -> bool:
    if isinstance(node, ast.List | ast.Tuple):
        return len(node.elts) == 3 and all(_is_number(each, 0) for each in node.elts)
    if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Mult):  # [0] * 3
        return isinstance(node.left, ast.List) and all(_is_number(each, 0) for each in node.left.elts)
    return isinstance(node, ast.Call) and _called(node) == "zeros"


def _is_number(node: ast.AST, number: float) -> bool:
    return isinstance(node, ast.Constant) and isinstance(node.value, (int, float)) and node.value == number
