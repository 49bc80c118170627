"""Differences with their signs in the source of a reward: as costs, and in functions that fall with them."""

import ast
import dataclasses
from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from rlctl.checking.assignments import list_name_words, read_name
from rlctl.checking.definitions import ReadExpression
from rlctl.checking.experiments.expressions import NotedEpisodes
from rlctl.checking.products import list_product
from rlctl.checking.summands import SUMS, RewardReader, Summand
from rlctl.checking.term_names import ENERGY_WORDS, OPPOSITE_WORDS, PLACE_WORDS, split_name
from rlctl.checking.timed_expressions import spans_steps

Numbers = NDArray[np.float64]
COMMAND_WORDS = {
    "cmd",
    "cmds",
    "command",
    "commanded",
    "commands",
    "des",
    "desired",
    "ref",
    "reference",
    "setpoint",
    "wanted",
}
WANTED_WORDS = PLACE_WORDS | COMMAND_WORDS
EARLIER_WORDS = {"before", "last", "old", "prev", "previous"}
SIZES = {"abs", "absolute", "fabs", "hypot", "norm", "square", "squared", "distance", "sqrt", "arccos", "acos", "dist"}
"""Functions of a difference that have no sign, or are never negative."""
LIMITS = {"max", "maximum", "fmax"}
CLEAR = 0.1  # part of the values
FEWEST, PART = 20, 0.03  # values that are noted, and how many of them are on either side of 0


@dataclasses.dataclass(frozen=True, eq=False)
class SignedError:
    """A difference that counts with its sign, although the reward should be largest where it is 0."""

    summand: Summand
    place: ReadExpression  # of the difference, or of the sum of them
    outer: str  # how it counts
    sign: float  # of what is paid for it


