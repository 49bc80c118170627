"""Importing a task into this process without letting it change more than itself."""

from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Iterator

import numpy as np


@contextlib.contextmanager
def preserve_process_state() -> Iterator[None]:
    """Restore what importing somebody's module may change and a training relies on.

    That is the working directory, the permissions of new files, and the defaults of numpy and torch. Signal handlers
    are set anew when the training begins.
    """
    mask = os.umask(0o077)
    os.umask(mask)
    printing = np.get_printoptions()
    try:
        with contextlib.chdir("."), np.errstate():
            yield
    finally:
        os.umask(mask)
        np.set_printoptions(**printing)
        _restore_torch()


def _restore_torch() -> None:
    """Reset torch's defaults, where a module has imported it: number type, device, gradients, determinism."""
    torch = sys.modules.get("torch")
    if torch is None:
        return
    torch.set_default_dtype(torch.float32)
    torch.set_default_device(None)
    torch.set_grad_enabled(True)
    if torch.are_deterministic_algorithms_enabled():  # to set it imports torch's compiler
        torch.use_deterministic_algorithms(False)
    torch.autograd.set_detect_anomaly(False)
