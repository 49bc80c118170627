"""Commands of plugins: the entry points of the group `rlctl.commands`, each imported when it is called."""

from __future__ import annotations

import dataclasses
import importlib
from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING, Any

from rlctl.entry_points import OURS, EntryPoint, call_in_child, list_entry_points
from rlctl.errors import RlctlError, TaskError, describe_exception, find_plugin_line, format_plugin_traceback

if TYPE_CHECKING:
    import typer

    from rlctl.tasks.listing import ListedCommand

GROUP = "rlctl.commands"

_reserved: set[str] = set()
"""The names of rlctl's own commands."""


def reserve(names: Iterable[str]) -> None:
    """Refuse these names to plugins."""
    _reserved.update(names)


@dataclasses.dataclass(frozen=True)
class CommandEntry(EntryPoint):
    """A command of a plugin, as its distribution declares it: a function with options of Typer, or a `typer.Typer`."""

    what = "command"
    form = "package.module:function"

    @property
    def title(self) -> str:
        """What messages call it: `command 'greet' of my-robots 1.0`."""
        return f"command {self.name!r} of {self.distribution} {self.version}"

    @property
    def is_ours(self) -> bool:
        """Whether it comes with rlctl."""
        return self.distribution in OURS


def list_commands() -> list[CommandEntry]:
    """Return every command of a plugin, sorted by name; its `problem` if it has a reserved name, among others."""
    entries = list_entry_points(GROUP, CommandEntry)
    return [_mark_reserved(entry) if entry.name in _reserved else entry for entry in entries]


def _mark_reserved(entry: CommandEntry) -> CommandEntry:
    return dataclasses.replace(entry, problem=entry.problem or entry.describe_taken("rlctl"))


def find(name: str) -> CommandEntry | None:
    """Return the command with this name, or None. That of several which can be called comes first."""
    return next((entry for entry in list_entry_points(GROUP, CommandEntry) if entry.name == name), None)


def load(entry: CommandEntry) -> Callable[..., None] | typer.Typer:
    """Import a command. Raises `TaskError` for its problem, and for any exception of the import."""
    if entry.problem:
        raise TaskError(f"{entry.title}: {entry.problem}")
    return import_target(entry.target, entry.title)


def describe_all(*, check: bool) -> list[ListedCommand]:
    """Describe every command of a plugin for `rlctl tasks`; `check` imports each in a child process."""
    from rlctl.tasks.listing import ListedCommand

    listed = []
    for entry in list_commands():
        problem = entry.problem
        if check and problem is None:
            problem = call_in_child(__name__, "import_target", entry.target)
        summary = "" if problem else entry.summary
        declared = entry.name, entry.target, entry.distribution, entry.version
        listed.append(ListedCommand(*declared, summary, problem))
    return listed


def import_target(target: str, title: str = "") -> Any:
    """Import `package.module:function`. Raises `TaskError`, which begins with `title`, for any exception."""
    module, _, names = target.partition(":")
    try:
        found: Any = importlib.import_module(module)
        for name in names.split("."):
            found = getattr(found, name)
    except (RlctlError, KeyboardInterrupt):
        raise
    except BaseException as error:
        raise _describe(error, module.partition(".")[0], f"{title or target}: import failed: ") from error
    if not callable(found):
        raise TaskError(f"{title or target}: {target} is no function")
    return found


def explain_failure(name: str, error: Exception) -> None:
    """Raise `TaskError` for an exception in a command that is not rlctl's own, which is no bug in rlctl."""
    entry = find(name)
    is_known = isinstance(error, OSError) or hasattr(error, "format_message")  # Typer's, about the arguments
    if entry is not None and not entry.is_ours and not is_known:
        raise _describe(error, entry.module.partition(".")[0], f"{entry.title}: ") from error


def _describe(error: BaseException, package: str, beginning: str) -> TaskError:
    """Describe an exception, with a traceback that begins at the first line of the plugin's package that ran."""
    frames = error.__traceback__
    while frames is not None and str(frames.tb_frame.f_globals.get("__name__")).partition(".")[0] != package:
        frames = frames.tb_next
    if frames is not None:
        error = error.with_traceback(frames)
    text = describe_exception(error, find_plugin_line(error))
    return TaskError(beginning + text, details=format_plugin_traceback(error) or None)