class ErrorReader:
    """Finds them."""

    def __init__(self, notes: NotedEpisodes) -> None:
        self.notes = notes
        self.reward: RewardReader = notes.reward
        self.definitions = self.reward.definitions
        self._sized = set(_list_sized(notes))
        self._directed = set(_list_directed(notes))

    def is_sized(self, text: str) -> bool:
        """Say whether the source takes the size of an expression somewhere."""
        return text in self._sized

    def find_errors(self) -> Iterator[SignedError]:
        """Yield the differences with a sign in the reward."""
        for summand in self.reward.summands:
            for outer, place, sign in self._list_kernels(summand):
                texts: list[str] = []
                for sign_of, core in self._list_linear(place, sign, texts):
                    if self._is_signed_error(core, texts, summand, needs_both=outer != "max"):
                        yield SignedError(summand, core, outer, sign_of)
        for summand in self.reward.differences:
            if summand.weight < 0:
                texts = [summand.text]
                if self._is_signed_error(summand.place, texts, summand, needs_both=False):
                    yield SignedError(summand, summand.place, "", summand.weight)

    def find_sums(self) -> Iterator[tuple[Summand, ReadExpression]]:
        """Yield costs that are sums of numbers of both signs, and so of both signs themselves."""
        for summand in self.reward.summands:
            if not summand.weight < 0 or set(split_name(summand.name)) & (OPPOSITE_WORDS | {"velocity", "speed"}):
                continue
            place = self.definitions.resolve(summand.place)
            inner = read_summed(place.node)
            if inner is None or self._is_product(place.at(inner), summand.name):
                continue
            sums = self.reward.numbers.list_values(place.node)
            if sums.size >= FEWEST and has_both_signs(sums, CLEAR):
                yield summand, place

    def _is_product(self, place: ReadExpression, name: str) -> bool:
        """Say whether what is summed is a product, which may be meant: a scalar product, but not a power."""
        node = self.definitions.resolve(place).node
        is_difference = isinstance(node, ast.BinOp) and isinstance(node.op, ast.Sub)
        if is_difference:
            return True
        is_product = isinstance(node, ast.BinOp) and not set(split_name(name)) & ENERGY_WORDS
        return is_product and not any(self._is_fixed(place.at(one)) for one in (node.left, node.right))  # type: ignore[attr-defined]

    def find_powers(self) -> Iterator[tuple[Summand, ReadExpression]]:
        """Yield what is paid as an even power of a cosine that is negative at times, and is used with its sign too."""
        for summand in self.reward.summands:
            for factor in list_product(summand.place.node) if summand.weight > 0 else ():
                place = self.definitions.resolve(summand.place.at(factor))
                match place.node:
                    case ast.BinOp(left=base, op=ast.Pow(), right=ast.Constant(value=int(power))) if power % 2 == 0:
                        values = self.reward.numbers.list_values(base)
                        if values.size < FEWEST or np.abs(values).max() > 1 + 1e-6 or not (values < 0).mean() > PART:
                            continue
                        if self.is_cosine(place.at(base)) and ast.unparse(base) in self._directed:
                            yield summand, place.at(base)

    def find_growing(self) -> Iterator[tuple[Summand, ReadExpression]]:
        """Yield paid exponentials of sizes, which are smallest where the size is 0: a minus is missing."""
        for summand in self.reward.summands:
            for factor in list_product(summand.place.node) if summand.weight > 0 else ():
                place = self.definitions.resolve(summand.place.at(factor))
                place = place.at(read_summed(place.node) or place.node)
                match place.node:
                    case ast.Call(func=function, args=[only]) if read_name(function) == "exp":
                        values, given = (self.reward.numbers.list_values(node) for node in (place.node, only))
                        is_size = given.size >= FEWEST and given.min() >= 0 and self._has_size(place.at(only))
                        if is_size and (values > 1 + CLEAR).mean() > PART:
                            yield summand, place

    def _has_size(self, place: ReadExpression) -> bool:
        return any(
            (isinstance(one.node, ast.Call) and read_name(one.node.func) in SIZES)
            or (isinstance(one.node, ast.BinOp) and isinstance(one.node.op, ast.Pow))
            for one in self.definitions.walk(place)
        )

    def is_cosine(self, place: ReadExpression) -> bool:
        """Say whether it is computed as a cosine, or a scalar product, or is the last number of a matrix."""
        node = self.definitions.resolve(place).node
        match node:
            case ast.BinOp(op=ast.MatMult()):
                return True
            case ast.Call(func=function):
                return read_name(function) in {"cos", "dot", "vdot", "sum", "einsum", "clip"}
            case ast.Subscript():
                return ast.unparse(node.slice).replace("(", "").replace(")", "").endswith("2, 2")
        return False

    def _list_kernels(self, summand: Summand) -> Iterator[tuple[str, ReadExpression, float]]:
        """Yield arguments of functions that should be largest where the argument is 0."""
        if not summand.weight:
            return
        for factor in list_product(summand.place.node):
            place = self.definitions.resolve(summand.place.at(factor))
            while isinstance(place.node, ast.BinOp) and isinstance(place.node.op, ast.Pow):
                place = self.definitions.resolve(place.at(place.node.left))
            match place.node:
                case ast.Call(func=function, args=[only]) if read_name(function) == "exp" and not summand.weight < 0:
                    values = self.reward.numbers.list_values(place.node)
                    if values.size and (values > 1.05).mean() > PART:
                        yield "exp", place.at(only), 1.0
                case ast.Call(func=function, args=[only]) if read_name(function) == "tanh" and summand.weight < 0:
                    yield "tanh", place.at(only), -1.0
                case ast.Call(func=function, args=[one, two]) if read_name(function) in LIMITS and summand.weight > 0:
                    inner = two if isinstance(one, ast.Constant) else one
                    resolved = self.definitions.resolve(place.at(inner))
                    if _is_from_constant(resolved.node):
                        yield "max", resolved.at(resolved.node.right), -1.0  # type: ignore[attr-defined]
                case ast.Call(func=function) if read_name(function) in SUMS and summand.weight < 0:
                    yield "", place, -1.0

    def _list_linear(
        self, place: ReadExpression, sign: float, texts: list[str]
    ) -> Iterator[tuple[float, ReadExpression]]:
        """Yield what an expression is proportional to."""
        texts.append(ast.unparse(place.node))
        match place.node:
            case ast.UnaryOp(op=ast.USub(), operand=operand):
                yield from self._list_linear(place.at(operand), -sign, texts)
            case ast.BinOp(left=left, op=ast.Mult() | ast.Div(), right=right) if self._is_fixed(place.at(right)):
                yield from self._list_linear(place.at(left), sign, texts)
            case ast.BinOp(left=left, op=ast.Mult(), right=right) if self._is_fixed(place.at(left)):
                yield from self._list_linear(place.at(right), sign, texts)
            case ast.BinOp():
                yield sign, place
            case ast.Call(func=function) if read_name(function) in SUMS:
                inner = place.node.args[0] if place.node.args else getattr(function, "value", None)
                if inner is not None:
                    resolved = self.definitions.resolve(place.at(inner))
                    if isinstance(resolved.node, ast.BinOp) and isinstance(resolved.node.op, ast.Sub):
                        texts.append(ast.unparse(inner))
                        texts.append(ast.unparse(resolved.node))
                        yield sign, resolved
            case ast.Subscript(value=owner) if not self.definitions.follow(place):
                whole = self.definitions.resolve(place.at(owner))
                if isinstance(whole.node, ast.BinOp) and isinstance(whole.node.op, ast.Sub):
                    yield sign, whole
            case _:
                found = self.definitions.follow(place)
                if len(found) == 1:
                    yield from self._list_linear(found[0], sign, texts)

    def _is_fixed(self, place: ReadExpression) -> bool:
        if self.reward.numbers.read_constant(place.node) is not None:
            return True
        values = self.reward.numbers.list_values(place.node)
        return bool(values.size) and bool((values == values[0]).all())

    def _is_signed_error(self, place: ReadExpression, texts: Sequence[str], summand: Summand, needs_both: bool) -> bool:
        match place.node:
            case ast.BinOp(left=left, op=ast.Sub(), right=right):
                sides = [place.at(left), place.at(right)]
            case _:
                return False
        wanted = [self.is_wanted(side) for side in sides]
        if sum(wanted) != 1 or self.is_between_steps(place) or any(self._is_size(side) for side in sides):
            return False
        if all(self._is_fixed(side) for side in sides):
            return False
        values = self.reward.numbers.list_values(place.node)
        has_both = values.size >= FEWEST and has_both_signs(values, PART)
        is_sized = any(text in self._sized for text in [*texts, ast.unparse(place.node)])
        reverse = f"{ast.unparse(place.node.right)} - {ast.unparse(place.node.left)}"
        is_sized = is_sized or reverse in self._sized
        return has_both or (is_sized and not needs_both and not summand.conditions)

    def is_wanted(self, place: ReadExpression) -> bool:
        """Say whether a value is what a command or a goal says, by its name."""
        places = [place, self.definitions.resolve(place)]
        words = {word for one in places for word in split_name(read_name(one.node))}
        return bool(words & WANTED_WORDS)

    def _is_size(self, place: ReadExpression) -> bool:
        node = self.definitions.resolve(place).node
        return any(isinstance(one, ast.Call) and read_name(one.func) in SIZES for one in [node])

    def is_between_steps(self, place: ReadExpression) -> bool:
        """Say whether a difference is that to a value of the step before, by names or by values."""
        one = self.notes.source.find(place.node)
        return bool(list_name_words(place.node) & EARLIER_WORDS) or (
            one is not None and spans_steps(self.notes.source, one, self.notes.steps)
        )


