"""`rlctl recipe`: the complete recipe of a task, and the JSON schema of recipes."""

from typing import Annotated

from rlctl.cli.arguments import command
from rlctl.errors import UsageError
from rlctl.options import Option, OptionalTask


@command
def recipe(
    task: OptionalTask = None,
    schema: Annotated[bool, Option("Print the JSON schema of recipes, for editors.", ("--schema",))] = False,
) -> None:
    """Print the complete recipe of a task, or the JSON schema of recipes."""
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
