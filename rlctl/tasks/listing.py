"""`rlctl tasks`: the installed tasks, with summary, score of the shipped policy, and problems."""

import dataclasses
import json
from typing import Any

from rlctl import output
from rlctl.environments import installed
from rlctl.errors import RlctlError
from rlctl.storage import untrusted


@dataclasses.dataclass(frozen=True)
class ListedTask:
    """A row of the table."""

    name: str
    target: str
    distribution: str
    version: str
    summary: str  # first line of the task's docstring
    algo: str | None
    success: float | None  # success rate of the shipped policy, measured at its export
    mean_return: float | None  # mean return of the shipped policy in the same episodes
    problem: str | None


@dataclasses.dataclass(frozen=True)
class ListedCommand:
    """A command of a plugin."""

    name: str
    target: str
    distribution: str
    version: str
    summary: str  # first line of its docstring
    problem: str | None


def list_tasks(*, check: bool = False) -> list[ListedTask]:
    """List the installed tasks; `check` imports each in a child process."""
    return [describe_entry(entry, check=check) for entry in installed.list_installed()]


def describe_entry(entry: installed.TaskEntry, *, check: bool) -> ListedTask:
    """Return the row of an installed task; `check` imports it in a child process."""
    problem = entry.problem
    summary, algo = "", None
    score: dict[str, Any] = {}
    try:
        if problem is None:
            summary, algo, score = entry.summary, _read_algorithm(entry), _read_score(entry)
    except RlctlError as error:
        problem = str(error)
    except (OSError, UnicodeDecodeError) as error:
        problem = f"{entry.recipe_file}: {error}"
    if check and problem is None:
        problem = installed.check_import(entry)
    success, mean_return = score.get("success"), score.get("mean_return")
    declared = entry.name, entry.target, entry.distribution, entry.version
    return ListedTask(*declared, summary, algo, success, mean_return, problem)


def _read_algorithm(entry: installed.TaskEntry) -> str | None:
    """Read the algorithm from the packaged recipe, without the slow imports of a full check."""
    file = entry.recipe_file
    if file is None:
        return None
    from rlctl.storage import yaml_text

    content = yaml_text.load(file.read_text(encoding="utf-8"), str(file))
    return str(content.get("algo", "ppo") if isinstance(content, dict) else "ppo")


def _read_score(entry: installed.TaskEntry) -> dict[str, Any]:
    """Read the score from the header of the shipped policy; safetensors' own reader would import NumPy."""
    if (path := entry.policy_file) is None:
        return {}
    try:
        with untrusted.open_file(path) as file:
            size = int.from_bytes(file.read(8), "little")
            header = untrusted.parse_json(file.read(min(size, untrusted.JSON_LIMIT)))
        score = json.loads(header["__metadata__"]["rlctl"])["provenance"]["score"]
        return {name: value for name, value in score.items() if isinstance(value, int | float)}
    except (RlctlError, ValueError, KeyError, TypeError, AttributeError, OSError):
        return {}  # loading the policy reports the error


def show(listed: list[ListedTask], commands: list[ListedCommand], json: str | None) -> None:
    """Print the table of tasks and a line per command of a plugin that cannot be called, or only JSON for `-`."""
    if output.present({"tasks": listed, "commands": commands}, json):
        return
    if listed:
        _print_table(listed)
    else:
        output.out().print("no tasks are installed")
    for command in commands:
        if command.problem:
            output.out().print(f"command {command.name} of {command.distribution} {command.version}: {command.problem}")


def _print_table(listed: list[ListedTask]) -> None:
    from rich.text import Text

    columns = ["task", "success", "return", "algorithm", "origin", "what it does"]
    rows = [
        (
            task.name,
            "" if task.success is None else f"{task.success:.0%}",
            "" if task.mean_return is None else f"{task.mean_return:.4g}",
            "" if task.problem else task.algo or "ppo (default)",
            f"{task.distribution} {task.version}",
            Text(task.problem, style="red") if task.problem else task.summary,
        )
        for task in listed
    ]
    left = ("task", "algorithm", "origin", "what it does")
    output.print_table(columns, rows, left=left, drop=("origin", "algorithm"))
