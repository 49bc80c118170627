"""What the source of an environment keeps: which attributes are assigned where, and what a value is read from."""

import ast
import collections
import dataclasses
from collections.abc import Callable, Iterator

from rlctl.checking.expressions import Function, SourceCode
from rlctl.checking.term_names import split_name

COPIES = {"array", "asarray", "copy", "float", "deepcopy", "astype", "float64", "float32", "squeeze", "item"}
"""Calls that return what they are given."""
MOST_DEEP = 4  # calls and names that are followed


@dataclasses.dataclass(frozen=True, eq=False)
class Assignment:
    """A statement that sets an attribute, or a part of it."""

    statement: ast.stmt
    target: ast.expr
    value: ast.expr
    function: Function


class DataFlow:
    """Follows names and attributes of a source, without regard to which object has them. Classes of which `is_used` is
    not true are left out."""

    def __init__(self, source: SourceCode, is_used: Callable[[ast.ClassDef], bool]) -> None:
        self.source = source
        self.functions = collections.defaultdict[str, list[Function]](list)
        for named in source.functions.values():
            for function in named:
                owner = source.parents[function]
                if not isinstance(owner, ast.ClassDef) or is_used(owner):
                    self.functions[function.name].append(function)
        self.assigned = collections.defaultdict[str, list[Assignment]](list)
        self._locals = collections.defaultdict[tuple[Function, str], list[ast.expr | None]](list)
        self.calls = collections.defaultdict[str, list[tuple[ast.Call, Function]]](list)
        for function in [function for named in self.functions.values() for function in named]:
            for node in ast.walk(function):
                self._read(node, function)

    def _read(self, node: ast.AST, function: Function) -> None:
        match node:
            case ast.Assign(targets=targets, value=value):
                for target in targets:
                    self._assign(node, target, value, function)
            case ast.AugAssign(target=target, value=value):
                self._assign(node, target, value, function)
                if isinstance(target, ast.Name):
                    self._locals[function, target.id].append(None)
            case ast.AnnAssign(target=target, value=ast.expr() as value):
                self._assign(node, target, value, function)
            case ast.For(target=target) | ast.comprehension(target=target):
                for one in ast.walk(target):
                    if isinstance(one, ast.Name):
                        self._locals[function, one.id].append(None)
            case ast.Call(func=ast.Name(id=name) | ast.Attribute(attr=name)):
                self.calls[name].append((node, function))

    def _assign(self, statement: ast.stmt, target: ast.expr, value: ast.expr, function: Function) -> None:
        if isinstance(target, ast.Tuple | ast.List):
            values = value.elts if isinstance(value, ast.Tuple | ast.List) else []
            for place, one in enumerate(target.elts):
                is_known = len(values) == len(target.elts)
                self._assign(statement, one, values[place] if is_known else value, function)
                if isinstance(one, ast.Name) and not is_known:
                    self._locals[function, one.id].append(None)
            return
        if isinstance(target, ast.Name) and not isinstance(statement, ast.AugAssign):
            self._locals[function, target.id].append(value)
        key = read_key(target)
        if key:
            self.assigned[key].append(Assignment(statement, target, value, function))

    def resolve(self, node: ast.expr, function: Function, depth: int = MOST_DEEP) -> tuple[ast.expr, Function]:
        """Follow copies, and names that are given one value, to where a value comes from."""
        node = peel(node)
        if not isinstance(node, ast.Name) or not depth:
            return node, function
        values = self._locals.get((function, node.id), [])
        if len(values) == 1 and values[0] is not None:
            return self.resolve(values[0], function, depth - 1)
        given = self._find_arguments(node.id, function) if not values else []
        if len(given) == 1:
            return self.resolve(*given[0], depth - 1)
        return node, function

    def _find_arguments(self, name: str, function: Function) -> list[tuple[ast.expr, Function]]:
        """Return what a parameter is in the calls of its function."""
        names = [one.arg for one in function.args.posonlyargs + function.args.args]
        if name not in names or len(self.functions.get(function.name, ())) > 1:
            return []
        found = []
        for call, caller in self.calls[function.name]:
            place = names.index(name) - (isinstance(call.func, ast.Attribute) and names[0] == "self")
            named = [one.value for one in call.keywords if one.arg == name]
            if named or 0 <= place < len(call.args):
                found.append((named[0] if named else call.args[place], caller))
        return found

    def list_definitions(self, name: str, function: Function) -> list[ast.expr]:
        """Return what a local name is given."""
        return [value for value in self._locals.get((function, name), []) if value is not None]

    def list_sources(self, node: ast.AST, function: Function) -> list[tuple[ast.AST, Function]]:
        """Return an expression, what its names are given, and the functions that it calls, with theirs."""
        found: dict[ast.AST, Function] = {}
        waiting: list[tuple[ast.AST, Function, int]] = [(node, function, MOST_DEEP)]
        while waiting:
            top, owner, depth = waiting.pop()
            if top in found:
                continue
            found[top] = owner
            if depth:
                nodes = ast.walk(top)
                waiting += [(inner, its, depth - 1) for one in nodes for inner, its in self._follow(one, owner)]
        return list(found.items())

    def list_reads(self, node: ast.AST, function: Function) -> set[str]:
        """Return the keys of the attributes that a value is computed from, also by functions that are called."""
        nodes = [one for top, _ in self.list_sources(node, function) for one in ast.walk(top)]
        keys = [read_key(one) for one in nodes if isinstance(one, ast.Attribute | ast.Subscript)]
        return {key for key in keys if key}

    def list_sets(self, node: ast.AST, depth: int = MOST_DEEP) -> set[str]:
        """Return the keys of the attributes that a statement sets, also in functions that it calls."""
        found: set[str] = set()
        for one in ast.walk(node):
            match one:
                case ast.Assign(targets=targets):
                    found |= {key for target in targets for part in ast.walk(target) if (key := _read_own_key(part))}
                case ast.AugAssign(target=target) | ast.AnnAssign(target=target):
                    found |= {key} if (key := read_key(target)) else set()
                case ast.Call(func=ast.Name(id=name) | ast.Attribute(attr=name)) if depth:
                    for inner in self.functions.get(name, ()):
                        found |= self.list_sets(inner, depth - 1)
        return found

    def _follow(self, node: ast.AST, function: Function) -> Iterator[tuple[ast.AST, Function]]:
        match node:
            case ast.Name(id=name):
                yield from ((value, function) for value in self.list_definitions(name, function))
                if function.name in self.functions and not self._locals.get((function, name)):
                    yield from self._find_arguments(name, function)
            case ast.Attribute(attr=name) | ast.Call(func=ast.Name(id=name)):
                for inner in self.functions.get(name, ()):
                    yield inner, inner

    def list_conditions(self, node: ast.AST) -> list[tuple[ast.expr, bool]]:
        """Return the tests, and what they have to be, for a node to be reached in its function."""
        found: list[tuple[ast.expr, bool]] = []
        parents = self.source.parents
        while not isinstance(node, Function) and node in parents:
            parent = parents[node]
            if isinstance(parent, ast.If) and node is not parent.test:
                found.append((parent.test, node in parent.body))
            elif isinstance(parent, ast.IfExp) and node is not parent.test:
                found.append((parent.test, node is parent.body))
            node = parent
        return found


def peel(node: ast.expr) -> ast.expr:
    """Return what an expression is a copy of."""
    while True:
        match node:
            case ast.Call(func=ast.Attribute(value=owner, attr="copy" | "astype" | "squeeze" | "item")) if not (
                isinstance(owner, ast.Name) and owner.id in ("np", "numpy", "copy")
            ):
                node = owner
            case ast.Call(func=ast.Attribute(attr=name) | ast.Name(id=name), args=[first, *_]) if name in COPIES:
                node = first
            case ast.Subscript(value=owner, slice=ast.Slice(lower=None, upper=None, step=None)):
                node = owner
            case _:
                return node


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
            return f"{key}.{name}" if key else name if isinstance(owner, ast.Name) else ""
        case ast.Subscript(value=owner):
            return read_key(owner)
    return ""


def _read_own_key(node: ast.AST) -> str:
    is_set = isinstance(node, ast.Attribute | ast.Subscript) and isinstance(node.ctx, ast.Store)
    return read_key(node) if is_set and isinstance(node, ast.expr) else ""


def read_words(key: str) -> set[str]:
    """Return the words of the last name of a key."""
    return set(split_name(key.rpartition(".")[2]))
