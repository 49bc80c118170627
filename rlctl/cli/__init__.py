"""The command line: a module per command parses, calls one function and prints.

What a verb needs is imported inside its command, so that help, lists and completion load nothing heavy.
"""

from __future__ import annotations

import sys
from typing import Annotated

import typer

from rlctl import __version__, error_boundary
from rlctl.cli import check_env, eval, export, identify, replay, runs, serve, tasks, train
from rlctl.errors import RlctlError

app = typer.Typer(
    name="rlctl",
    help="Robot learning in simulation, end to end: check an environment, train, evaluate, export, replay.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={
        "help_option_names": ["-h", "--help"],
        # Typer hands over names without their dashes in front.
        "token_normalize_func": lambda name: {"num-envs": "n-envs"}.get(name.replace("_", "-"), name.replace("_", "-")),
    },
)


def _print_version(wanted: bool) -> None:
    if wanted:
        print(f"rlctl {__version__}")
        raise typer.Exit


@app.callback()
def _root(
    version: Annotated[
        bool, typer.Option("--version", help="Print the version and exit.", callback=_print_version, is_eager=True)
    ] = False,
) -> None:
    pass


app.command("check-env")(check_env.check_env)
app.command()(train.train)
app.command("eval")(eval.evaluate)
app.command()(export.export)
app.command()(replay.replay)
app.command()(serve.serve)
app.command()(identify.identify)
app.add_typer(tasks.app, name="tasks")
app.add_typer(runs.app, name="runs")


def main() -> None:
    """Run the command line and end the process with its exit code."""
    error_boundary.prepare_streams()
    code = run(sys.argv[1:])
    error_boundary.limit_exit_handlers(code)
    sys.exit(code)


def run(arguments: list[str]) -> int:
    """Run a command line; return the exit code: the one error boundary."""
    try:
        code = app(arguments, standalone_mode=False)
        error_boundary.flush()
        return code if isinstance(code, int) else 0
    except RlctlError as error:
        return error_boundary.report(error)
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        return 130
    except BrokenPipeError:
        error_boundary.close_stdout()
        return 141
    except SystemExit as end:
        if isinstance(end.__context__, BrokenPipeError):  # what Typer and Rich make of it
            error_boundary.close_stdout()
            return 141
        raise
    except Exception as error:
        return error_boundary.report_unexpected(error)
