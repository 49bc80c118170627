"""Finds in the source of an environment which reward terms have a weight that is not 0."""

import ast
import contextlib
import dataclasses
import inspect
import sys
from collections.abc import Iterator, Mapping
from typing import Any

from rlctl.checking.values import NUMBERS, find_author, list_own_classes

CONVERSIONS = {"float", "float32", "float64", "item", "asarray", "array"}
"""Functions that return what they are given."""
DEEPEST = 6  # names and methods that are followed
Functions = dict[str, ast.FunctionDef]


@dataclasses.dataclass(frozen=True)
class _Scope:
    """Where an expression is: what its names may mean."""

    author: Any
    module: Mapping[str, Any]
    methods: Functions
    states: frozenset[str]  # Attributes that other methods than the constructor assign
    function: ast.FunctionDef | None

    def find_local(self, name: str) -> list[ast.expr]:
        """Return what is assigned to a local name."""
        if self.function is None:
            return []
        assignments = [node for node in ast.walk(self.function) if isinstance(node, ast.Assign)]
        return [
            node.value
            for node in assignments
            if any(isinstance(target, ast.Name) and target.id == name for target in node.targets)
        ]


def find_weighed_terms(env: Any) -> dict[str, tuple[str, int]]:
    """Return file and line of each entry of a dictionary, by its key, that is computed and multiplied by known numbers
    other than 0, and that has no weight of 0 or of unknown size anywhere."""
    author = find_author(env)
    entries: dict[str, list[_Entry]] = {}
    for file, module in {inspect.getsourcefile(cls): cls.__module__ for cls in list_own_classes(env)}.items():
        with contextlib.suppress(OSError, TypeError, SyntaxError, ValueError):
            with open(str(file), encoding="utf-8") as source:
                tree = ast.parse(source.read())
            for name, entry in _read_entries(tree, str(file), author, vars(sys.modules[module])):
                entries.setdefault(name, []).append(entry)
    zero = {key for value in vars(author).values() if isinstance(value, dict) for key in value if value[key] is 0.0}
    return {
        name: next(entry.where for entry in found if None in entry.factors)
        for name, found in entries.items()
        if name not in zero and _is_weighed([factor for entry in found for factor in entry.factors])
    }
