"""Usual ranges of hyperparameters, from `usual_ranges.yaml`: how far a value is out of its range, and what to try."""

import dataclasses
import functools
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import yaml

FAR_OUT = 5.0
"""Factor outside of its usual range from which a hyperparameter is the first suspect."""
_GAMMA = "gamma"


@dataclasses.dataclass(frozen=True)
class Setting:
    """A hyperparameter that may need another value."""

    name: str
    value: Any  # the value in the recipe, or SB3's default
    advice: str  # its usual range and value, and what raising and lowering it does
    times_out: float = 1.0  # by what factor it is above or below its usual range; 1 inside

    @property
    def is_far_out(self) -> bool:
        """Whether it is out of its usual range by `FAR_OUT` or more."""
        return self.times_out >= FAR_OUT


@functools.cache
def read_table(name: str) -> dict[str, Any]:
    """Return the content of a YAML file of this folder."""
    loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)  # ten times faster, where PyYAML has it
    text = Path(__file__).with_name(name).read_text(encoding="utf-8")
    table: dict[str, Any] = yaml.load(text, loader)  # noqa: S506
    return table


def _rows() -> dict[str, Any]:
    return read_table("usual_ranges.yaml")


def _find_row(name: str, algo: object) -> dict[str, Any] | None:
    """Return what is usual for a hyperparameter of an algorithm; None where its meaning there is not known."""
    rows: list[dict[str, Any]] = _rows()[name] if isinstance(_rows()[name], list) else [_rows()[name]]
    return next((row for row in rows if algo in row.get("algos", [algo])), None)


def list_names() -> list[str]:
    """Return the hyperparameters whose usual range is known."""
    return list(_rows())


def list_settings(names: Iterable[str], parameters: Mapping[str, Any], algo: object, n_envs: int) -> list[Setting]:
    """Return those of the named hyperparameters that the algorithm has, the farthest out of its usual range first.

    `parameters` are the values of the algorithm's hyperparameters. Beside one that is far out, those in their usual
    range are left out.
    """
    settings = []
    for name in names:
        row = _find_row(name, algo)
        if name not in parameters or row is None:
            continue
        value = parameters[name]
        factor = _count_times_out(name, value, _read_range(row, n_envs))
        advice = f"usually {row['range']}, often {row['common']}; raise: {row['raise']}; lower: {row['lower']}"
        if factor >= FAR_OUT:
            advice = f"{factor:.0f} times out of its usual range; {advice}"
            if name == _GAMMA:
                advice = f"the policy {_describe_horizon(value)}; {advice}"
        settings.append(Setting(name, value, advice, factor))
    if any(setting.is_far_out for setting in settings):
        settings = [setting for setting in settings if setting.times_out > 1]
    return sorted(settings, key=lambda setting: -setting.times_out if setting.is_far_out else 0.0)


def find_far_out(parameters: Mapping[str, Any], algo: object, n_envs: int) -> list[Setting]:
    """Return the hyperparameters that are far out of their usual range, the farthest first."""
    settings = list_settings(list_names(), parameters, algo, n_envs)
    return [setting for setting in settings if setting.is_far_out]


def describe(setting: Setting, algo: object) -> str:
    """Return `gamma 0.2: usually 0.9 to 0.9999; the policy then sees about 1 step ahead`."""
    row = _find_row(setting.name, algo)
    assert row is not None  # else it would be no setting of the algorithm
    low, _ = _read_range(row, 1)
    number = read_first_value(setting.value)
    if setting.name == _GAMMA:
        consequence = f"the policy then {_describe_horizon(setting.value)}"
    elif number is not None and number < low:
        consequence = f"raise it: {row['raise']}"
    else:
        consequence = f"lower it: {row['lower']}"
    return f"{setting.name} {setting.value}: usually {row['range']}; {consequence}"


def _describe_horizon(gamma: object) -> str:
    horizon = round(_find_horizon(read_first_value(gamma) or 0.0))
    return "sees about 1 step ahead" if horizon == 1 else f"sees about {horizon:,} steps ahead"


def _find_horizon(gamma: float) -> float:
    """Return how many steps ahead rewards count, 1 / (1 - gamma)."""
    return 1 / (1 - gamma)


def _read_range(row: Mapping[str, Any], n_envs: int) -> tuple[float, float]:
    low, high = (float(end) for end in row["range"].split(" to "))
    if row.get("low_per_env"):
        low /= n_envs
    if row.get("high_per_env"):
        high *= n_envs
    return low, high


def _count_times_out(name: str, value: object, usual: tuple[float, float]) -> float:
    """Return by what factor a value is above or below its usual range; 1 inside. Of gamma the horizon counts."""
    low, high = usual
    number = read_first_value(value)
    if number is None or number <= 0:
        return 1.0
    if name == _GAMMA:
        if number >= 1:  # rewards count up to the end of the episode
            return 1.0
        low, high, number = (_find_horizon(gamma) for gamma in (low, high, number))
    return max(1.0, number / high, low / number)


def read_first_value(setting: object) -> float | None:
    """Return the value of a hyperparameter at the beginning, also of a schedule such as `lin_3e-4`."""
    try:
        return float(str(setting).rpartition("_")[2])
    except ValueError:
        return None
