"""`rlctl tasks`, `rlctl tasks show` and `rlctl tasks new`."""

from __future__ import annotations

from typing import Annotated

import typer

from rlctl.cli import completion
from rlctl.cli.arguments import TASK_FORMS, Json, claim_stdout
from rlctl.errors import UsageError

app = typer.Typer()


@app.callback(invoke_without_command=True)
def tasks(
    context: typer.Context,
    check: Annotated[bool, typer.Option("--check", help="Import each task in a child process.")] = False,
    json: Json = None,
) -> None:
    """List the installed tasks; show one, or create your own."""
    if context.invoked_subcommand is not None:
        if check or json is not None:
            raise UsageError(f"put the options after `rlctl tasks {context.invoked_subcommand}`")
        return
    from rlctl.tasks.listing import list_tasks, show

    show(list_tasks(check=check), json)


@app.command("show")
def show_task(
    task: Annotated[str, typer.Argument(metavar="TASK", help=TASK_FORMS, autocompletion=completion.complete_task)],
    json: Json = None,
) -> None:
    """Show a task's observations, actions, rewards, events, parameters and recipe."""
    claim_stdout()
    from rlctl.tasks.description import describe
    from rlctl.tasks.show import show

    show(describe(task), json)


@app.command("new")
def new_task(
    name: Annotated[str, typer.Argument(metavar="NAME", help="Name of the task: letters, digits, - and _.")],
    json: Json = None,
) -> None:
    """Create a starter plugin in a folder NAME: a task that trains in seconds, its recipe and tests."""
    from rlctl.tasks.new import create, show

    show(create(name), json)
