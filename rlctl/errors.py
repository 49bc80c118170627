"""The exceptions of rlctl, with their exit codes, and helpers for their messages."""

import contextlib
import difflib
import importlib
import importlib.util
import re
import shlex
import traceback
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

from rlctl.missing_packages import advise, name_package

_LONGEST = 400  # [characters] of another library's message
_MOST_FRAMES = 40  # of a plugin's traceback: an endless recursion has a thousand
_OURS = Path(__file__).parent
_OUR_COMMANDS = "rlctl_robot"  # a package of commands that comes with rlctl
_IMPORTLIB = Path(importlib.__file__).parent


class RlctlError(Exception):
    """An error that is explained to the user in one to three lines; never a traceback.

    `details` is text that a report may show below the message, such as a plugin's own traceback.
    """

    exit_code = 70

    def __init__(self, message: str, *, details: str | None = None) -> None:
        super().__init__(message)
        self.details = details


class AnswerIsNo(RlctlError):
    """The command worked and its result is negative: a check failed, a gate was missed, a replay differed."""

    exit_code = 1


class UsageError(RlctlError):
    """The request names something that does not exist, or that this task does not support."""

    exit_code = 2


class RunTaken(UsageError):
    """Another process writes this run; the exit code is `EX_TEMPFAIL`, so that schedulers try again later."""

    exit_code = 75


class NoSuchClassError(UsageError):
    """A module was imported and does not define the requested class."""


class OldGymError(UsageError):
    """An id is registered with the old gym, not with Gymnasium, or a space is the old gym's."""


class RecipeError(UsageError):
    """A recipe or a `--set` has an unknown key, a wrong type or a value out of range."""


class TaskError(RlctlError):
    """The task or its plugin failed: import error, exception, crash, hang, or values that are not finite."""

    exit_code = 3


class WorldFailed(TaskError):
    """One of the worlds that are simulated together failed; `world` is its index, 0 for a single one."""

    def __init__(self, message: str, world: int = 0, *, details: str | None = None) -> None:
        super().__init__(message, details=details)
        self.world = world


class NoDisplayError(TaskError):
    """The environment opens a window, and there is no display."""


class ShapeError(TaskError):
    """A method of a `BatchTask` did not return a row per world."""


@contextlib.contextmanager
def in_world(world: int) -> Iterator[None]:
    """Note in any exception which of the worlds that are simulated together it is about, as `WorldFailed.world`."""
    try:
        yield
    except Exception as error:
        if not hasattr(error, "world"):
            error.world = world  # type: ignore[attr-defined]
        raise


class PolicyError(TaskError):
    """A policy that is a user's function raised an exception, or returned something that is not an action."""


PLAY_OTHERS = (
    "To play another project's policy of a walking robot: rlctl eval POLICY --deploy FILE --model ROBOT; "
    "any other: call it in a function act(observation): rlctl eval TASK --policy FILE.py:act"
)
"""What refusals of a foreign file advise."""


class EpisodeFailed(TaskError):
    """An environment failed in an episode; `hint` says how to reproduce it."""

    def __init__(self, what: str, env: int, seed: int, step: int, *, hint: str, details: str | None = None) -> None:
        super().__init__(f"{what}\nin environment {env}, episode seed {seed}, step {step}; {hint}", details=details)
        self.what, self.env, self.seed = what, env, seed
        self.step = step  # number of the failed step, from 1; 0 for the reset
        self.actions: Any = None
        """The actions of the episode up to the failed step, shape (step, ...); None if they are unknown."""

    def with_hint(self, hint: str) -> "EpisodeFailed":
        """Return the same error with another hint."""
        return EpisodeFailed(self.what, self.env, self.seed, self.step, hint=hint, details=self.details)


class DivergedError(RlctlError):
    """Training produced losses or weights that are not finite."""

    exit_code = 4


class ArtifactError(RlctlError):
    """A file is missing, damaged, not from rlctl, or for other spaces."""

    exit_code = 5


class Interrupted(RlctlError):
    """A signal ended the run, which was saved; the exit code is 128 + the signal's number."""

    def __init__(self, message: str, signal_number: int) -> None:
        super().__init__(message)
        self.exit_code = 128 + signal_number


def read_message(error: BaseException) -> str:
    """Return the message of any exception; one whose `__str__` raises has one that says so."""
    try:
        return str(error)
    except Exception as another:
        return f"(message unavailable: {type(another).__name__})"


def name_kind(error: BaseException) -> str:
    """Return the name of an exception's type; an error of one of the worlds is a `TaskError` to all but rlctl."""
    return (TaskError if isinstance(error, WorldFailed) else type(error)).__name__


def describe_exception(error: BaseException, where: str = "") -> str:
    """Describe any exception in one line of limited length: `RuntimeError: the gripper fell off`.

    `where` comes after it, and last what to install for a module that is missing.
    """
    name, text = name_kind(error), " ".join(read_message(error).split())
    if len(text) > _LONGEST:
        text = f"{text[:_LONGEST]}..."
    # Python decodes file names that are not UTF-8 to surrogates, which cannot be written as UTF-8.
    text = text.encode(errors="backslashreplace").decode()
    return f"{name}: {text}{where}{advise(error)}" if text else f"{name}{where}"


