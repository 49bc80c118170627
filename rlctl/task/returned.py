"""Errors about what the methods of a task returned."""

import math
import numbers
from collections.abc import Mapping
from typing import Any

from rlctl.errors import TaskError, short_repr


class WrongRow(Exception):
    """What a task returned for one of the rows is wrong; the last `{}` in the message stands for the step."""

    def __init__(self, message: str, row: int = 0) -> None:
        super().__init__(message)
        self.row = row


def not_by_name(task: str, method: str, value: Any) -> TaskError:
    """Return the error for a method that returned anything but a dict."""
    return TaskError(f"{task}: {method}() returned {short_repr(value)}, not a dict of values by name: {{'speed': ...}}")


def not_a_number(raw: Mapping[str, Any]) -> WrongRow:
    """Return the error for a reward term that is not a number."""
    name = next((name for name, value in raw.items() if not isinstance(value, numbers.Real)), "sum")
    return WrongRow(f"reward term {name!r} is {short_repr(raw.get(name))} at step {{}}, not a number")


def reward_not_finite(weighted: Mapping[str, float], reward: float, row: int = 0) -> WrongRow:
    """Return the error for a reward that is not finite, with the first of its weighted terms that is not."""
    name = next((name for name, term in weighted.items() if not math.isfinite(term)), "sum")
    return WrongRow(f"reward term {name!r} is {weighted.get(name, reward)} at step {{}}", row)


def term_mismatch(task: str, raw: Mapping[str, float], weights: Mapping[str, float]) -> TaskError:
    """Return the error for reward terms and weights of different names."""
    problems = [f"rewards() returns {name!r}, which has no weight" for name in raw if name not in weights]
    problems += [f"reward_weights has {name!r}, which rewards() does not return" for name in weights if name not in raw]
    return TaskError(f"{task}: {problems[0]}")
