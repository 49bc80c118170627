"""What the expressions of an environment's own source were worth in each call of `reset` and `step`.

The code of its functions is replaced by copies that note each expression; nothing is imported or built again.
"""

import ast
import builtins
import collections
import contextlib
import copy
import dataclasses
import functools
import inspect
from collections.abc import Iterator, Mapping, Sequence
from types import CodeType, FunctionType, ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlctl.checking.source_code import SourceCode
from rlctl.checking.values import MOST_NUMBERS, NUMBERS

NOTE = "__rlctl_note__"  # the name of the function that is called with each value
MOST_EVENTS = 1_500_000
MOST_PARTS = 20  # of a tuple whose numbers are noted together
Number = float | NDArray[np.float64]
Value = Number | None  # None for what is no number and no small array of numbers


@dataclasses.dataclass(eq=False)
class NotedCall:
    """What was noted in one call of `reset` or `step`."""

    step: int  # 0 is the reset
    events: list[tuple[int, Value]]  # the number of an expression, and its value, in the order of their evaluation

    @functools.cached_property
    def values(self) -> Mapping[int, list[Value]]:
        """The values of each expression, by its number."""
        found = collections.defaultdict[int, list[Value]](list)
        for number, value in self.events:
            found[number].append(value)
        return found

    def pair(self, whole: int, parts: Sequence[int]) -> Iterator[tuple[Value, list[Value]]]:
        """Yield each value of an expression with those that its parts had before it; None for one that was not
        evaluated."""
        latest: dict[int, Value] = {}
        for number, value in self.events:
            if number == whole:
                yield value, [latest.pop(part, None) for part in parts]
            elif number in parts:
                latest[number] = value


class ExpressionRecorder:
    """Notes values into the call that is going on."""

    def __init__(self) -> None:
        self.events: list[tuple[int, Value]] | None = None  # None between calls
        self.total = 0
        self.forced: dict[int, Any] = {}
        """What expressions are to be worth, by their numbers, whatever they are."""

    def note(self, number: int, value: Any) -> Any:
        """Note a value, and return it."""
        if number in self.forced:
            value = self.forced[number]
        if self.events is not None and self.total < MOST_EVENTS:
            self.events.append((number, _freeze(value)))
            self.total += 1
        return value

    @contextlib.contextmanager
    def call(self, step: int) -> Iterator[NotedCall]:
        """Note what is evaluated inside."""
        noted = NotedCall(step, [])
        self.events = noted.events
        try:
            yield noted
        finally:
            self.events = None


@contextlib.contextmanager
def record_expressions(source: SourceCode) -> Iterator[ExpressionRecorder]:
    """Replace the code of the author's functions by copies that note their expressions, as long as this lasts."""
    recorder = ExpressionRecorder()
    codes: dict[tuple[str, str, int], CodeType] = {}
    for file, tree in source.trees.items():
        noting = ast.fix_missing_locations(_Noting().visit(copy.deepcopy(tree)))
        codes |= {
            (file, code.co_name, code.co_firstlineno): code for code in _list_codes(compile(noting, file, "exec"))
        }
    replaced: dict[FunctionType, CodeType] = {}  # a class with two names in a module has each function twice
    setattr(builtins, NOTE, recorder.note)
    try:
        for module in source.modules:
            for function in _list_functions(module):
                old = function.__code__
                new = codes.get((str(module.__file__), old.co_name, old.co_firstlineno))
                if new is not None and new.co_freevars == old.co_freevars and function not in replaced:
                    replaced[function] = old
                    function.__code__ = new
        yield recorder
    finally:
        for function, old in replaced.items():
            function.__code__ = old
        delattr(builtins, NOTE)


def _list_functions(module: ModuleType) -> Iterator[FunctionType]:
    """Yield the functions of a module and of its classes."""
    for member in list(vars(module).values()):
        if isinstance(member, type) and member.__module__ == module.__name__:
            for one in list(vars(member).values()):
                yield from _unwrap(one)
        else:
            yield from _unwrap(member)