def format_plugin_traceback(error: BaseException) -> str:
    """Return a traceback that begins at the first frame outside rlctl; empty if there is none."""
    frames = error.__traceback__
    while frames is not None and not _is_plugin_file(frames.tb_frame.f_code.co_filename):
        frames = frames.tb_next
    if frames is None and not isinstance(error, SyntaxError):  # its message names the line
        return ""
    return "".join(traceback.format_exception(type(error), error, frames, limit=-_MOST_FRAMES))


def find_plugin_line(error: BaseException) -> str:
    """Return ` (FILE, line N)` of the last line that ran in the first file outside rlctl; empty if there is none."""
    frames = [frame for frame in traceback.extract_tb(error.__traceback__) if _is_plugin_file(frame.filename)]
    own = [frame for frame in frames if frame.filename == frames[0].filename]
    return f" ({Path(own[-1].filename).name}, line {own[-1].lineno})" if own else ""


def _is_plugin_file(file: str) -> bool:
    if file.startswith("<frozen importlib"):
        return False
    if _OUR_COMMANDS in Path(file).parts:
        return False
    return not any(Path(file).is_relative_to(folder) for folder in (_OURS, _IMPORTLIB))


def did_you_mean(word: str, options: Iterable[str], otherwise: str = "") -> str:
    """Return " Did you mean 'reach'?" for the option closest to `word`, else an empty string.

    An option that differs in case only, or whose initials are the word (`lr`: `learning_rate`), is the closest. With
    `otherwise`, what is meant where no option is nearly the same.
    """
    options = list(options)
    same = [option for option in options if option.lower() == word.lower()]
    same += [option for option in options if "_" in option and _take_initials(option) == word]
    if same:
        return f" Did you mean {same[0]!r}?"
    close = difflib.get_close_matches(word, options, n=1, cutoff=0.7 if otherwise else 0.5)
    close = close or [otherwise] * bool(otherwise)
    return f" Did you mean {close[0]!r}?" if close else ""


def _take_initials(name: str) -> str:
    return "".join(part[:1] for part in name.split("_"))


def check_name(
    name: Any,
    known: Iterable[str],
    no_such: str,
    error: type[RlctlError],
    *,
    listed: str = "It has",
    none: str = "none",
) -> None:
    """Raise `error` if a name is unknown: `no_such`, the name, the closest known name, all known names."""
    if name not in (names := list(known)):
        known_names = short_repr(", ".join(names) or none, 300)
        raise error(f"{no_such} {short_repr(name)!r}.{did_you_mean(str(name), names)} {listed}: {known_names}.")


def explain_missing_package(user: str, missing: str | None, extra: str) -> str:
    """Return `USER needs MISSING: pip install 'rlctl[EXTRA]'`, for the distribution that is installed."""
    is_core = _read_requirements("rlctl") is None and _read_requirements("rlctl-core") is not None
    install = shlex.quote(f"{'rlctl-core' if is_core else 'rlctl'}[{extra}]")
    return f"{user} needs {missing}: pip install {install}"


def explain_left_out(module: str | None) -> str | None:
    """Return what to do about a missing module that rlctl imports; None for one that it does not require.

    `rlctl-core` leaves some out; what `rlctl` requires may have been removed later, or never installed.
    """
    needed = (module or "").partition(".")[0]
    core, complete = _read_requirements("rlctl-core"), _read_requirements("rlctl")
    if complete is None and core is not None:
        extra = re.compile(rf"""{re.escape(needed)}\b.*;.*extra == ['"](\w+)['"]""")
        extras = [match[1] for line in core if (match := extra.match(line))]
        package = shlex.quote(f"rlctl-core[{extras[0]}]") if extras else "rlctl"
        return f"this needs {needed}, which is not part of rlctl-core: pip install {package}"
    if not needed or importlib.util.find_spec(needed) is not None:
        return None  # a module in an installed package
    named = re.compile(rf"{re.escape(name_package(needed))}(?![\w.-])", re.IGNORECASE)
    required = [line.partition(";")[0] for line in (*(complete or ()), *(core or ())) if "extra ==" not in line]
    missing = next((line.strip() for line in required if named.match(line)), None)
    if missing is None:
        return None
    return f"this needs {needed}, which is not installed here: pip install {shlex.quote(missing)}"


def _read_requirements(distribution: str) -> list[str] | None:
    """Return what an installed distribution requires; None if it is not installed."""
    from importlib import metadata

    try:
        return metadata.requires(distribution) or []
    except metadata.PackageNotFoundError:
        return None


def short_repr(value: object, length: int = 80) -> str:
    """Return a text, or the `repr` of any other value, as one line of at most `length` characters."""
    try:
        text = value if isinstance(value, str) else repr(value)
    except (ValueError, RecursionError):  # a number with thousands of digits; an object that contains itself
        text = f"a {type(value).__name__} without a repr"
    text = " ".join(text.split())
    return text if len(text) <= length else f"{text[: length - 3]}..."
