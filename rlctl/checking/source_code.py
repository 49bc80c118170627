"""The source of an environment's author: its modules, its functions, and the expressions in them."""

import ast
import collections
import contextlib
import dataclasses
import functools
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any

from rlctl.checking.values import find_author, list_own_classes
from rlctl.environments.places import is_own_file

MOST_MODULES = 20
Function = ast.FunctionDef
_WITH_CONTEXT = ast.Name | ast.Attribute | ast.Subscript | ast.List | ast.Tuple


@dataclasses.dataclass(frozen=True, eq=False)
class Expression:
    """An expression of the source that is noted."""

    number: int  # its place among all
    node: ast.expr
    file: str
    function: Function  # in which it stands

    @functools.cached_property
    def text(self) -> str:
        """The expression as it is written, in one line."""
        return write_code(self.node)

    @property
    def where(self) -> tuple[str, int]:
        """File and line."""
        return self.file, self.node.lineno


@dataclasses.dataclass(frozen=True, eq=False)
class FaultyCode:
    """A piece of the source, and what is wrong with it."""

    node: ast.stmt | ast.expr
    what: str
    where: tuple[str, int]  # file and line


class SourceCode:
    """The modules of an environment's author: those of its classes, and what was imported of the same folders and of
    the same top-level packages: rewards and robots often have folders of their own."""

    def __init__(self, env: Any) -> None:
        self.author = find_author(env)
        self.modules = _list_modules(env)
        self.classes = [cls.__name__ for cls in list_own_classes(find_author(env))]
        """The author's classes of the environment, the most derived first."""
        self.trees: dict[str, ast.Module] = {}
        for module in self.modules:
            with contextlib.suppress(OSError, SyntaxError, ValueError):
                self.trees[str(module.__file__)] = ast.parse(Path(str(module.__file__)).read_bytes())
        self.expressions: list[Expression] = []
        self.parents: dict[ast.AST, ast.AST] = {}
        for file, tree in self.trees.items():
            self.parents |= {child: node for node in ast.walk(tree) for child in ast.iter_child_nodes(node)}
            for function in ast.walk(tree):
                if isinstance(function, Function):
                    self._number(file, function)
        self._numbers = {one.node: one.number for one in self.expressions}

    def _number(self, file: str, function: Function) -> None:
        for node in walk_own(function):
            if isinstance(node, ast.expr) and _is_noted(node):
                node.noted = len(self.expressions)  # type: ignore[attr-defined]  # copies of the node keep it
                self.expressions.append(Expression(len(self.expressions), node, file, function))

    def find(self, node: ast.AST) -> Expression | None:
        """Return the noted expression of a node; None for one that is not noted, such as a constant."""
        number = self._numbers.get(node)  # type: ignore[call-overload]
        return None if number is None else self.expressions[number]

    @functools.cached_property
    def functions(self) -> Mapping[str, Sequence[Function]]:
        """All functions and methods by name."""
        found = collections.defaultdict[str, list[Function]](list)
        for tree in self.trees.values():
            for node in ast.walk(tree):
                if isinstance(node, Function):
                    found[node.name].append(node)
        return found

    def find_statement(self, node: ast.AST) -> ast.stmt:
        """Return the innermost statement that has a node."""
        while not isinstance(node, ast.stmt):
            node = self.parents[node]
        return node

    def find_place(self, node: ast.stmt | ast.expr) -> tuple[str, int]:
        """Return file and line of a statement or an expression."""
        top: ast.AST = node
        while top in self.parents:
            top = self.parents[top]
        return next(file for file, tree in self.trees.items() if tree is top), node.lineno

    def find_function(self, node: ast.AST) -> Function:
        """Return the innermost function around a node."""
        while not isinstance(node, Function):
            node = self.parents[node]
        return node


def _list_modules(env: Any) -> list[ModuleType]:
    classes = [sys.modules.get(cls.__module__) for cls in list_own_classes(find_author(env))]
    own = {id(module): module for module in classes if module is not None and _find_file(module) is not None}
    folders = {file.parent for module in own.values() if (file := _find_file(module))}
    modules = dict(own)
    for module in list(sys.modules.values()):
        if (file := _find_file(module)) is not None and file.parent in folders and is_own_file(str(file)):
            modules.setdefault(id(module), module)
    for module in _follow_imports(list(own.values())):
        modules.setdefault(id(module), module)
    return list(modules.values())[:MOST_MODULES]


def _find_file(module: ModuleType) -> Path | None:
    file = getattr(module, "__file__", None)
    return Path(file) if isinstance(file, str) else None


def _follow_imports(modules: Sequence[ModuleType]) -> Iterator[ModuleType]:
    """Yield what modules have imported, and these in turn, of the top-level packages in whose folders they are."""
    parents = {parent for module in modules if (file := _find_file(module)) for parent in file.parents}
    seen, waiting = {id(module) for module in modules}, list(modules)
    while waiting:
        for value in list(vars(waiting.pop(0)).values()):
            name = value.__name__ if isinstance(value, ModuleType) else getattr(value, "__module__", None)
            module = sys.modules.get(name) if isinstance(name, str) else None
            if module is None or id(module) in seen:
                continue
            seen.add(id(module))
            package = sys.modules.get(module.__name__.partition(".")[0])
            is_near = any(Path(folder) in parents for folder in getattr(package, "__path__", ()))
            if is_near and (file := _find_file(module)) is not None and is_own_file(str(file)):
                waiting.append(module)
                yield module


def walk_own(function: Function) -> Iterator[ast.AST]:
    """Yield the nodes of a function's statements, without those of functions and classes in it."""
    waiting: list[ast.AST] = [*reversed(function.body)]
    while waiting:
        node = waiting.pop()
        yield node
        if not isinstance(node, Function | ast.AsyncFunctionDef | ast.ClassDef):
            waiting += reversed(list(ast.iter_child_nodes(node)))


def _is_noted(node: ast.expr) -> bool:
    if isinstance(node, _WITH_CONTEXT):
        return isinstance(node.ctx, ast.Load)
    return isinstance(node, ast.BinOp | ast.UnaryOp | ast.BoolOp | ast.Compare | ast.Call | ast.IfExp)


def write_code(node: ast.AST) -> str:
    """Return a piece of code as it is written, in one line."""
    return " ".join(ast.unparse(node).split())