def _unwrap(member: Any) -> Iterator[FunctionType]:
    parts = [member]
    if isinstance(member, staticmethod | classmethod):
        parts = [member.__func__]
    elif isinstance(member, property):
        parts = [member.fget, member.fset]
    elif isinstance(member, functools.cached_property):
        parts = [member.func]
    for part in parts:
        with contextlib.suppress(ValueError):  # of a function that wraps itself
            inner = inspect.unwrap(part) if isinstance(part, FunctionType) else part
            if isinstance(inner, FunctionType):
                yield inner


def _list_codes(code: CodeType) -> Iterator[CodeType]:
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield constant
            yield from _list_codes(constant)


class _Noting(ast.NodeTransformer):
    """Puts a call around each expression that is noted, in the bodies of functions."""

    def __init__(self) -> None:
        self._is_inside = False

    def visit_FunctionDef(self, node: Any) -> Any:
        """Change the statements, and neither defaults nor decorators."""
        was_inside, self._is_inside = self._is_inside, True
        node.body = [self.visit(one) for one in node.body]
        self._is_inside = was_inside
        return node

    def visit_AsyncFunctionDef(self, node: Any) -> Any:
        """Leave it as it is: no environment is called so."""
        return node

    def visit_ClassDef(self, node: ast.ClassDef) -> Any:
        """Change only the methods: a class may be made in a function."""
        was_inside, self._is_inside = self._is_inside, False
        node.body = [self.visit(one) for one in node.body]
        self._is_inside = was_inside
        return node

    def visit(self, node: Any) -> Any:
        """Change what is inside first."""
        if isinstance(node, ast.JoinedStr | ast.match_case | ast.Lambda):
            return node
        if isinstance(node, ast.AnnAssign):
            node.value = self.visit(node.value) if node.value else None
            return node
        number = getattr(node, "noted", None)
        self._visit_parts(node)
        if number is None or not self._is_inside:
            return node
        call = ast.Call(ast.Name(NOTE, ast.Load()), [ast.Constant(number), node], [])
        return ast.copy_location(call, node)

    def _visit_parts(self, node: Any) -> None:
        """Change the parts of a node; the owner of an attribute, and what is called, are no values of their own."""
        match node:
            case ast.FunctionDef() | ast.AsyncFunctionDef() | ast.ClassDef():
                super().visit(node)
            case ast.Attribute(value=owner):
                node.value = self._visit_owner(owner)
            case ast.Subscript(value=owner, slice=index):
                node.value, node.slice = self._visit_owner(owner), self.visit(index)
            case ast.Call(func=function):
                node.func = self._visit_owner(function)
                node.args = [self.visit(one) for one in node.args]
                node.keywords = [self.visit(one) for one in node.keywords]
            case _:
                self.generic_visit(node)

    def _visit_owner(self, owner: ast.expr) -> Any:
        if isinstance(owner, ast.Name):
            return owner
        if isinstance(owner, ast.Attribute | ast.Subscript):
            self._visit_parts(owner)
            return owner
        return self.visit(owner)


def _freeze(value: Any) -> Value:
    kind = type(value)
    if kind is float or kind is bool or kind is int:
        return float(value) if abs(value) < 1e300 else None
    if kind is np.ndarray:
        return np.array(value, np.float64) if value.size <= MOST_NUMBERS and value.dtype.kind in "biuf" else None
    if isinstance(value, NUMBERS):
        return float(value)
    if (
        isinstance(value, list | tuple)
        and len(value) <= MOST_NUMBERS
        and all(isinstance(one, NUMBERS) for one in value)
    ):
        with contextlib.suppress(OverflowError):  # a whole number of hundreds of digits
            return np.array(value, np.float64)
        return None
    return _flatten(value) if kind is tuple else None


def _flatten(values: tuple[Any, ...]) -> Value:
    """Return the numbers of a tuple of arrays and tuples, such as what a function returns; None for anything else."""
    if len(values) > MOST_PARTS:
        return None
    parts = [_freeze(value) for value in values]
    known = [part for part in parts if part is not None]
    if len(known) < len(parts) or not parts or sum(map(np.size, known)) > MOST_NUMBERS:
        return None
    return np.concatenate([np.ravel(part) for part in known])
