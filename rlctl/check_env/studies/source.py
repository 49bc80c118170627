"""Reads the classes that somebody wrote for an environment: mistakes with PyBullet that show in the text alone.

What counts is what an instance runs: the methods of its class that no class before it overrides, the objects that it
holds, and the functions of their modules that these use.
"""

from __future__ import annotations

import ast
import inspect
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from rlctl.check_env.context import Context
from rlctl.check_env.studies import bullet_calls
from rlctl.check_env.studies.link_reads import links_read
from rlctl.check_env.wire import Message, result
from rlctl.check_env.world_results import Place, Source

NOT_THEIRS = ("gymnasium", "numpy", "torch", "pybullet", "pybullet_utils", "rlctl", "builtins", "stable_baselines3")
"""Packages whose classes nobody wrote for an environment; rlctl's own tasks are in packages of their own."""
MOST_PLACES = 20

Function = ast.FunctionDef | ast.AsyncFunctionDef


def source(context: Context) -> Iterator[Message]:
    """Read the classes, and list the places of what is doubtful."""
    pybullet = sys.modules.get("pybullet")
    classes = list(_classes(context.instance.env)) if pybullet else []
    found: dict[str, list[Place]] = {"without_client": [], "centre_as_frame": [], "force_at_origin": []}
    centres: dict[str, list[ast.Call]] = {}
    for file, what, call in _doubtful(classes, bullet_calls.takes_client(pybullet)):
        place = Place(file, call.lineno, ast.unparse(call.func))
        if place not in found[what] and len(found[what]) < MOST_PLACES:
            found[what].append(place)
            if what == "centre_as_frame":
                centres.setdefault(file, []).append(call)
    for places in found.values():
        places.sort(key=lambda each: (each.file, each.line))
    links = links_read(context.instance, centres) if centres else None
    yield result(Source([each.__qualname__ for each in classes], **found, links=links))


def _doubtful(classes: list[type], takes_client: set[str]) -> Iterator[tuple[str, str, ast.Call]]:
    for file, (tree, parts) in _used(classes).items():
        reader = bullet_calls.Reader(tree, takes_client)
        for part in parts:
            for what, call in reader.read(part):
                yield file, what, call


def _classes(env: Any) -> Iterator[type]:
    """Yield the classes of the environment, or of its task, and of the objects of the same package that it holds."""
    inner = getattr(env, "unwrapped", env)
    task = getattr(inner, "task", None)
    author = task if type(inner).__module__.partition(".")[0] == "rlctl" and task is not None else inner
    seen: set[type] = set()
    for thing in (author, *_held(author)):
        for each in type(thing).__mro__:
            if each not in seen and each.__module__.partition(".")[0] not in NOT_THEIRS:
                seen.add(each)
                yield each


def _held(author: Any) -> list[Any]:
    ours = _package(type(author))
    return [each for each in list(getattr(author, "__dict__", {}).values()) if _package(type(each)) == ours]


def _package(kind: type) -> str:
    return kind.__module__.partition(".")[0]


def _used(classes: list[type]) -> dict[str, tuple[ast.Module, list[ast.AST]]]:
    """Return, per file, its tree and the parts of it that run."""
    trees: dict[str, ast.Module] = {}
    parts: dict[str, list[ast.AST]] = {}
    for each in classes:
        file = _file(each)
        if file is None or (file not in trees and not _parse(file, trees)):
            continue
        node = _definition(trees[file], each.__qualname__)
        if node is not None:
            parts.setdefault(file, []).extend(_running(each, node, classes, trees))
    return {file: (trees[file], _with_functions(trees[file], nodes)) for file, nodes in parts.items()}


def _file(kind: type) -> str | None:
    try:
        return inspect.getsourcefile(kind)
    except (OSError, TypeError):
        return None


def _parse(file: str, trees: dict[str, ast.Module]) -> bool:
    try:
        trees[file] = ast.parse(Path(file).read_text(encoding="utf-8"))
    except (OSError, SyntaxError, ValueError):
        return False
    return True


def _definition(tree: ast.Module, qualname: str) -> ast.ClassDef | None:
    name = qualname.rpartition(".")[2]
    return next((node for node in ast.walk(tree) if isinstance(node, ast.ClassDef) and node.name == name), None)


def _running(kind: type, node: ast.ClassDef, classes: list[type], trees: dict[str, ast.Module]) -> Iterator[ast.AST]:
    """Yield the parts of a class that an instance runs: not the methods that are overridden and never called."""
    before = [each for each in classes if issubclass(each, kind) and each is not kind]
    for part in node.body:
        if not isinstance(part, Function):
            yield part
            continue
        overriding = [each for each in before if part.name in vars(each)]
        if not overriding or any(_calls_up(each, part.name, kind, trees) for each in overriding):
            yield part


def _calls_up(kind: type, method: str, parent: type, trees: dict[str, ast.Module]) -> bool:
    """Say whether a class calls a method of a class above it: by `super()`, or by that class's name."""
    tree = trees.get(_file(kind) or "")
    node = _definition(tree, kind.__qualname__) if tree else None
    if node is None:
        return True  # not known
    for call in (each for each in ast.walk(node) if isinstance(each, ast.Call)):
        if isinstance(call.func, ast.Attribute) and call.func.attr == method:
            owner = ast.unparse(call.func.value)
            if owner.startswith("super(") or owner.rpartition(".")[2] == parent.__name__:
                return True
    return False


def _with_functions(tree: ast.Module, nodes: list[ast.AST]) -> list[ast.AST]:
    """Add the module's own functions that are used by name, and those that they use."""
    functions = {each.name: each for each in tree.body if isinstance(each, Function)}
    found = list(nodes)
    for node in found:  # grows while it is read
        for each in ast.walk(node):
            if isinstance(each, ast.Name) and each.id in functions:
                found.append(functions.pop(each.id))
    return found
