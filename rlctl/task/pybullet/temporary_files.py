"""Gives PyBullet a text as a file."""

import contextlib
import hashlib
import os
import secrets
import shutil
import tempfile
import threading
from collections.abc import Iterator
from pathlib import Path

_PROCESS = secrets.token_hex(8)
_lock = threading.Lock()


@contextlib.contextmanager
def write_temporary(text: str, name: str) -> Iterator[Path]:
    """Write a text to a file called `name`, for the duration of a `with` block.

    PyBullet keeps all that it has read in memory, by path. So a text has one path in a process, and no two texts have
    the same.
    """
    digest = hashlib.sha256(text.encode()).hexdigest()[:16]
    folder = Path(tempfile.gettempdir()) / f"rlctl-{_PROCESS}-{os.getpid()}-{digest}"  # a fork has its own
    with _lock:
        folder.mkdir(mode=0o700)
        try:
            (folder / name).write_text(text, encoding="utf-8")
            yield folder / name
        finally:
            shutil.rmtree(folder)
