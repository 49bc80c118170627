"""What came back from an environment that is not trusted, as plain data."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlctl.check_env.leaves import Leaf, pick

NUMBERS = (bool, int, float, np.bool_, np.integer, np.floating)


def flat_action(leaves: list[Leaf], action: Any) -> NDArray[np.float64]:
    """Return an action's numbers in the order of the action space's leaves; those of unknown kinds are left out."""
    parts = [np.ravel(pick(action, leaf.path)).astype(np.float64) for leaf in leaves if leaf.supported]
    return np.concatenate(parts) if parts else np.zeros(0)


def numbers_in(info: dict[Any, Any]) -> Iterator[tuple[str, float]]:
    """Yield the numbers of an info by name; those in a dictionary of it as `reward_terms/distance`."""
    for key, value in info.items():
        if isinstance(value, dict):
            for name, inner in value.items():
                if _is_number(inner):
                    yield f"{key}/{name}", float(inner)
        elif _is_number(value):
            yield str(key), float(value)


def _is_number(value: Any) -> bool:
    """Whether it is a number, or an array without axes, which some libraries make of a comparison."""
    return isinstance(value, NUMBERS) or (
        isinstance(value, np.ndarray) and value.shape == () and value.dtype.kind in "biuf"
    )


def type_name(value: Any) -> str:
    """Return a type as a user would write it: `numpy.bool`, `list`."""
    kind = type(value)
    return kind.__qualname__ if kind.__module__ == "builtins" else f"{kind.__module__}.{kind.__qualname__}"


def truth(flag: Any) -> bool:
    """Return what a flag means, whatever its type; False for what has no truth."""
    if isinstance(flag, bool):  # nearly always; asking numpy takes a tenth of a robot's step
        return flag
    try:
        return bool(np.any(flag))
    except Exception:  # its type is noted, and is a finding
        return False
