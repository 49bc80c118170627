"""Which expressions of an environment's source are added up to the reward: their signs, weights, names, and values."""

import ast
import dataclasses
import functools
import itertools
import math
from collections.abc import Iterator, Mapping, Sequence

from rlctl.checking.assignments import Assignment, read_name
from rlctl.checking.definitions import DEEPEST, Definitions, ReadExpression
from rlctl.checking.expressions import NotedCall
from rlctl.checking.noted_numbers import NotedNumbers
from rlctl.checking.products import find_function_of_values, list_product
from rlctl.checking.source_code import write_code
from rlctl.checking.term_names import split_name

REWARD_METHODS = ("rewards", "reward")  # of a task, which returns terms by name
SUMS = {"sum", "nansum", "mean", "nanmean", "average", "fsum"}
REWARD_NAMES = {"r", "ret", "rew", "reward", "rewards", "total"}  # of the whole
MOST_SUMMANDS = 200
Condition = tuple[ast.expr, bool]  # a test, and whether it is true where the summand counts


@dataclasses.dataclass(frozen=True, eq=False)
class Summand:
    """A part of the reward."""

    name: str  # of the variable, or the key of the dictionary; otherwise the expression
    place: ReadExpression  # without constant factors
    weight: float  # the product of these and of the signs; NaN where it is not known
    conditions: tuple[Condition, ...] = ()
    replaces: bool = False  # what was added up before
    names: tuple[str, ...] = ()  # of the variables and functions through which it was reached

    @property
    def text(self) -> str:
        """The expression as it is written, in one line."""
        return write_code(self.place.node)


