"""The command line. A function per command parses the arguments, calls one function and prints the result.

Each command imports what it needs when it runs, so that help, lists and completion start fast.
"""

import contextlib
import itertools
import sys
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Annotated

import typer

from rlctl.cli import demo, deploy, diagnose, eval, export, gate, runs, tasks, train
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
        "play": deploy.play,
        "demo": demo.demo,
    },
    "Robot": {
        "export": export.export,
        "serve": deploy.serve,
        "robot": deploy.robot,
        "identify": deploy.identify,
        "diagnose": diagnose.diagnose,
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

_CLASSES = {"check-env": tasks.CheckCommand, "replay": eval.ReplayCommand}  # that read arguments in their own way


def build_app(names: Iterable[str] = COMMANDS) -> typer.Typer:
    """Return the Typer app with the named commands."""
    app = typer.Typer(
        name="rlctl",
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
    for name in names:
        command = COMMANDS[name]
        if isinstance(command, typer.Typer):
            app.add_typer(command, name=name, rich_help_panel=_PANELS[name])
        else:
            app.command(name, cls=_CLASSES.get(name), rich_help_panel=_PANELS[name])(command)
    return app


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
    app = build_app(arguments[:1] if arguments and arguments[0] in COMMANDS else COMMANDS)
    try:
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
        raise
    if code == error_boundary.INTERRUPTED:
        raise KeyboardInterrupt  # Typer has caught it
    return code if isinstance(code, int) else 0


def _present_failure(arguments: list[str], error: RlctlError) -> None:
    """Write the error to the targets of `--json` and `--junit`: their reader must not find those of an earlier call."""
    if (target := _find_value(arguments, "--json")) is not None:
        from rlctl import output

        with contextlib.suppress(RlctlError, OSError):  # the first error is the one to tell
            output.present({"format": "rlctl error 1", "exit_code": error.exit_code, "error": str(error)}, target)
    if (target := _find_value(arguments, "--junit")) is not None:
        from rlctl.storage import junit

        case = junit.Case(f"rlctl {arguments[0]}", "error", [junit.CaseEntry("error", message=str(error))])
        with contextlib.suppress(RlctlError, OSError):
            junit.write(Path(target), [junit.Suite(f"rlctl {arguments[0]}", 0.0, [case])])


def _find_value(arguments: list[str], option: str) -> str | None:
    """Return the value of an option, written as `--json FILE` or `--json=FILE`."""
    following = dict(itertools.pairwise(arguments))
    joined = (argument.partition("=")[2] for argument in arguments if argument.startswith(f"{option}="))
    return following.get(option, next(joined, None))
