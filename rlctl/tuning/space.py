"""The search space: hyperparameters and their values, in the order in which they are tuned."""

import dataclasses
import math
import re
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from rlctl.environments.spec import merge
from rlctl.errors import UsageError
from rlctl.recipe.hyperparameters import LINEAR, ON_POLICY, split_schedule
from rlctl.recipe.recipe import Recipe, fill_parameters
from rlctl.storage import yaml_text

if TYPE_CHECKING:
    from optuna.distributions import BaseDistribution

_RANGE = re.compile(r"(?P<prefix>[a-z]+_)?(?P<low>[^:,]+):(?P<again>[a-z]+_)?(?P<high>[^:,]+)")
_LOG_FROM = 10  # times the lower end
_DIGITS = 3  # of a number that was drawn


@dataclasses.dataclass(frozen=True)
class Dimension:
    """A key of the recipe and its values: one of `choices`, or a number from `low` to `high`."""

    key: str
    choices: tuple[Any, ...] = ()
    low: float = 0.0
    high: float = 0.0
    whole: bool = False
    prefix: str = ""  # `lin_` before the number of a linear schedule

    def __post_init__(self) -> None:
        if not self.low <= self.high:
            raise ValueError(f"{self.key}: {self.low} is not below {self.high}")

    @property
    def name(self) -> str:
        """Return the last part of the key."""
        return self.key.rpartition(".")[2]

    def ends(self) -> list[Any]:
        """Return all choices, or the lower and upper end of the range."""
        return list(self.choices) or [self._format(self.low), self._format(self.high)]

    def make_distribution(self) -> "BaseDistribution":
        """Return Optuna's distribution: of numbers, logarithmic if wide, or of indices of the choices."""
        from optuna import distributions

        if self.choices:
            return distributions.CategoricalDistribution(tuple(range(len(self.choices))))
        log = self.low > 0 and self.high >= _LOG_FROM * self.low
        if self.whole:
            return distributions.IntDistribution(int(self.low), int(self.high), log=log)
        return distributions.FloatDistribution(self.low, self.high, log=log)

    def to_value(self, drawn: float) -> Any:
        """Return the recipe's value of Optuna's parameter."""
        if self.choices:
            return self.choices[int(drawn)]
        rounded = drawn if self.whole else float(f"{drawn:.{_DIGITS}g}")
        return self._format(min(max(rounded, self.low), self.high))

    def from_value(self, value: Any) -> float | None:
        """Return Optuna's parameter for a value; None outside the distribution."""
        if self.choices:
            return self.choices.index(value) if value in self.choices else None
        try:
            number = float(str(value).removeprefix(self.prefix))
        except ValueError:
            return None
        if not self.low <= number <= self.high:
            return None
        return int(number) if self.whole else number

    def _format(self, number: float) -> Any:
        value = int(number) if self.whole else number
        return f"{self.prefix}{value:g}" if self.prefix else value


def parse_search(texts: Sequence[str]) -> list[Dimension]:
    """Return the dimensions of `--search KEY=LOW:HIGH` and `KEY=A,B,C`; raises `UsageError` for invalid text."""
    dimensions = [_parse_dimension(text) for text in texts]
    keys = [dimension.key for dimension in dimensions]
    if twice := [key for key in keys if keys.count(key) > 1]:
        raise UsageError(f"--search: {twice[0]} is given twice")
    return dimensions


def _parse_dimension(text: str) -> Dimension:
    key, equals, values = text.partition("=")
    help_text = "write KEY=LOW:HIGH or KEY=A,B,C, for example algo_kwargs.gamma=0.95,0.98,0.99"
    if not equals or not all(key.strip().split(".")):
        raise UsageError(f"--search {text!r}: {help_text}")
    if match := _RANGE.fullmatch(values.strip()):
        return _parse_range(key.strip(), match, text)
    choices = yaml_text.load(f"[{values}]", f"--search {key}")
    if not isinstance(choices, list) or len(choices) < 2:
        raise UsageError(f"--search {text!r}: a search needs two values or more; {help_text}")
    return Dimension(key.strip(), tuple(choices))


def _parse_range(key: str, match: re.Match[str], text: str) -> Dimension:
    try:
        low, high = float(match["low"]), float(match["high"])
    except ValueError:
        raise UsageError(f"--search {text!r}: {match['low']} and {match['high']} must be numbers") from None
    if not (math.isfinite(low) and math.isfinite(high) and low < high) or match["again"] not in (None, match["prefix"]):
        raise UsageError(f"--search {text!r}: not a range: write LOW:HIGH with LOW below HIGH and the same prefix")
    whole = all(re.fullmatch(r"-?\d+", match[end]) for end in ("low", "high"))
    return Dimension(key, low=low, high=high, whole=whole, prefix=match["prefix"] or "")


def list_usual_steps(recipe: Recipe) -> list[list[Dimension]]:
    """Return the usual steps, around the recipe's values: learning rate; n_steps and batch_size; gamma."""
    parameters = fill_parameters(recipe)
    return [
        [_vary_learning_rate(parameters["learning_rate"])],
        _vary_batches(recipe, parameters),
        [_choose("gamma", {0.95, 0.97, 0.98, 0.99, 0.995, parameters["gamma"]})],
    ]


def list_values(recipe: Recipe) -> dict[str, Any]:
    """Return the keys and values of a recipe as plain data, with the defaults of its algorithm."""
    return recipe.model_dump(mode="json", by_alias=True) | {"algo_kwargs": fill_parameters(recipe)}


def _vary_learning_rate(value: Any) -> Dimension:
    rate, falls = split_schedule(value)
    low, high = (float(f"{bound:.{_DIGITS}g}") for bound in (rate / 10, min(10 * rate, 1.0)))
    return Dimension("algo_kwargs.learning_rate", low=low, high=high, prefix=LINEAR if falls else "")


def _vary_batches(recipe: Recipe, parameters: Mapping[str, Any]) -> list[Dimension]:
    dimensions = []
    n_steps, batch_size = parameters["n_steps"], parameters.get("batch_size")
    most = math.inf
    if recipe.algo in ON_POLICY:
        most = max(n_steps, recipe.total_timesteps // (4 * recipe.n_envs))  # four updates at least
        dimensions.append(_choose("n_steps", {n_steps, *(value for value in _around(n_steps, 8) if value <= most)}))
        most = n_steps * recipe.n_envs
    elif recipe.her is None:
        dimensions.append(_choose("n_steps", {1, 3, 5, n_steps}))
    if batch_size is not None:
        sizes = {batch_size, *(value for value in _around(batch_size, 16) if value <= most)}
        dimensions.append(_choose("batch_size", sizes))
    return dimensions


def _around(value: int, least: int) -> list[int]:
    return [max(least, value // 2), 2 * value, 4 * value]


def _choose(name: str, values: set[Any]) -> Dimension:
    return Dimension(f"algo_kwargs.{name}", tuple(sorted(values)))


def nest(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return `{"algo_kwargs": {"gamma": 0.98}}` for `{"algo_kwargs.gamma": 0.98}`."""
    result: dict[str, Any] = {}
    for key, value in values.items():
        for part in reversed(key.split(".")):
            value = {part: value}
        result = merge(result, value)
    return result


def get_value(content: Mapping[str, Any], key: str) -> Any:
    """Return the value of a dotted key; None if it is not there."""
    value: Any = content
    for part in key.split("."):
        if not isinstance(value, Mapping):
            return None
        value = value.get(part)
    return value
