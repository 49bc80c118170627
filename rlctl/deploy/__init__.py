"""After export: a safety filter and a policy server. Both use NumPy, not torch."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rlctl.deploy.filter.bounds import SafetyEvent
    from rlctl.deploy.filter.limits import Limits, read_limits
    from rlctl.deploy.filter.safety_filter import SafetyFilter

__all__ = ["Limits", "SafetyEvent", "SafetyFilter", "read_limits"]

_MODULES = {"Limits": "limits", "SafetyEvent": "bounds", "SafetyFilter": "safety_filter", "read_limits": "limits"}


def __getattr__(name: str) -> Any:
    # On first use: `rlctl serve --help` needs no NumPy.
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"rlctl.deploy.filter.{_MODULES[name]}"), name)
