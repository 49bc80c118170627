"""What the names, attributes and calls in an environment's source stand for: the expressions that define them."""

import ast
import collections
import dataclasses
import functools
from collections.abc import Iterator, Mapping, Sequence, Set

from rlctl.checking.assignments import (
    LIBRARIES,
    Assignment,
    list_assignments,
    list_parameters,
    list_returned,
    read_converted,
    read_key,
    read_name,
    read_root,
)
from rlctl.checking.expressions import NotedCall
from rlctl.checking.source_code import Function, SourceCode, walk_own

DEEPEST = 12  # names and calls that are followed
MOST_DEEP = 4  # the same, to all that a value may be computed from
MOST_WALKED = 600  # expressions
BEGINNINGS = {"__init__", "reset", "reset_model", "__post_init__"}


@dataclasses.dataclass(frozen=True, eq=False)
class ReadExpression:
    """An expression, and what the function in which it stands was called with."""

    node: ast.expr
    function: Function
    arguments: Mapping[str, "ReadExpression"] = dataclasses.field(default_factory=dict)  # empty: by any call
    depth: int = 0

    def at(self, node: ast.expr) -> "ReadExpression":
        """Return the place of another expression of the same call."""
        return dataclasses.replace(self, node=node)


class Definitions:
    """Finds the expressions that define others. Classes of which no function runs are left out, unless they are the
    environment's own."""

    def __init__(self, source: SourceCode, episodes: Sequence[Sequence[NotedCall]]) -> None:
        self.source = source
        functions = [function for named in source.functions.values() for function in named]
        self._assignments = {function: list_assignments(function) for function in functions}
        classes = [node for tree in source.trees.values() for node in ast.walk(tree) if isinstance(node, ast.ClassDef)]
        self._classes = dict.fromkeys(functions, "") | {
            one: owner.name for owner in classes for one in ast.walk(owner) if isinstance(one, Function)
        }  # the innermost one of each function
        steps = [call for episode in episodes for call in episode[1:]]
        self._first: dict[Function, int] = {}
        for call in [*steps[:3], *steps[-3:]]:
            for order, (number, _) in enumerate(call.events):
                self._first.setdefault(source.expressions[number].function, order)
        self.called = [one for one in self._first if one.name not in BEGINNINGS]
        self.functions = collections.defaultdict[str, list[Function]](list)
        self.calls = collections.defaultdict[str, list[tuple[ast.Call, Function]]](list)
        """The calls of functions by their name, and in which function they are."""
        self.assigned = collections.defaultdict[str, list[Assignment]](list)
        """What is assigned to attributes, by `read_key`."""
        used = {source.expressions[number].function for one in episodes for call in one for number in call.values}
        for function in functions:
            owner = source.parents[function]
            if isinstance(owner, ast.ClassDef) and owner.name not in source.classes and not used & {*owner.body}:
                continue
            self.functions[function.name].append(function)
            for assignment in self._assignments[function]:
                if key := read_key(assignment.target):
                    self.assigned[key].append(assignment)
            for node in walk_own(function):
                if isinstance(node, ast.Call):
                    self.calls[read_name(node.func)].append((node, function))

    def find_function(self, name: str) -> Function | None:
        """Return the function of a name that is called first, or the only one, or that of the most derived class of the
        environment; None if there is none."""
        named = self.functions.get(name, [])
        called = [one for one in named if one in self._first]
        if called or len(named) == 1:
            return min(called, key=lambda one: self._first[one], default=named[0])
        owners = {self._classes[one]: one for one in named}
        return next((owners[name] for name in self.source.classes if name in owners), None)

    @functools.cache  # noqa: B019  # lives as long as one experiment
    def list_assigned(self, function: Function) -> Mapping[str, Sequence[Assignment]]:
        """Return what a function assigns, by what stands to the left, in order."""
        found = collections.defaultdict[str, list[Assignment]](list)
        for one in self._assignments[function]:
            found[ast.unparse(one.target)].append(one)
        return dict(found)

    def _list_known(self, function: Function, text: str) -> list[Assignment]:
        return [one for one in self.list_assigned(function).get(text, ()) if one.is_known]

    def list_before(self, place: ReadExpression) -> list[Assignment]:
        """Return what was assigned to a name or attribute before this place, from the last time on that it was
        replaced in any case."""
        several = self._list_known(place.function, ast.unparse(place.node))
        several = [one for one in several if (one.statement.end_lineno or 0) < place.node.lineno]
        for index in range(len(several) - 1, -1, -1):
            one = several[index]
            if not one.added and self.source.parents.get(one.statement) is place.function:
                return several[index:]
        return several

    def follow(self, place: ReadExpression) -> list[ReadExpression]:
        """Return the expressions that a name, an attribute or a call of an own function stands for."""
        if place.depth > DEEPEST:
            return []
        place = dataclasses.replace(place, depth=place.depth + 1)
        node, inner = place.node, read_converted(place.node)
        if isinstance(node, ast.Call):
            return self.list_returned(place) if inner is None else [place.at(inner)]
        if not isinstance(node, ast.Name | ast.Attribute | ast.Subscript):
            return []
        before = self.list_before(place)
        if before:
            return [] if any(one.added for one in before) else self._select_all(place, before)
        if isinstance(node, ast.Name):
            return [place.arguments[node.id]] if node.id in place.arguments else self._list_given(place, node.id)
        return self._follow_attribute(place) if inner is None else [place.at(inner)]

    def list_returned(self, place: ReadExpression) -> list[ReadExpression]:
        """Return what the own function that is called returns."""
        call = place.node
        if not isinstance(call, ast.Call) or read_root(call.func) in {"", *LIBRARIES} or place.depth > DEEPEST:
            return []
        function = self.find_function(read_name(call.func))
        if function is None:
            return []
        arguments = {key: place.at(value) for key, value in bind(call, list_parameters(function)).items()}
        return self.list_results(function, arguments, place.depth)

    def list_results(
        self, function: Function | None, arguments: Mapping[str, ReadExpression] | None = None, depth: int = 0
    ) -> list[ReadExpression]:
        """Return what a function returns, where it is called with these arguments; nothing where there is none."""
        if function is None:
            return []
        return [ReadExpression(value, function, arguments or {}, depth) for value in list_returned(function)]

    def _list_given(self, place: ReadExpression, name: str) -> list[ReadExpression]:
        """Return what a parameter is in the calls of its function, where it is not known by which it was reached."""
        function = place.function
        if place.arguments or name in self.list_assigned(function) or len(self.functions.get(function.name, ())) > 1:
            return []
        calls = [(bind(call, list_parameters(function)), caller) for call, caller in self.calls.get(function.name, ())]
        return [ReadExpression(given[name], caller, {}, place.depth) for given, caller in calls if name in given]

    def _follow_attribute(self, place: ReadExpression) -> list[ReadExpression]:
        text = ast.unparse(place.node)
        if isinstance(place.node, ast.Attribute):
            function = self.find_function(place.node.attr)
            if function is not None and any("property" in ast.unparse(one) for one in function.decorator_list):
                return self.list_results(function, {}, place.depth)
        found: list[ReadExpression] = []
        for function in self.called:
            if function is not place.function:
                several = self._list_known(function, text)
                if any(one.added for one in several):
                    return []
                found += self._select_all(ReadExpression(place.node, function, {}, place.depth), several)
        return found

    def _select_all(self, place: ReadExpression, several: Sequence[Assignment]) -> list[ReadExpression]:
        return [part for one in several for part in self.select(place.at(one.value), one.element)]

    def select(self, place: ReadExpression, element: int | None) -> list[ReadExpression]:
        """Return the element of a tuple that an expression is worth, as far as it can be seen."""
        if element is None:
            return [place]
        if isinstance(place.node, ast.Tuple | ast.List):
            return [place.at(place.node.elts[element])] if element < len(place.node.elts) else []
        return [part for one in self.follow(place) for part in self.select(one, element)]

    def resolve(self, place: ReadExpression) -> ReadExpression:
        """Follow names and calls as long as each stands for one expression only."""
        while True:
            found = self.follow(place)
            if len(found) != 1:
                return place
            place = found[0]

    def find_origin(self, node: ast.expr, function: Function) -> ast.expr:
        """Follow copies, and names that stand for one expression only, to where a value comes from."""
        place = ReadExpression(node, function)
        while isinstance(place.node, ast.Name) or read_converted(place.node) is not None:
            found = self.follow(place)
            if len(found) != 1:
                break
            place = found[0]
        return place.node

    def walk(self, place: ReadExpression) -> Iterator[ReadExpression]:
        """Yield an expression, its parts, and those of what they stand for; of what a loop goes through, too."""
        waiting, seen = [place], set[ast.AST]()
        while waiting and len(seen) < MOST_WALKED:
            one = waiting.pop()
            if one.node in seen:
                continue
            seen.add(one.node)
            yield one
            loops = self.list_assigned(one.function).get(ast.unparse(one.node), ())
            waiting += self.follow(one) or [one.at(loop.value) for loop in loops if loop.is_part]
            waiting += [one.at(part) for part in _list_parts(one.node)]

    def read(self, node: ast.expr) -> list[ast.expr]:
        """Return all that a name is set to in its function, or an attribute in its class, at any time; also through
        what a loop goes whose variable it is."""
        functions = [self.source.find_function(node)]
        if isinstance(node, ast.Attribute):
            owner = self._classes[functions[0]]
            owners = self.source.classes if owner in self.source.classes else [owner]
            functions = [function for name in owners for function, own in self._classes.items() if own == name]
        text = ast.unparse(node)
        several = [one for function in functions for one in self.list_assigned(function).get(text, ())]
        return [one.value for one in several if one.element is None and not isinstance(one.statement, ast.AugAssign)]

    def read_parts(self, name: ast.Name) -> list[ast.expr]:
        """Return what is unpacked into a name among others, and what is assigned to its elements."""
        several = self._assignments[self.source.find_function(name)]
        found = [one for one in several if one.element is not None and ast.unparse(one.target) == name.id]
        elements = [one for one in several if isinstance(one.target, ast.Subscript)]
        found += [one for one in elements if ast.unparse(one.target.value) == name.id]  # type: ignore[attr-defined]
        return [one.value for one in found]

    def read_returned(self, call: ast.Call) -> list[ast.expr]:
        """Return what the own function that is called returns."""
        return [one.node for one in self.list_returned(ReadExpression(call, self.source.find_function(call)))]

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
                waiting += [(inner, its, depth - 1) for one in nodes for inner, its in self._list_origins(one, owner)]
        return list(found.items())

    def _list_origins(self, node: ast.AST, function: Function) -> Iterator[tuple[ast.AST, Function]]:
        match node:
            case ast.Name(id=name):
                several = self._list_known(function, name)
                yield from ((one.value, function) for one in several if one.element is None)
                yield from ((one.node, one.function) for one in self._list_given(ReadExpression(node, function), name))
            case ast.Attribute(attr=name) | ast.Call(func=ast.Name(id=name)):
                yield from ((inner, inner) for inner in self.functions.get(name, ()))

    def list_reads(self, node: ast.AST, function: Function) -> set[str]:
        """Return the keys of the attributes that a value is computed from, also by functions that are called."""
        nodes = [one for top, _ in self.list_sources(node, function) for one in ast.walk(top)]
        keys = [read_key(one) for one in nodes if isinstance(one, ast.Attribute | ast.Subscript)]
        return {key for key in keys if key}

    @functools.cache  # noqa: B019  # as `list_assigned`; functions are asked for again and again
    def list_sets(self, node: ast.AST, depth: int = MOST_DEEP) -> Set[str]:
        """Return the keys of the attributes that a statement sets, also in functions that it calls."""
        found: set[str] = set()
        for one in ast.walk(node):
            match one:
                case ast.Attribute(ctx=ast.Store()) | ast.Subscript(ctx=ast.Store()):
                    found |= {read_key(one)} - {""}
                case ast.Call(func=ast.Name(id=name) | ast.Attribute(attr=name)) if depth:
                    for inner in self.functions.get(name, ()):
                        found |= self.list_sets(inner, depth - 1)
        return found

    def list_conditions(self, node: ast.AST) -> list[tuple[ast.expr, bool]]:
        """Return the tests, and what they have to be, for a node to be reached in its function."""
        found: list[tuple[ast.expr, bool]] = []
        while not isinstance(node, Function) and node in self.source.parents:
            parent = self.source.parents[node]
            if isinstance(parent, ast.If) and node is not parent.test:
                found.append((parent.test, node in parent.body))
            elif isinstance(parent, ast.IfExp) and node is not parent.test:
                found.append((parent.test, node is parent.body))
            node = parent
        return found


def bind(call: ast.Call, names: Sequence[str]) -> dict[str, ast.expr]:
    """Return what a call gives to parameters of these names."""
    given = dict(zip(names, call.args, strict=False))
    return given | {word.arg: word.value for word in call.keywords if word.arg}


def _list_parts(node: ast.AST) -> Iterator[ast.expr]:
    for part in ast.iter_child_nodes(node):
        if isinstance(part, ast.expr):
            yield part
        else:
            yield from _list_parts(part)
