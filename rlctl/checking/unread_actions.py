"""Elements of the action that no line reads, while another element is read twice."""

import ast
import collections
import dataclasses
from collections.abc import Collection, Iterator

from rlctl.checking.assignments import CONVERSIONS, list_parameters, list_words, read_name
from rlctl.checking.rule import Rule, RuleFinding
from rlctl.checking.source_code import Function, SourceCode
from rlctl.checking.term_names import split_name

ACTORS = {"step", "act", "apply_action", "step_async", "_apply_action", "apply_actions", "_act"}
COSTS = {"sum", "square", "norm", "mean", "abs", "squared", "linalg", "dot", "vdot", "max", "isfinite", "all", "any"}
SAME_SHAPE = CONVERSIONS | {"atleast_2d", "clip", "reshape", "tanh"}
OLD_WORDS = {"last", "prev", "previous", "old", "change", "delta", "history", "before", "diff", "cost", "penalty"}


@dataclasses.dataclass
class _Uses:
    """How a function uses a vector."""

    read: dict[int, list[ast.Subscript]] = dataclasses.field(
        default_factory=lambda: collections.defaultdict[int, list[ast.Subscript]](list)
    )
    is_whole: bool = False  # something else may read all elements


def find_unread_elements(
    rule: Rule, source: SourceCode, evaluated: Collection[ast.AST], size: int
) -> Iterator[RuleFinding]:
    """Yield each element of an action of `size` numbers that is never read, in a function that reads one element in
    two statements, and nothing as a whole but for costs; only functions that were evaluated count."""
    for file, tree in source.trees.items():
        for function in ast.walk(tree):
            if not isinstance(function, Function) or function not in evaluated or size < 2:
                continue
            for name in _list_vectors(function):
                uses = _list_uses(source, function, name, size)
                missing = sorted(set(range(size)) - set(uses.read))
                twice = [element for element, nodes in uses.read.items() if count_statements(source, nodes) > 1]
                if uses.is_whole or len(missing) != 1 or len(twice) != 1:
                    continue
                nodes = uses.read[twice[0]]
                lines = ", ".join(str(node.lineno) for node in nodes)
                message = (
                    f"{name} has {size} elements, and {function.name} reads {name}[{twice[0]}] twice (lines {lines})"
                )
                message += f" and {name}[{missing[0]}] never"
                evidence = {"element": f"{name}[{missing[0]}]", "value": missing[0]}
                yield RuleFinding(rule, message, evidence, where=(file, nodes[-1].lineno))


def _list_vectors(function: Function) -> list[str]:
    """Return the names of the action, and of what it is multiplied to, element by element."""
    if function.name not in ACTORS:
        return []
    names = list_parameters(function)[:1]
    for node in ast.walk(function):
        if isinstance(node, ast.Assign) and len(node.targets) == 1 and isinstance(node.targets[0], ast.Name):
            target = node.targets[0].id
            if target not in names and _is_same_shape(node.value, names):
                names.append(target)
    return names


def _is_same_shape(node: ast.expr, names: list[str]) -> bool:
    """Say whether an expression is a vector, or its product with what no index takes apart."""
    match node:
        case ast.Name(id=name):
            return name in names
        case ast.BinOp(left=left, op=ast.Mult() | ast.Add() | ast.Sub() | ast.Div(), right=right):
            one = _is_same_shape(left, names) and not _holds(right, names)
            return one or (_is_same_shape(right, names) and not _holds(left, names))
        case ast.Call(func=function, args=[first, *_]) if read_name(function) in SAME_SHAPE:
            return _is_same_shape(first, names)
        case ast.Call(func=ast.Attribute(value=owner, attr=name)) if name in SAME_SHAPE:
            return _is_same_shape(owner, names)
    return False


def _holds(node: ast.expr, names: list[str]) -> bool:
    return any(isinstance(one, ast.Name) and one.id in names for one in ast.walk(node))


def _list_uses(source: SourceCode, function: Function, name: str, size: int) -> _Uses:
    uses = _Uses()
    names = _list_vectors(function)
    for node in ast.walk(function):
        if not isinstance(node, ast.Name) or node.id != name or not isinstance(node.ctx, ast.Load):
            continue
        above = source.parents[node]
        if isinstance(above, ast.Subscript) and above.value is node:
            elements = read_elements(above.slice, size)
            if elements is None or not isinstance(above.ctx, ast.Load):
                uses.is_whole = True
            for element in elements or ():
                uses.read[element].append(above)
        elif not _is_harmless(source, node, names):
            uses.is_whole = True
    return uses


def read_elements(index: ast.expr, size: int) -> list[int] | None:
    """Return which elements an index takes, the last axis being that of the action; None for what is not constant."""
    if isinstance(index, ast.Tuple) and index.elts:
        last = index.elts[-1]
        is_worlds = all(isinstance(one, ast.Slice) or _is_ellipsis(one) for one in index.elts[:-1])
        return read_elements(last, size) if is_worlds else None
    match index:
        case ast.Constant(value=int(element)):
            return [element]
        case ast.UnaryOp(op=ast.USub(), operand=ast.Constant(value=int(element))):
            return [size - element]
        case ast.Slice(lower=lower, upper=upper, step=None):
            ends = [None if given is None else read_elements(given, size) for given in (lower, upper)]
            if any(given is not None and found is None for given, found in zip((lower, upper), ends, strict=True)):
                return None
            begin, end = ends[0][0] if ends[0] else 0, ends[1][0] if ends[1] else size
            return list(range(begin, end))
    return None


def _is_ellipsis(node: ast.expr) -> bool:
    return isinstance(node, ast.Constant) and node.value is ...


def _is_harmless(source: SourceCode, node: ast.expr, names: list[str]) -> bool:
    """Say whether a whole vector is only made into one of the same shape, kept for later, or paid for."""
    while True:
        above = source.parents[node]
        match above:
            case ast.Call(func=function) if read_name(function) in COSTS:
                return True
            case ast.Call(func=function) if node is not function and read_name(function) not in SAME_SHAPE:
                return False
            case ast.BinOp(op=ast.Pow()):
                return True
            case ast.BinOp(left=left, right=right):
                other = right if left is node else left
                if list_words(other) & OLD_WORDS:
                    return True
            case ast.Attribute(attr="shape" | "size" | "dtype"):
                return True
            case ast.Assign(targets=[ast.Name(id=target)]):
                return target in names or bool(set(split_name(target)) & OLD_WORDS)
            case ast.Assign(targets=[target]):
                name = ast.unparse(target)
                return bool(set(split_name(name)) & OLD_WORDS) and not _is_indexed(source, name)
            case ast.AugAssign():
                return False
            case ast.stmt():
                return False
        node = above  # type: ignore[assignment]


def count_statements(source: SourceCode, nodes: list[ast.Subscript]) -> int:
    """Return in how many statements, or entries of a list, something is read."""
    places = set[ast.AST]()
    for node in nodes:
        place: ast.AST = node
        while not isinstance(place, ast.stmt) and not isinstance(source.parents[place], ast.Tuple | ast.List):
            place = source.parents[place]
        places.add(place)
    return len(places)


def _is_indexed(source: SourceCode, attribute: str) -> bool:
    """Say whether single elements of an attribute are read anywhere."""
    nodes = (node for tree in source.trees.values() for node in ast.walk(tree))
    return any(isinstance(node, ast.Subscript) and ast.unparse(node.value) == attribute for node in nodes)
