"""What the source assigns to names and attributes, and what its functions return."""

import ast
import collections
import functools
from collections.abc import Mapping, Sequence
from typing import Any

from rlctl.checking.expressions import Function, SourceCode


class Assignments:
    """What is assigned in the functions and classes of a source."""

    def __init__(self, source: SourceCode) -> None:
        self.source = source

    @functools.cached_property
    def _assigned(self) -> Mapping[tuple[object, str], Sequence[ast.expr]]:
        """What is assigned to the names of each function, and to the attributes of each class."""
        found = collections.defaultdict[tuple[object, str], list[ast.expr]](list)
        for tree in self.source.trees.values():
            for node in ast.walk(tree):
                match node:
                    case ast.Assign(targets=targets, value=value):
                        for target in targets:
                            self._add(found, target, value)
                    case ast.AnnAssign(target=target, value=ast.expr() as value):
                        self._add(found, target, value)
                    case ast.For(target=target, iter=value) | ast.comprehension(target=target, iter=value):
                        self._add(found, *_open_loop(target, value))
        return found

    def _add(self, found: dict[tuple[object, str], list[ast.expr]], target: ast.expr, value: ast.expr) -> None:
        if isinstance(target, ast.Tuple) and isinstance(value, ast.Tuple) and len(target.elts) == len(value.elts):
            for one, part in zip(target.elts, value.elts, strict=True):
                self._add(found, one, part)
        elif isinstance(target, ast.Tuple):
            for one in target.elts:
                if isinstance(one, ast.Name):
                    found[self._find_owner(one, Function), f"*{one.id}"].append(value)
        elif isinstance(target, ast.Subscript) and isinstance(target.value, ast.Name):
            found[self._find_owner(target, Function), f"*{target.value.id}"].append(value)
        elif isinstance(target, ast.Name):
            found[self._find_owner(target, Function), target.id].append(value)
        elif isinstance(target, ast.Attribute):
            found[self._name_class(target), ast.unparse(target)].append(value)

    def _find_owner(self, node: ast.AST, kind: Any) -> ast.AST | None:
        owner: ast.AST | None = node
        while owner is not None and not isinstance(owner, kind):
            owner = self.source.parents.get(owner)
        return owner

    def _name_class(self, node: ast.AST) -> str:
        owner = self._find_owner(node, ast.ClassDef)
        return owner.name if isinstance(owner, ast.ClassDef) else ""

    def _list_classes(self, node: ast.AST) -> list[str]:
        """Return the class in which a piece of code stands; of the environment's own, all."""
        name = self._name_class(node)
        return self.source.classes if name in self.source.classes else [name]

    def read(self, node: ast.expr) -> Sequence[ast.expr]:
        """Return what is assigned to a name or an attribute; empty for any other expression."""
        text = ast.unparse(node)
        if isinstance(node, ast.Name):
            return self._assigned.get((self._find_owner(node, Function), text), ())
        owners = self._list_classes(node) if isinstance(node, ast.Attribute) else []
        return [value for owner in owners for value in self._assigned.get((owner, text), ())]

    def read_parts(self, name: ast.Name) -> Sequence[ast.expr]:
        """Return what is unpacked into a name among others, and what is assigned to its elements."""
        return self._assigned.get((self._find_owner(name, Function), f"*{name.id}"), ())

    def list_returned(self, function: ast.expr) -> list[ast.expr]:
        """Return what an own method, or a function of the source, returns."""
        name = function.attr if isinstance(function, ast.Attribute) else ast.unparse(function)
        is_method = isinstance(function, ast.Attribute) and ast.unparse(function.value) == "self"
        if isinstance(function, ast.Attribute) and not is_method:
            return []
        for owner in self._list_classes(function) if is_method else [""]:
            for one in self.source.functions.get(name, ()):
                if self._name_class(one) == owner:
                    returns = [node for node in ast.walk(one) if isinstance(node, ast.Return)]
                    return [node.value for node in returns if node.value is not None]
        return []


def _open_loop(target: ast.expr, value: ast.expr) -> tuple[ast.expr, ast.expr]:
    """Return what is one element of a loop's values, and these; enumerate has a number before each."""
    match target, value:
        case ast.Tuple(elts=[_, element]), ast.Call(func=ast.Name(id="enumerate"), args=[inner, *_]):
            return element, inner
    return target, value
