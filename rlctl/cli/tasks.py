"""`rlctl tasks` and its commands, and `rlctl recipe`."""

from typing import Annotated

import typer

from rlctl.cli.arguments import command
from rlctl.errors import UsageError
from rlctl.options import Argument, Json, Option, OptionalTask, TaskName

app = typer.Typer()


@app.callback(invoke_without_command=True)
@command
def tasks(
    context: typer.Context,
    check: Annotated[bool, Option("Import each task in a child process.", ("--check",))] = False,
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
@command
def show_task(task: TaskName, json: Json = None) -> None:
    """Show a task's observations, actions, rewards, events, parameters and recipe."""
    from rlctl.tasks.description import describe
    from rlctl.tasks.show import show

    show(describe(task), json)


@app.command("new")
@command
def new_task(
    name: Annotated[str, Argument("Name of the task: letters, digits, - and _.", metavar="NAME")], json: Json = None
) -> None:
    """Create a starter plugin in a folder NAME: a task that trains in seconds, its recipe and tests."""
    from rlctl.tasks.new import create, show

    show(create(name), json)


@command
def recipe(
    task: OptionalTask = None,
    schema: Annotated[bool, Option("Print the JSON schema of recipes, for editors.", ("--schema",))] = False,
) -> None:
    """Print the complete recipe of a task, or the JSON schema of recipes."""
    from rlctl import output

    if schema:
        from rlctl.recipe.recipe import SCHEMA_FILE

        output.results().write(SCHEMA_FILE.read_text(encoding="utf-8"))
        return
    if task is None:
        raise UsageError("give a task, such as rlctl recipe reach, or --schema")
    from rlctl.environments import registry
    from rlctl.recipe.sources import resolve

    registry.load(task)  # a name that is no task has no recipe
    output.results().write(resolve(task, None, {}).to_yaml())
