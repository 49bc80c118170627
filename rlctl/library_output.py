"""What Python, libraries and environments print in this process: whole lines, warnings of one line, no noise."""

import contextlib
import functools
import os
import re
import sys
import warnings
from collections.abc import Callable, Iterator
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec, PathFinder
from typing import Any

from rlctl.printed_lines import current, print_line, remove_escape_codes


@contextlib.contextmanager
def redirect_stdout() -> Iterator[None]:
    """Take what this process writes to its stdout as lines; a command's results have a stream of their own."""
    if (printed := current()) is None:
        yield
        return
    reader = printed.open_reader()
    try:
        with _replaced(1, reader.descriptor):
            reader.close_descriptor()
            print_whole_lines()
            sys.meta_path.insert(0, _QuietFinder)
            try:
                yield
            finally:
                _flush()
                sys.meta_path.remove(_QuietFinder)
    finally:
        reader.wait()


@contextlib.contextmanager
def _replaced(descriptor: int, by: int) -> Iterator[None]:
    before = os.dup(descriptor)
    os.dup2(by, descriptor)
    try:
        yield
    finally:
        os.dup2(before, descriptor)
        os.close(before)


def _flush() -> None:
    with contextlib.suppress(OSError, ValueError, AttributeError):  # replaced or closed by an environment
        sys.stdout.flush()
    if (ctypes := sys.modules.get("ctypes")) is not None:  # without it nothing was loaded that prints
        ctypes.CDLL(None).fflush(None)


class _QuietFinder(MetaPathFinder):
    """Lets PyBullet be imported without the line that it prints to stderr, where this process prints itself."""

    @classmethod
    def find_spec(cls, name: str, path: Any = None, target: Any = None) -> ModuleSpec | None:
        spec = PathFinder.find_spec(name, path) if name == "pybullet" else None
        if spec is not None and spec.loader is not None:
            loader: Any = spec.loader
            loader.create_module = functools.partial(cls._create_quietly, loader.create_module)
        return spec

    @staticmethod
    def _create_quietly(create: Callable[[ModuleSpec], Any], spec: ModuleSpec) -> Any:
        with open(os.devnull, "wb") as nowhere, _replaced(2, nowhere.fileno()):
            return create(spec)


def print_whole_lines() -> None:
    """Let Python and C libraries write each line of this process at once, and a warning of Python as one line."""
    with contextlib.suppress(OSError, ValueError, AttributeError):
        sys.stdout.reconfigure(line_buffering=True)  # type: ignore[union-attr]
    warnings.showwarning = _show_warning
    if (ctypes := sys.modules.get("ctypes")) is not None:
        libc, line_buffered, size = ctypes.CDLL(None), 1, 4096
        with contextlib.suppress(ValueError):  # the C library calls it otherwise
            libc.setvbuf(ctypes.c_void_p.in_dll(libc, "stdout"), None, line_buffered, size)


def _show_warning(
    message: Any, category: type[Warning], filename: str, lineno: int, file: Any = None, line: str | None = None
) -> None:
    text = remove_escape_codes(" ".join(str(message).split()))  # Gymnasium's are colored
    filename = re.sub(r"^.*/(?:site|dist)-packages/", "", filename)
    print_line(f"{filename}:{lineno}: {category.__name__}: {text}")


def print_mujoco_warnings() -> None:
    """Print MuJoCo's warnings, which it otherwise appends to `MUJOCO_LOG.TXT` in the current folder."""
    mujoco: Any = sys.modules.get("mujoco")
    if mujoco is not None and mujoco.get_mju_user_warning() is None:
        mujoco.set_mju_user_warning(lambda text: print_line(f"MuJoCo warning: {text}"))
