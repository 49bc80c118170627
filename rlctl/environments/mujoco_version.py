"""What to say where code that was written for another version of MuJoCo fails."""

import re
import sys
import traceback
from importlib import metadata
from pathlib import Path

from rlctl.errors import read_message
from rlctl.version import PACKAGE_FOLDER

PROVEN_OLDER = "3.8.1"
"""The older MuJoCo that rlctl is tested with; many packages were written for the versions up to it."""
_INSTALLED = re.compile(r"(?:site|dist)-packages/(\w+)")
_MENTIONS = re.compile(r"\bmujoco\b|\bmj[A-Z_]", re.IGNORECASE)
_OF_AN_API = (AssertionError, AttributeError, ImportError, KeyError, TypeError)
"""What Python raises where a library has other names or types than the code expects."""
_OF_PYTHON = re.compile(r"'(bool|dict|float|int|list|NoneType|set|str|tuple)' object has no attribute")


def mujoco_fix(error: BaseException) -> str:
    """Return what to try if an error comes from code that uses MuJoCo, with both versions; empty for other errors.

    Of the user's own code only those errors that another version of a library causes, in a line that uses MuJoCo.
    """
    if "mujoco" not in sys.modules:
        return ""
    frames = [frame for frame in traceback.extract_tb(error.__traceback__) if not _is_of_rlctl(frame.filename)]
    packages = [match[1] for frame in frames if (match := _INSTALLED.search(Path(frame.filename).as_posix()))]
    others = [package for package in packages if package not in ("mujoco", "gymnasium", "numpy")]
    uses_mujoco = "mujoco" in packages or any(_MENTIONS.search(frame.line or "") for frame in frames)
    mentions_mujoco = uses_mujoco or _MENTIONS.search(f"{type(error).__name__} {read_message(error)}") is not None
    version = metadata.version("mujoco")
    if others and mentions_mujoco:
        return f"{_name_distribution(others[-1])} may be written for another MuJoCo than {version}: {_advise(version)}"
    is_of_an_api = isinstance(error, _OF_AN_API) and _OF_PYTHON.match(read_message(error)) is None
    if is_of_an_api and frames and _MENTIONS.search(frames[-1].line or ""):
        return f"MuJoCo {version} is installed. If this was written for another version: {_advise(version)}"
    return ""


def _advise(version: str) -> str:
    numbers = [int(part) for part in re.findall(r"\d+", version)[:2]]
    is_older = numbers <= [int(part) for part in PROVEN_OLDER.split(".")[:2]]
    if is_older:
        return "pip install --upgrade mujoco"
    return f"pip install mujoco=={PROVEN_OLDER}"


def _name_distribution(package: str) -> str:
    """Return the distribution of an imported package and its version, and the MuJoCo that it asks for."""
    names = metadata.packages_distributions().get(package)
    if not names:
        return package
    asks = [line for line in metadata.requires(names[0]) or [] if re.match(r"mujoco\s*[<>=!~(]", line)]
    asked = f" (it asks for {asks[0].partition(';')[0].strip()})" if asks else ""
    return f"{names[0]} {metadata.version(names[0])}{asked}"


def _is_of_rlctl(file: str) -> bool:
    return PACKAGE_FOLDER in Path(file).parents
