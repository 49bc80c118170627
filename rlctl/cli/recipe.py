"""`rlctl recipe`: the complete recipe of a task, and the JSON schema of recipes."""

from __future__ import annotations

from typing import Annotated

import typer

from rlctl.cli import completion
from rlctl.cli.arguments import TASK_FORMS, claim_stdout
from rlctl.errors import UsageError


def recipe(
    task: Annotated[
        str | None, typer.Argument(metavar="TASK", help=TASK_FORMS, autocompletion=completion.complete_task)
    ] = None,
    schema: Annotated[bool, typer.Option("--schema", help="Print the JSON schema of recipes, for editors.")] = False,
) -> None:
    """Print the complete recipe of a task, or the JSON schema of recipes."""
    claim_stdout()
    from rlctl import output

    if schema:
        from rlctl.recipe.json_schema import render_json_schema

        output.results().write(render_json_schema())
        return
    if task is None:
        raise UsageError("give a task, such as rlctl recipe reach, or --schema")
    from rlctl.environments import registry
    from rlctl.recipe.sources import resolve

    registry.load(task)  # a name that is no task has no recipe
    output.results().write(resolve(task, None, {}).to_yaml())
