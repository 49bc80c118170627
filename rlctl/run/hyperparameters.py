"""Where the numbers of `algo_kwargs` make sense, by SB3's names."""

from __future__ import annotations

import dataclasses
import math
from typing import Any


@dataclasses.dataclass(frozen=True)
class Range:
    """Where a numeric hyperparameter makes sense; `text` values such as SAC's `auto` pass where allowed."""

    low: float
    high: float = math.inf
    integer: bool = False
    text: tuple[str, ...] = ()
    open_low: bool = False
    with_unit: bool = False
    """Also as SB3's pair of a number and a unit, such as [1, episode]."""

    def check(self, name: str, value: Any) -> None:
        """Raise `ValueError`, which names the parameter and the range, for a value outside it."""
        if self.with_unit and isinstance(value, list) and value:
            value = value[0]
        if isinstance(value, str) and value.startswith(self.text or ("\0",)):
            return
        kind = "a whole number" if self.integer else "a number"
        good = isinstance(value, int | float) and not isinstance(value, bool)
        if good and self.integer:
            good = float(value).is_integer()
        if not good:
            raise ValueError(f"{name}: expected {kind}, got {value!r}")
        if not (self.low < value if self.open_low else self.low <= value) or not value <= self.high:
            raise ValueError(f"{name}: {value} is not in {self}")

    def __str__(self) -> str:
        return f"{'(' if self.open_low else '['}{self.low:g}, {self.high:g}]"


_COUNT = Range(1, integer=True)
_FRACTION = Range(0, 1)
_PART = Range(0, 1, open_low=True)
RANGES = {
    "learning_rate": Range(0, 1, text=("lin_",), open_low=True),
    "n_steps": _COUNT,
    "batch_size": Range(2, integer=True),
    "n_epochs": _COUNT,
    "gamma": _PART,
    "gae_lambda": _FRACTION,
    "clip_range": Range(0, 10, text=("lin_",), open_low=True),
    "ent_coef": Range(0, text=("auto",)),
    "vf_coef": Range(0),
    "max_grad_norm": Range(0, open_low=True),
    "target_kl": Range(0, open_low=True),
    "buffer_size": _COUNT,
    "learning_starts": Range(0, integer=True),
    "train_freq": Range(1, integer=True, with_unit=True),
    "gradient_steps": Range(-1, integer=True),
    "tau": _PART,
    "target_update_interval": _COUNT,
    "policy_delay": _COUNT,
    "exploration_fraction": _FRACTION,
    "exploration_initial_eps": _FRACTION,
    "exploration_final_eps": _FRACTION,
    "top_quantiles_to_drop_per_net": Range(0, integer=True),
}
