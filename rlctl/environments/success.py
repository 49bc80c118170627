"""Where an environment reports in `info` whether its task is done."""

from collections.abc import Mapping
from typing import Any

import numpy as np

SUCCESS = "is_success"
"""The name of success in `info`, as Stable-Baselines3 has it."""
OTHER_SUCCESS = "success"
"""The name that Adroit, Meta-World and robosuite use. It counts where `is_success` is missing."""


def find_success(info: Mapping[str, Any]) -> Any:
    """Return what an `info` says about success, as it is there; None if it says nothing.

    `success` may mean anything in an environment that does not report `is_success`: it counts if it is a bool, 0 or 1.
    """
    success = info.get(SUCCESS)
    if success is not None:
        return success
    other = info.get(OTHER_SUCCESS)
    return other if other is not None and is_flag(other) else None


def is_flag(value: Any) -> bool:
    """Return whether a value is a bool, or one number that is 0 or 1."""
    if isinstance(value, np.ndarray):
        return value.size == 1 and value.dtype.kind in "biuf" and is_flag(value.item())
    return isinstance(value, bool | int | float | np.number | np.bool_) and value in (0, 1)
