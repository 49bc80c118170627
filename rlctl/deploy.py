"""Limits for policies on robots, and the safety filter that keeps them. Both use NumPy, not torch."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rlctl.limits.bounds import SafetyEvent
    from rlctl.limits.limits import Limits, read_limits
    from rlctl.limits.safety_filter import SafetyFilter

__all__ = ["Limits", "SafetyEvent", "SafetyFilter", "read_limits"]

_MODULES = {"Limits": "limits", "SafetyEvent": "bounds", "SafetyFilter": "safety_filter", "read_limits": "limits"}


def __getattr__(name: str) -> Any:
    # On first use: `rlctl serve --help` needs no NumPy.
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"rlctl.limits.{_MODULES[name]}"), name)