class RewardReader:
    """Reads the summands of the reward."""

    def __init__(self, definitions: Definitions, calls: Sequence[NotedCall], weights: Mapping[str, float]) -> None:
        self.definitions, self.source = definitions, definitions.source
        self.numbers = NotedNumbers(definitions, calls)
        self.weights = weights  # of a task's terms
        self._differences: list[Summand] = []
        self._path: list[str] = []  # names through which summands are being reached

    @functools.cached_property
    def summands(self) -> Sequence[Summand]:
        """The summands, in the order in which they are written."""
        found: list[Summand] = []
        for place in self._list_rewards():
            found += itertools.islice(self._expand(place, 1.0, "", ()), MOST_SUMMANDS - len(found))
            self._path.clear()  # of what was cut off
        for key, place, conditions in self._list_terms():
            weight = float(self.weights.get(key, math.nan))
            found += self._expand(place, weight, key, conditions)
        unique = {(one.place.node, one.weight): one for one in found}
        return list(unique.values())

    @property
    def differences(self) -> Sequence[Summand]:
        """Those whose two sides are summands of their own."""
        return self._differences if self.summands else []

    def locate(self, place: ReadExpression) -> tuple[str, int]:
        """Return file and line of an expression."""
        return self.source.find_place(place.node)

    def _list_rewards(self) -> Iterator[ReadExpression]:
        step = self.definitions.find_function("step") if not self.weights else None
        for returned in self.definitions.list_results(step):
            for whole in self._list_tuples(returned):
                yield whole.at(whole.node.elts[1])  # type: ignore[attr-defined]

    def _list_tuples(self, place: ReadExpression) -> Iterator[ReadExpression]:
        if isinstance(place.node, ast.Tuple):
            if len(place.node.elts) in (4, 5):
                yield place
        else:
            for one in self.definitions.follow(place):
                yield from self._list_tuples(one)

    def _list_terms(self) -> Iterator[tuple[str, ReadExpression, tuple[Condition, ...]]]:
        for name in REWARD_METHODS if self.weights else ():
            for returned in self.definitions.list_results(self.definitions.find_function(name)):
                yield from self._list_entries(returned)

    def _expand(
        self, place: ReadExpression, weight: float, name: str, conditions: tuple[Condition, ...], replaces: bool = False
    ) -> Iterator[Summand]:
        if place.depth > DEEPEST:
            return

        def go(node: ast.expr, factor: float = 1.0, more: tuple[Condition, ...] = ()) -> Iterator[Summand]:
            return self._expand(place.at(node), factor * weight, name, conditions + more, replaces)

        match place.node:
            case ast.BinOp(left=ast.BinOp(op=ast.Mod()), op=ast.Add() | ast.Sub()):  # an angle within half a turn
                yield self._make(name or ast.unparse(place.node), place, weight, conditions, replaces)
            case ast.BinOp(left=left, op=ast.Add() | ast.Sub() as operator, right=right):
                if isinstance(operator, ast.Sub):
                    self._differences.append(self._make(name, place, weight, conditions))
                yield from go(left)
                yield from go(right, 1.0 if isinstance(operator, ast.Add) else -1.0)
            case ast.UnaryOp(op=ast.USub(), operand=operand):
                yield from go(operand, -1.0)
            case ast.BinOp(left=left, op=ast.Mult(), right=right) if (
                factor := self.numbers.read_constant(left)
            ) is not None:
                yield from go(right, factor)
            case ast.BinOp(left=left, op=ast.Mult() | ast.Div() as operator, right=right) if (
                factor := self.numbers.read_constant(right)
            ):
                yield from go(left, factor if isinstance(operator, ast.Mult) else 1 / factor)
            case ast.IfExp(test=test, body=body, orelse=orelse):
                yield from go(body, 1.0, ((test, True),))
                yield from go(orelse, 1.0, ((test, False),))
            case ast.Call(func=ast.Attribute(attr="where"), args=[test, body, orelse]):
                yield from go(body, 1.0, ((test, True),))
                yield from go(orelse, 1.0, ((test, False),))
            case ast.Call(func=ast.Name(id=called) | ast.Attribute(attr=called)) if called in SUMS:
                parts = list(self._expand_sum(place, place.node, weight, conditions))
                yield from parts or [self._make(name or called, place, weight, conditions, replaces)]
            case ast.Call() | ast.Name() | ast.Attribute() | ast.Subscript():
                self._path.append(read_name(place.node))
                yield from self._expand_name(place, weight, name, conditions, replaces)
                self._path.pop()
            case _:
                yield self._make(name or ast.unparse(place.node), place, weight, conditions, replaces)

    def _make(
        self, name: str, place: ReadExpression, weight: float, conditions: tuple[Condition, ...], replaces: bool = False
    ) -> Summand:
        return Summand(name, place, weight, conditions, replaces, tuple(self._path))

    def _expand_name(
        self, place: ReadExpression, weight: float, name: str, conditions: tuple[Condition, ...], replaces: bool
    ) -> Iterator[Summand]:
        own = name or read_name(place.node)
        if REWARD_NAMES & set(split_name(own)):
            own = ""
        before = [] if isinstance(place.node, ast.Call) else self.definitions.list_before(place)
        if not before:
            found = self.definitions.follow(place)
            for one in found:
                inside = self.definitions.list_conditions(one.node) if one.function is not place.function else ()
                yield from self._expand(one, weight, own, (*conditions, *inside))
            if not found:
                yield self._make(own or ast.unparse(place.node), place, weight, conditions, replaces)
        for order, assigned in enumerate(before):
            tests = (*conditions, *self.definitions.list_conditions(assigned.statement))
            for value, sign in assigned.parts:
                deeper = dataclasses.replace(place, node=value, depth=place.depth + 1)
                looped = self._expand_loop(deeper, assigned, sign * weight, tests) if assigned.added else None
                if looped is not None:
                    yield from looped
                    continue
                parts = self.definitions.select(deeper, assigned.element)
                if not parts:
                    yield self._make(own or ast.unparse(place.node), place, weight, tests)
                for part in parts:
                    # What is added is a part of its own, and its name is not that of the sum.
                    title = own if len(before) == 1 and len(assigned.added) < 2 else ""
                    yield from self._expand(part, sign * weight, title, tests, order > 0 and not assigned.added)

    def _expand_sum(
        self, place: ReadExpression, call: ast.Call, weight: float, conditions: tuple[Condition, ...]
    ) -> Iterator[Summand]:
        for inner in call.args[:1]:
            if isinstance(inner, ast.Call) and isinstance(inner.func, ast.Name) and inner.func.id == "list":
                inner = inner.args[0]
            match inner:
                case ast.Call(func=ast.Attribute(value=dictionary, attr="values")):
                    for key, one, tests in self._list_entries(place.at(dictionary)):
                        yield from self._expand(one, weight, key, conditions + tests)
                case ast.List(elts=parts) | ast.Tuple(elts=parts):
                    for part in parts:
                        yield from self._expand(place.at(part), weight, "", conditions)
                case ast.GeneratorExp(elt=elt, generators=[loop]) | ast.ListComp(elt=elt, generators=[loop]):
                    yield from self._expand_over(place, loop.target, loop.iter, elt, weight, conditions) or ()

    def _expand_loop(
        self, place: ReadExpression, one: Assignment, weight: float, conditions: tuple[Condition, ...]
    ) -> Iterator[Summand] | None:
        """Return the summands of a loop through a dictionary that adds each entry."""
        node: ast.AST = one.statement
        while node is not place.function:
            node = self.source.parents[node]
            if isinstance(node, ast.For):
                return self._expand_over(place, node.target, node.iter, place.node, weight, conditions)
        return None

    def _expand_over(
        self,
        place: ReadExpression,
        target: ast.expr,
        through: ast.expr,
        elt: ast.expr,
        weight: float,
        conditions: tuple[Condition, ...],
    ) -> Iterator[Summand] | None:
        match through:
            case ast.Call(func=ast.Attribute(value=dictionary, attr="items" | "keys" | "values")):
                pass
            case _:
                dictionary = through
        entries = list(self._list_entries(place.at(dictionary)))
        names = {node.id for node in ast.walk(target) if isinstance(node, ast.Name)}
        if not entries or not names:
            return None
        if factor := find_function_of_values(elt, target, through, dictionary):
            return iter([self._make(ast.unparse(factor), place.at(elt), weight, conditions)])
        return self._weigh_entries(place, entries, dictionary, names, elt, weight, conditions)

    def _weigh_entries(
        self,
        place: ReadExpression,
        entries: Sequence[tuple[str, ReadExpression, tuple[Condition, ...]]],
        dictionary: ast.expr,
        names: set[str],
        elt: ast.expr,
        weight: float,
        conditions: tuple[Condition, ...],
    ) -> Iterator[Summand]:
        factors = list_product(elt)
        others = [
            factor
            for factor in factors
            if not (isinstance(factor, ast.Name) and factor.id in names)
            and not (isinstance(factor, ast.Subscript) and ast.unparse(factor.value) == ast.unparse(dictionary))
        ]
        for order, (key, one, tests) in enumerate(entries):
            total = weight
            for factor in others:
                total *= self.numbers.read_nth(factor, order, len(entries))
            yield from self._expand(one, total, key, conditions + tests)

    def _list_entries(self, place: ReadExpression) -> Iterator[tuple[str, ReadExpression, tuple[Condition, ...]]]:
        """Yield the keys of a dictionary, with their values, and where they are given."""
        if place.depth > DEEPEST:
            return
        place = dataclasses.replace(place, depth=place.depth + 1)
        match place.node:
            case ast.Dict(keys=keys, values=values):
                for key, value in zip(keys, values, strict=True):
                    if key is None:
                        yield from self._list_entries(place.at(value))
                    elif isinstance(key, ast.Constant):
                        yield str(key.value), place.at(value), ()
            case ast.Call(func=ast.Name(id="dict"), args=args, keywords=words):
                for inner in args:
                    yield from self._list_entries(place.at(inner))
                for word in words:
                    if word.arg is not None:
                        yield word.arg, place.at(word.value), ()
            case ast.DictComp(value=value, generators=[loop]):
                through = loop.iter
                if isinstance(through, ast.Call) and isinstance(through.func, ast.Attribute):
                    through = through.func.value
                # `{k: float(v) for k, v in terms.items()}` has the same entries.
                if not any(isinstance(node, ast.BinOp) for node in ast.walk(value)):
                    yield from self._list_entries(place.at(through))
            case ast.Name() | ast.Attribute():
                for one in self.definitions.list_before(place):
                    tests = tuple(self.definitions.list_conditions(one.statement))
                    for part in self.definitions.select(place.at(one.value), one.element):
                        yield from ((*entry[:2], tests + entry[2]) for entry in self._list_entries(part))
                yield from self._list_single(place)
                if not self.definitions.list_before(place):
                    for part in self.definitions.follow(place):
                        yield from self._list_entries(part)
            case ast.Call():
                for part in self.definitions.follow(place):
                    yield from self._list_entries(part)

    def _list_single(self, place: ReadExpression) -> Iterator[tuple[str, ReadExpression, tuple[Condition, ...]]]:
        """Yield what is assigned to single keys of a dictionary."""
        text = ast.unparse(place.node)
        for several in self.definitions.list_assigned(place.function).values():
            for one in several:
                match one.target:
                    case ast.Subscript(value=owner, slice=ast.Constant(value=key)) if (
                        ast.unparse(owner) == text and one.is_known and one.statement.lineno < place.node.lineno
                    ):
                        for value, _ in one.parts:
                            tests = tuple(self.definitions.list_conditions(one.statement))
                            yield str(key), place.at(value), tests
