"""Values of any kind as what JSON can hold."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from typing import Any

import numpy as np


def to_plain(value: Any) -> Any:
    """Return a value as plain data: numbers, text, lists, mappings; anything else as the text Python has for it."""
    if value is None or isinstance(value, str | bool | int):
        return value
    if isinstance(value, float):
        return value if math.isfinite(value) else str(value)
    if isinstance(value, np.ndarray | np.generic):
        return to_plain(value.tolist())
    if isinstance(value, Mapping):
        return {str(key): to_plain(each) for key, each in value.items()}
    if isinstance(value, list | tuple | set | frozenset):
        return [to_plain(each) for each in value]
    if hasattr(value, "model_dump"):  # of pydantic
        return value.model_dump(mode="json", by_alias=True, exclude_defaults=True)
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {field.name: to_plain(getattr(value, field.name)) for field in dataclasses.fields(value)}
    return getattr(value, "__name__", None) or repr(value)


def lowest(bounds: Any) -> float | None:
    """Return the lowest of some lower bounds; None if an element is unbounded, or there is none."""
    return _keep_finite(np.min(bounds)) if np.size(bounds) else None


def highest(bounds: Any) -> float | None:
    """Return the highest of some upper bounds; None if an element is unbounded, or there is none."""
    return _keep_finite(np.max(bounds)) if np.size(bounds) else None


def _keep_finite(value: Any) -> float | None:
    return float(value) if math.isfinite(value) else None
