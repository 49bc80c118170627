"""What the functions of a source assign, and what its expressions are called and converted from."""

import ast
import dataclasses
import functools
from collections.abc import Iterator, Sequence

from rlctl.checking.source_code import Function, walk_own
from rlctl.checking.term_names import split_name

CONVERSIONS = {
    "array", "asarray", "ascontiguousarray", "astype", "atleast_1d", "copy", "deepcopy", "flatten", "float", "float32",
    "float64", "item", "nan_to_num", "ravel", "squeeze",
}  # fmt: skip
"""Functions and methods that return the numbers they are given."""
METHODS = {"astype", "copy", "flatten", "item", "ravel", "squeeze"}  # of arrays, among these
LIBRARIES = {"copy", "jnp", "math", "mujoco", "np", "numpy", "p", "pybullet", "torch"}


@dataclasses.dataclass(frozen=True, eq=False)
class Assignment:
    """A statement that gives a value to a name, an attribute, or an entry or a part of one."""

    statement: ast.stmt
    target: ast.expr
    value: ast.expr
    function: Function  # the innermost one
    element: int | None = None  # of the value, where it is assigned to several targets
    is_part: bool = False  # it is some part of the value: in a loop, one after the other

    @functools.cached_property
    def added(self) -> Sequence[tuple[ast.expr, float]]:
        """What is added to what the target was, with signs: by `x += a`, and by `x = x + a - b`; else empty."""
        match self.statement:
            case ast.AugAssign(op=ast.Add() | ast.Sub() as operator):
                return [(self.value, _read_sign(operator))]
        if self.is_part or self.element is not None:
            return []
        text, node = ast.unparse(self.target), self.value
        parts: list[tuple[ast.expr, float]] = []
        while isinstance(node, ast.BinOp) and isinstance(node.op, ast.Add | ast.Sub):
            parts.insert(0, (node.right, _read_sign(node.op)))
            node = node.left
        return parts if parts and ast.unparse(node) == text else []

    @property
    def parts(self) -> Sequence[tuple[ast.expr, float]]:
        """What is added to the target, or what it is set to, with signs."""
        return self.added or [(self.value, 1.0)]

    @property
    def is_known(self) -> bool:
        """Whether it says what the target is, or what is added to it."""
        return not self.is_part and (bool(self.added) or not isinstance(self.statement, ast.AugAssign))


def list_assignments(function: Function) -> list[Assignment]:
    """Return what a function assigns, in the order of its lines; functions in it have their own."""
    found: list[Assignment] = []
    statement = function.body[0]
    for node in walk_own(function):
        if isinstance(node, ast.stmt):
            statement = node
        match node:
            case ast.Assign(targets=targets, value=value):
                for target in targets:
                    found += _open(Assignment(statement, target, value, function))
            case ast.AugAssign(target=target, value=value) | ast.AnnAssign(target=target, value=ast.expr() as value):
                found += _open(Assignment(statement, target, value, function))
            case ast.For(target=target, iter=value) | ast.comprehension(target=target, iter=value):
                match target, value:
                    case ast.Tuple(elts=[_, target]), ast.Call(func=ast.Name(id="enumerate"), args=[value, *_]):
                        pass
                found += _open(Assignment(statement, target, value, function, is_part=True))
    return sorted(found, key=lambda one: one.statement.lineno)


def list_values(function: Function, name: str) -> list[ast.expr]:
    """Return what a function sets a local name to."""
    return [
        one.value
        for one in list_assignments(function)
        if isinstance(one.target, ast.Name) and one.target.id == name and one.element is None
        if not one.is_part and not isinstance(one.statement, ast.AugAssign)
    ]


def _read_sign(operator: ast.operator) -> float:
    return 1.0 if isinstance(operator, ast.Add) else -1.0


