"""Robot learning in simulation, end to end: check an environment, train, evaluate, export, replay.

From Python: `rlctl.make`, `check_env`, `train`, `evaluate`, `load_policy`. `docs/architecture.md` explains the folders.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from rlctl.version import __version__

if TYPE_CHECKING:
    from rlctl.api import check_env, evaluate, load_policy, make, train
    from rlctl.training.callbacks import Callback

__all__ = ["Callback", "__version__", "check_env", "evaluate", "load_policy", "make", "train"]

_DEFINED_IN = {
    **dict.fromkeys(("check_env", "evaluate", "load_policy", "make", "train"), "rlctl.api"),
    "Callback": "rlctl.training.callbacks",
}


def __getattr__(name: str) -> Any:
    # Lazy, so that `import rlctl` and the command line load neither gymnasium nor torch.
    if name not in _DEFINED_IN:
        raise AttributeError(f"module 'rlctl' has no attribute {name!r}")
    import importlib

    return getattr(importlib.import_module(_DEFINED_IN[name]), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
