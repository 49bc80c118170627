"""`rlctl train`: trains a policy, evaluates as it goes, keeps the best and the last. `rlctl.train(...)` from Python."""

from __future__ import annotations

import sys
import types
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rlctl.train.request import TrainResult


class _TrainModule(types.ModuleType):
    """A module that can be called: `rlctl.train` is this package as soon as one of its modules is imported."""

    def __call__(self, task: str, /, **options: Any) -> TrainResult:
        from rlctl.python_api import train

        return train(task, **options)


sys.modules[__name__].__class__ = _TrainModule