def _open(one: Assignment) -> Iterator[Assignment]:
    """Yield an assignment; of one to several targets, those to each."""
    match one.target:
        case ast.Starred(value=target):
            yield from _open(dataclasses.replace(one, target=target, is_part=True))
        case ast.Tuple(elts=targets) | ast.List(elts=targets):
            is_literal = isinstance(one.value, ast.Tuple | ast.List) and not one.is_part and one.element is None
            values = one.value.elts if is_literal else []  # type: ignore[attr-defined]
            for element, target in enumerate(targets):
                if len(values) == len(targets):
                    part = dataclasses.replace(one, target=target, value=values[element])
                else:
                    is_part = one.is_part or one.element is not None
                    part = dataclasses.replace(one, target=target, element=element, is_part=is_part)
                yield from _open(part)
        case _:
            yield one


def read_converted(node: ast.expr) -> ast.expr | None:
    """Return what an expression is a copy of, or has the same numbers as; None for others."""
    match node:
        case ast.Call(func=ast.Attribute(value=owner, attr=name), args=args) if name in CONVERSIONS and (
            not args or (name in METHODS and read_root(owner) not in LIBRARIES)
        ):
            return owner
        case ast.Call(func=ast.Name(id=name) | ast.Attribute(attr=name), args=[first, *_]) if name in CONVERSIONS:
            return first
        case ast.Subscript(value=owner, slice=ast.Slice(lower=None, upper=None, step=None)):
            return owner
    return None


def peel(node: ast.expr) -> ast.expr:
    """Return what an expression is a copy of, in the end."""
    while (inner := read_converted(node)) is not None:
        node = inner
    return node


def read_root(node: ast.expr) -> str:
    """Return the name with which `a.b.c` begins."""
    while isinstance(node, ast.Attribute):
        node = node.value
    return node.id if isinstance(node, ast.Name) else ""


def read_name(node: ast.expr) -> str:
    """Return what a name, an attribute, an entry or a function is called; empty for other expressions."""
    match node:
        case ast.Name(id=name) | ast.Attribute(attr=name) | ast.Subscript(slice=ast.Constant(value=str(name))):
            return name
        case ast.Call(func=ast.Name() | ast.Attribute() as function):
            inner = read_converted(node)
            return read_name(function) if inner is None else read_name(inner)
        case ast.Subscript(value=owner):
            return read_name(owner)
    return ""


def read_key(node: ast.expr) -> str:
    """Return what names an attribute, without its owner and without indices: `prev_dist`, `state.prev`; or nothing."""
    match node:
        case ast.Attribute(value=ast.Name(), attr=name):
            return name
        case ast.Attribute(value=owner, attr=name):
            key = read_key(owner)
            return f"{key}.{name}" if key else ""
        case ast.Subscript(value=owner, slice=ast.Constant(value=str(name))):
            key = read_key(owner)
            if not key:
                return name if isinstance(owner, ast.Name) else ""
            return f"{key}.{name}"
        case ast.Subscript(value=owner):
            return read_key(owner)
    return ""


def list_words(node: ast.AST) -> set[str]:
    """Return the words of all names and texts in a piece of code."""
    texts = [one.value for one in ast.walk(node) if isinstance(one, ast.Constant) and isinstance(one.value, str)]
    return list_name_words(node) | {word for text in texts for word in split_name(text)}


def list_name_words(node: ast.AST) -> set[str]:
    """Return the words of all names in a piece of code, also of those in brackets: `state["goal"]`."""
    names = [read_name(one) for one in ast.walk(node) if isinstance(one, ast.Name | ast.Attribute | ast.Subscript)]
    return {word for name in names for word in split_name(name)}


def list_parameters(function: Function) -> list[str]:
    """Return the names of what a function is given by place, without the object of a method."""
    names = [one.arg for one in [*function.args.posonlyargs, *function.args.args]]
    return names[1:] if names[:1] in (["self"], ["cls"]) else names


def list_returned(function: Function) -> list[ast.expr]:
    """Return what a function returns, where it returns something."""
    return [one.value for one in ast.walk(function) if isinstance(one, ast.Return) and one.value is not None]


def read_words(key: str) -> set[str]:
    """Return the words of the last name of a key."""
    return set(split_name(key.rpartition(".")[2]))
