"""Calls of the source with two arguments in each other's place, such as a high limit given as the low one."""

import ast
import dataclasses
import inspect
from collections.abc import Iterator, Mapping
from types import FunctionType, ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlctl.checking.assignments import LIBRARIES, list_parameters, read_name, read_root
from rlctl.checking.definitions import bind
from rlctl.checking.experiments.expressions import NotedEpisodes, read_step
from rlctl.checking.source_code import Expression
from rlctl.checking.term_names import split_name

LOW_WORDS, HIGH_WORDS = {"low", "lower", "lo", "min", "minimum"}, {"high", "upper", "hi", "max", "maximum"}
SYMMETRIC_WORDS = {"left", "right", "first", "second", "one", "two", "a", "b"}
"""Of parameters that are exchanged on purpose."""
SHORTEST = 3  # letters of a name that says what it is
CLIPPED = ("a", "min", "max")  # the parameters of NumPy's function; a method has no first one
FEWEST = 3  # calls in which a limit is seen


@dataclasses.dataclass(frozen=True, eq=False)
class ExchangedArguments:
    """A call, and the two arguments by the names of their parameters."""

    call: ast.Call
    function: str
    given: Mapping[str, str]  # expressions by parameters
    where: tuple[str, int]


class CallReader:
    """Finds them."""

    def __init__(self, notes: NotedEpisodes) -> None:
        self.notes, self.source, self.definitions = notes, notes.source, notes.definitions

    def find(self) -> Iterator[ExchangedArguments]:
        """Yield calls with exchanged limits; and those with exchanged names, where the right order pays or shows
        something else."""
        for function in self.notes.functions:
            for call in ast.walk(function):
                if isinstance(call, ast.Call):
                    pair = self._find_pair(self._bind(call))
                    if pair is not None:
                        where = self.source.find_place(call)
                        yield ExchangedArguments(call, read_name(call.func), pair, where)

    def _find_pair(self, given: Mapping[str, ast.expr]) -> dict[str, str] | None:
        for low, high in ((low, high) for low in given for high in given if low != high):
            is_wrong = self._are_limits_exchanged(low, high, given) or self._are_names_exchanged(low, high, given)
            if is_wrong:
                return {name: ast.unparse(given[name]) for name in (low, high)}
        return None

    def _bind(self, call: ast.Call) -> dict[str, ast.expr]:
        """Return what a call gives to parameters whose names are known."""
        if any(isinstance(argument, ast.Starred) for argument in call.args):
            return {}
        own = self.definitions.find_function(read_name(call.func))
        if own is None and read_name(call.func) == "clip" and isinstance(call.func, ast.Attribute):
            is_function = read_root(call.func.value) in LIBRARIES or len(call.args) >= len(CLIPPED)
            return bind(call, CLIPPED if is_function else CLIPPED[1:])
        return bind(call, list_parameters(own) if own is not None else self._list_foreign(call.func))

    def _list_foreign(self, node: ast.expr) -> list[str]:
        """Return the parameters of a function of another module; nothing where it cannot be read."""
        function = self._read(node)
        if not isinstance(function, FunctionType) and not isinstance(function, np.ufunc | type(np.clip)):
            return []
        try:
            return list(inspect.signature(function).parameters)
        except (TypeError, ValueError):
            return []

    def _read(self, node: ast.expr) -> Any:
        match node:
            case ast.Name(id=name):
                return next((vars(module)[name] for module in self.source.modules if name in vars(module)), None)
            case ast.Attribute(value=owner, attr=name):
                known = self._read(owner)
                return getattr(known, name, None) if isinstance(known, ModuleType) else None
        return None

    def _are_limits_exchanged(self, low: str, high: str, given: Mapping[str, ast.expr]) -> bool:
        """Say whether what is given as the low limit was above the high one in all calls."""
        words = set(split_name(low)), set(split_name(high))
        if not words[0] & LOW_WORDS or not words[1] & HIGH_WORDS or words[0] - LOW_WORDS != words[1] - HIGH_WORDS:
            return False
        lows, highs = (self._list_limits(given[name]) for name in (low, high))
        if not (lows.size == highs.size >= FEWEST or (1 in (lows.size, highs.size) and lows.size * highs.size)):
            return False
        return bool((lows >= highs).all() and (lows > highs).any())

    def _list_limits(self, node: ast.expr) -> NDArray[np.float64]:
        """Return what a limit was worth in all calls, or the number that it always is."""
        constant = self.notes.reward.numbers.read_constant(node)
        values = self.notes.reward.numbers.list_values(node)
        if constant is not None:
            return np.array([constant])
        return values if values.size >= FEWEST else np.zeros(0)

    def _are_names_exchanged(self, one: str, other: str, given: Mapping[str, ast.expr]) -> bool:
        """Say whether both arguments have the names of each other's parameters, and their order matters."""
        if (read_name(given[one]), read_name(given[other])) != (other, one) or min(len(one), len(other)) < SHORTEST:
            return False
        if {*split_name(one), *split_name(other)} & SYMMETRIC_WORDS:
            return False
        sides = self.source.find(given[one]), self.source.find(given[other])
        return sides[0] is not None and sides[1] is not None and self._matters(sides[0], sides[1])

    def _matters(self, one: Expression, other: Expression) -> bool:
        """Say whether a step is another one where both are exchanged in it."""
        for number, episode in enumerate(self.notes.episodes):
            for call in episode[1:]:
                first, second = (call.values.get(side.number, [None])[0] for side in (one, other))
                if first is None or second is None or np.shape(first) != np.shape(second):
                    continue
                exchanged = {one.number: second, other.number: first}
                return bool(self.notes.changes(number, call.step, {}, exchanged, read=read_step))
        return False
