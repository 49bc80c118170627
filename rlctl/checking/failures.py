"""What a call into an environment raised, as plain data: when, where, and which file it could not find."""

import inspect
import linecache
import re
import sys
import sysconfig
import traceback
from collections.abc import Iterator
from pathlib import Path
from types import TracebackType
from typing import Any

from rlctl.checking.bullet_calls import LIBRARIES
from rlctl.checking.progress import CallProgress
from rlctl.checking.records import CallFailure
from rlctl.errors import RlctlError
from rlctl.version import PACKAGE_FOLDER

_HERE = Path(__file__).parent
NO_DISPLAY = re.compile(
    r"cannot connect to x server|could ?n.t connect to display|could not connect to display|no \$DISPLAY|"
    r"DISPLAY environment variable is missing|no available video device|cannot open display|"
    r"could not load the qt platform plugin|NoSuchDisplayException|failed to open display",
    re.IGNORECASE,
)
"""What X11, PyBullet, GLFW, pygame, Qt, Tk and pyglet print where there is no display."""
_LIBRARY = re.compile(
    rf"^<|^{re.escape(sysconfig.get_path('stdlib'))}/(?!site-packages|dist-packages)|"
    rf"(site|dist)-packages/({'|'.join(LIBRARIES)})(/|\\.)"
)
"""Files of Python itself and of libraries: an exception there comes from a wrong call in the environment."""
_MODEL = re.compile(r"[^\n]+\.(urdf|sdf|xml|mjcf|obj|stl|dae|vtk|png|jpg|bullet)", re.IGNORECASE)


class EnvironmentRaised(Exception):
    """A call into the environment raised; `__cause__` is what."""

    def __init__(self, call: str) -> None:
        super().__init__(call)
        self.call = call


def describe_failure(error: EnvironmentRaised, progress: CallProgress) -> CallFailure:
    """Describe what a call into the environment raised, and when."""
    at, cause = progress.read(), error.__cause__ or error
    place = (error.call, at.phase, at.episode, at.seed, at.step)
    trace, file = "".join(traceback.format_exception(cause)), find_missing_file(cause)
    return CallFailure("raised", *place, describe(cause), trace, file, find_line(cause))


def describe(error: BaseException) -> str:
    """Return an exception in a line, with the place in the environment's code."""
    if isinstance(error, RlctlError):  # of the task layer, which names the task and the step itself
        return f"{type(error).__name__}: {error}"
    where = find_line(error)
    place = f" ({Path(where[0]).name}:{where[1]})" if where else ""
    text = " ".join(str(error).split()) or "no message"
    return f"{type(error).__name__}: {text}{place}"


def find_line(error: BaseException) -> tuple[str, int] | None:
    """Return file and line of the environment's own code that an exception went through last, not a library's."""
    trace = traceback.extract_tb(error.__traceback__)
    frames = [frame for frame in trace if PACKAGE_FOLDER not in Path(frame.filename).parents]
    own = [frame for frame in frames if not _LIBRARY.search(frame.filename)] or frames
    return (own[-1].filename, own[-1].lineno or 1) if own else None


def lacks_display(failure: CallFailure) -> bool:
    """Say whether a process ended because it has no display."""
    return failure.kind == "died" and NO_DISPLAY.search(failure.details or "") is not None


def find_missing_file(error: BaseException | None) -> dict[str, Any] | None:
    """Describe the file behind an exception, or behind what caused it; None if it is about something else."""
    for cause in iterate_causes(error):
        if isinstance(cause, FileNotFoundError):
            return _describe(str(cause.filename or cause), [])
        if type(cause).__module__ == "pybullet" and "load" in str(cause).lower():
            name, data = _find_model(cause.__traceback__), sys.modules.get("pybullet_data")
            return None if name is None else _describe(name, [Path(data.getDataPath())] if data else [])
    return None


def iterate_causes(error: BaseException | None) -> Iterator[BaseException]:
    """Yield an exception and those behind it."""
    while error is not None:
        yield error
        error = error.__cause__ or error.__context__


def _describe(name: str, more: list[Path]) -> dict[str, Any]:
    searched = [] if Path(name).is_absolute() else [Path.cwd(), *more]
    return {"file": name, "searched": [str(folder) for folder in searched]}


def _find_model(trace: TracebackType | None) -> str | None:
    """Return the model that the failing call was given: a text in its source, or the value of a name there."""
    calls = list(zip(traceback.walk_tb(trace), traceback.extract_tb(trace), strict=True))
    calls = [pair for pair in calls if _HERE not in Path(pair[1].filename).parents]
    if not calls:
        return None
    (frame, _), summary = calls[-1]
    lines = linecache.getlines(summary.filename)[(summary.lineno or 1) - 1 : summary.end_lineno]
    source = "".join(lines)
    texts = re.findall(r"[\"']([^\"']+)[\"']", source)
    for name in re.findall(r"[a-zA-Z_][\w.]*", source):
        root, *attributes = name.split(".")
        value = frame.f_locals.get(root, frame.f_globals.get(root))
        for attribute in attributes:
            value = inspect.getattr_static(value, attribute, None)  # runs no code of the environment
        texts += [str(value)] if isinstance(value, (str, Path)) else []
    return next((text for text in texts if _MODEL.fullmatch(text) and not Path(text).is_file()), None)
