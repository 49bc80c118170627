"""`rlctl tasks`: what is installed, where it comes from, and what is broken."""

from __future__ import annotations

import dataclasses

from rlctl.environments import registry
from rlctl.errors import RecipeError


@dataclasses.dataclass(frozen=True)
class ListedTask:
    """A row of the table."""

    name: str
    target: str
    distribution: str
    version: str
    algo: str | None
    problem: str | None


def list_tasks(*, check: bool = False) -> list[ListedTask]:
    """List the installed tasks; `check` imports each in a child process."""
    return [describe_entry(entry, check=check) for entry in registry.list_installed()]


def describe_entry(entry: registry.TaskEntry, *, check: bool) -> ListedTask:
    """Return the row of an installed task; `check` imports it in a child process."""
    problem = entry.problem
    algo = None
    try:
        algo = _read_algorithm(entry)
    except RecipeError as error:
        problem = problem or str(error)
    except (OSError, UnicodeDecodeError) as error:
        problem = problem or f"{entry.recipe_file}: {error}"
    if check and problem is None:
        problem = registry.check_import(entry)
    return ListedTask(entry.name, entry.target, entry.distribution, entry.version, algo, problem)


def _read_algorithm(entry: registry.TaskEntry) -> str | None:
    """Read the algorithm off the packaged recipe; the full check of a recipe would cost its imports."""
    file = entry.recipe_file
    if file is None:
        return None
    from rlctl.storage import yaml_text

    content = yaml_text.load(file.read_text(encoding="utf-8"), str(file))
    algo = content.get("algo", "ppo") if isinstance(content, dict) else "ppo"
    return str(algo)


def show(listed: list[ListedTask], json: str | None) -> None:
    """Print the table, or JSON alone for `-`."""
    from rlctl import output

    if json is not None and output.write_result_json(json, {"tasks": listed}):
        return
    if not listed:
        output.out().print("no tasks are installed")
        return
    from rich.text import Text

    columns = ["task", "origin", "algorithm", *(["problem"] if any(each.problem for each in listed) else [])]
    rows: list[list[str | Text]] = []
    for each in listed:
        origin = f"{each.distribution} {each.version}"
        problem = Text(each.problem or "", style="red")
        row: list[str | Text] = [each.name, origin, each.algo or "ppo (default)", problem]
        rows.append(row[: len(columns)])
    output.print_table(columns, rows, left=columns)
