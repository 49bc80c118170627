"""The command line. A function per command parses the arguments, calls one function and prints the result.

Each command imports what it needs when it runs, so that help, lists and completion start fast.
"""

import contextlib
import itertools
import sys
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Annotated, Any

import typer
from typer.core import TyperCommand, TyperGroup

from rlctl.cli import demo, eval, export, gate, plugin_commands, runs, tasks, train
from rlctl.errors import AnswerIsNo, RlctlError, UsageError
from rlctl.processes import error_boundary
from rlctl.version import __version__


def _print_version(requested: bool) -> None:
    if requested:
        print(f"rlctl {__version__}")
        raise typer.Exit


def _root(
    version: Annotated[
        bool, typer.Option("--version", help="Print the version and exit.", callback=_print_version, is_eager=True)
    ] = False,
) -> None:
    pass


Commands = dict[str, Callable[..., None] | typer.Typer]

GROUPS: dict[str, Commands] = {
    "Learn": {
        "check-env": tasks.check_env,
        "train": train.train,
        "distill": train.distill,
        "tune": train.tune,
    },
    "Judge": {
        "eval": eval.evaluate,
        "runs": runs.app,
        "gate": gate.gate,
    },
    "Show": {
        "replay": eval.replay,
        "demo": demo.demo,
    },
    "Robot": {
        "export": export.export,
    },
    "Tools": {
        "tasks": tasks.app,
        "recipe": tasks.recipe,
        "push": export.push,
        "bugreport": runs.report_bug,
    },
}
"""The commands by what they are for, as the help shows them."""

COMMANDS: Commands = {name: command for group in GROUPS.values() for name, command in group.items()}
_PANELS = {name: panel for panel, group in GROUPS.items() for name in group}

plugin_commands.reserve(COMMANDS)

_CLASSES = {"check-env": tasks.CheckCommand, "replay": eval.ReplayCommand}  # that read arguments in their own way


class UnloadedCommand(TyperCommand):
    """Stands for a command of a plugin that is not imported yet."""


class RootCommand(TyperGroup):
    """Imports the command of a plugin when it is called or its options are completed: before, it has a summary only."""

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        """Return the name and the command of the first argument, and the other arguments."""
        name, command, left = super().resolve_command(ctx, args)
        if not isinstance(command, UnloadedCommand):
            return name, command, left
        try:
            group = typer.main.get_command(build_app([str(command.name)]))
        except RlctlError:
            if ctx.resilient_parsing:  # the shell completes
                return name, command, left
            raise
        assert isinstance(group, TyperGroup)
        return name, group.commands[str(command.name)], left


def list_names() -> list[str]:
    """Return the names of all commands, last those of plugins."""
    return [*COMMANDS, *(entry.name for entry in plugin_commands.list_commands() if entry.problem is None)]


def build_app(names: Iterable[str] | None = None) -> typer.Typer:
    """Return the Typer app with the named commands, or with all; it imports those of plugins that are named.

    Raises `TaskError` for one that cannot be imported.
    """
    app = typer.Typer(
        name="rlctl",
        cls=RootCommand,
        help="Robot learning in simulation, end to end: check an environment, train, evaluate, export, replay.",
        no_args_is_help=True,
        pretty_exceptions_enable=False,
        context_settings={
            "help_option_names": ["-h", "--help"],
            # Typer passes names without the leading dashes.
            "token_normalize_func": lambda name: {"num-envs": "n-envs"}.get(
                name.replace("_", "-"), name.replace("_", "-")
            ),
        },
    )
    app.callback()(_root)
    for name in COMMANDS if names is None else names:
        command = COMMANDS[name] if name in COMMANDS else _load_of_plugin(name)
        if isinstance(command, typer.Typer):
            app.add_typer(command, name=name, rich_help_panel=_PANELS.get(name))
        else:
            app.command(name, cls=_CLASSES.get(name), rich_help_panel=_PANELS.get(name))(command)
    if names is None:
        for entry in plugin_commands.list_commands():
            if entry.problem is None:
                panel = "Robot" if entry.is_ours else f"Commands of {entry.distribution}"
                app.command(entry.name, cls=UnloadedCommand, help=entry.summary, rich_help_panel=panel)(_do_nothing)
    return app


def _load_of_plugin(name: str) -> Callable[..., None] | typer.Typer:
    entry = plugin_commands.find(name)
    assert entry is not None
    return plugin_commands.load(entry)


def _do_nothing() -> None:
    pass


def main() -> None:
    """Run the command line and end the process with its exit code."""
    error_boundary.prepare_streams()
    code = run(sys.argv[1:])
    error_boundary.limit_exit_handlers(code)
    sys.exit(code)


def run(arguments: list[str]) -> int:
    """Run a command line; return the exit code."""
    return error_boundary.run(lambda: _call(arguments))


def _call(arguments: list[str]) -> int:
    # Typer inspects the options of every command, which takes longer than most commands need to start.
    name = arguments[0] if arguments else ""
    is_one = name in COMMANDS or (name[:1].isalpha() and plugin_commands.find(name) is not None)
    try:
        app = build_app([name] if is_one else None)
        code = app(arguments, standalone_mode=False)
    except typer.Abort:  # the user cancelled a question
        raise KeyboardInterrupt from None
    except AnswerIsNo:  # the command has written its result
        raise
    except RlctlError as error:
        _present_failure(arguments, error)
        raise
    except Exception as error:
        option = getattr(error, "option_name", None)  # of Typer's error for an option that does not exist
        if (
            option is not None
            and arguments[0] in ("train", "distill", "tune")
            and (setting := train.suggest_setting(option))
        ):
            raise UsageError(f"no option {option}; set the recipe's key instead: {setting}VALUE") from None
        if is_one and name not in COMMANDS:
            plugin_commands.explain_failure(name, error)
        raise
    if code == error_boundary.INTERRUPTED:
        raise KeyboardInterrupt  # Typer has caught it
    return code if isinstance(code, int) else 0


def _present_failure(arguments: list[str], error: RlctlError) -> None:
    """Write the error to the targets of `--json` and the like: their reader must not find those of an earlier call."""
    if (target := _find_value(arguments, "--json")) is not None:
        from rlctl import output

        with contextlib.suppress(RlctlError, OSError):  # the first error is the one to tell
            output.present({"format": "rlctl error 1", "exit_code": error.exit_code, "error": str(error)}, target)
    if (target := _find_value(arguments, "--junit")) is not None:
        from rlctl.storage import junit

        case = junit.Case(f"rlctl {arguments[0]}", "error", [junit.CaseEntry("error", message=str(error))])
        with contextlib.suppress(RlctlError, OSError):
            junit.write(Path(target), [junit.Suite(f"rlctl {arguments[0]}", 0.0, [case])])
    if (target := _find_value(arguments, "--markdown")) is not None:
        from rlctl.storage import files

        with contextlib.suppress(RlctlError, OSError):
            files.write_result(Path(target), f"**rlctl {arguments[0]} failed**: {error}\n".encode())
    if (target := _find_value(arguments, "--sarif")) is not None:
        from rlctl.storage import sarif

        with contextlib.suppress(RlctlError, OSError):
            sarif.write_failure(Path(target), str(error))


def _find_value(arguments: list[str], option: str) -> str | None:
    """Return the value of an option, written as `--json FILE` or `--json=FILE`."""
    following = dict(itertools.pairwise(arguments))
    joined = (argument.partition("=")[2] for argument in arguments if argument.startswith(f"{option}="))
    return following.get(option, next(joined, None))
