"""Importing a task into this process without letting it change more than itself."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator

import numpy as np


@contextlib.contextmanager
def preserve_process_state() -> Iterator[None]:
    """Restore what importing somebody's module may change and a training relies on.

    That is the working directory, what numpy does about overflows, and the permissions of new files. Signal handlers
    are set anew when the training begins.
    """
    mask = os.umask(0o077)
    os.umask(mask)
    try:
        with contextlib.chdir("."), np.errstate():
            yield
    finally:
        os.umask(mask)