def _is_from_constant(node: ast.expr) -> bool:
    return isinstance(node, ast.BinOp) and isinstance(node.op, ast.Sub) and isinstance(node.left, ast.Constant)


def _list_sized(notes: NotedEpisodes) -> Iterator[str]:
    """Yield of which expressions the source takes the size."""
    for tree in notes.source.trees.values():
        for node in ast.walk(tree):
            match node:
                case ast.Call(func=function, args=[only, *_]) if read_name(function) in SIZES:
                    yield ast.unparse(only)
                case ast.BinOp(left=left, op=ast.Pow()):
                    yield ast.unparse(left)


def _list_directed(notes: NotedEpisodes) -> Iterator[str]:
    """Yield of which expressions the source takes the angle, or asks whether they are large."""
    for tree in notes.source.trees.values():
        for node in ast.walk(tree):
            match node:
                case ast.Call(func=function, args=[only, *_]) if read_name(function) in ("arccos", "acos"):
                    yield from (ast.unparse(part) for part in ast.walk(only) if isinstance(part, ast.expr))
                case ast.Compare(left=left, ops=[ast.Gt() | ast.GtE() | ast.Lt() | ast.LtE()], comparators=[right]):
                    yield ast.unparse(left)
                    yield ast.unparse(right)


def read_summed(node: ast.expr) -> ast.expr | None:
    """Return what is summed; None for what is no sum."""
    match node:
        case ast.Call(func=ast.Name() | ast.Attribute() as function) if read_name(function) in SUMS:
            if isinstance(function, ast.Attribute) and read_name(function.value) not in ("np", "numpy", "math", "jnp"):
                return function.value
            first = node.args[0] if node.args else None
            return first.elt if isinstance(first, ast.GeneratorExp | ast.ListComp) else first
    return None


def has_both_signs(values: Numbers, part: float) -> bool:
    """Say whether at least such a part of the values is above 0, and as many below."""
    return bool(values.size) and min((values > 0).mean(), (values < 0).mean()) >= part
