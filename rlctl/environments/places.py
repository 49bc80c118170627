"""Places in the code of an environment: which line of its author an exception comes from, and how to write it."""

import re
import sys
import sysconfig
import traceback
from pathlib import Path

from rlctl.environments.bullet_calls import LIBRARIES
from rlctl.version import PACKAGE_FOLDER

_LIBRARY = re.compile(
    rf"^<|^{re.escape(sysconfig.get_path('stdlib'))}/(?!site-packages|dist-packages)|"
    rf"(site|dist)-packages/({'|'.join(LIBRARIES)})(/|\\.)"
)
"""Files of Python itself and of libraries: an exception there comes from a wrong call in the environment."""


def is_own_file(file: str) -> bool:
    """Say whether a file belongs to the environment, not to rlctl, Python or a library."""
    if not Path(file).is_absolute():  # NumPy's compiled modules name a `_common.pyx`
        return False
    return PACKAGE_FOLDER not in Path(file).parents and _LIBRARY.search(file) is None


def find_line(error: BaseException) -> tuple[str, int] | None:
    """Return the last file and line of the environment's own package in a traceback; None if it has only libraries."""
    if isinstance(error, SyntaxError) and error.filename:
        return error.filename, error.lineno or 1
    own = [frame for frame in traceback.extract_tb(error.__traceback__) if is_own_file(frame.filename)]
    own = [frame for frame in own if _find_package(frame.filename) == _find_package(own[0].filename)]
    return (own[-1].filename, own[-1].lineno or 1) if own else None


def _find_package(file: str) -> str:
    installed = re.search(r"(?:site|dist)-packages/([^/]+)", file)
    return installed[1] if installed else ""


def format_place(file: str, line: int) -> str:
    """Return `file.py:12`; of a file that may have several of its name, `package/envs/__init__.py:12`."""
    path = Path(file)
    folder = path.parent
    while (folder / "__init__.py").is_file():
        folder = folder.parent
    return f"{path.relative_to(folder)}:{line}"


def describe_exception_place(error: BaseException) -> str:
    """Return ` (file.py:12)`, the line of the environment's author behind an exception; empty if there is none."""
    where = None if isinstance(error, SyntaxError) else find_line(error)  # a syntax error names its place
    return f" ({format_place(*where)})" if where else ""


def describe_caller() -> str:
    """Return `, file.py:12`, the line of the environment's author that is being executed; empty if there is none."""
    frame = sys._getframe(1)
    while frame is not None:
        if is_own_file(frame.f_code.co_filename):
            return f", {format_place(frame.f_code.co_filename, frame.f_lineno)}"
        frame = frame.f_back  # type: ignore[assignment]
    return ""
