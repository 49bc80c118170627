"""Writes the source of the site to `build/pages`: `python docs/make_site.py`. `make docs` then builds the site from it.

The source is `docs/`, the other pages of the repository, the commands from Typer, and the names of the API, which
mkdocstrings fills in. A file that a page links to is copied.
"""

from __future__ import annotations

import importlib
import inspect
import os
import re
import shutil
from pathlib import Path, PurePosixPath

import typer
from typer.cli import get_docs_for_click

from rlctl.cli import build_app, list_names

ROOT = Path(__file__).parent.parent
TARGET = ROOT / "build" / "pages"
LINK = re.compile(r"(\]\(|src=\")(?!https?://|#)([^)\s#\"]+)")
ELSEWHERE = ("CONTRIBUTING.md", "CHANGELOG.md", "plugins/*/README.md", "examples/*.md", "examples/*/README.md")
API = {  # modules, names with the classes that they return, or with `.*` all that a package imports from its modules
    "rlctl": [
        *("rlctl.check_env", "rlctl.train", "rlctl.evaluate", "rlctl.load_policy", "rlctl.make"),
        *("rlctl.checking.rules.RuleFinding", "rlctl.launching.train.TrainResult"),
        *("rlctl.evaluation.evaluate.Evaluation", "rlctl.policy.policy.Policy"),
    ],
    "rlctl.task": ["rlctl.task.*"],
    "rlctl.task.rewards": ["rlctl.task.rewards"],
    "rlctl.task.terms": ["rlctl.task.terms"],
    "rlctl.task.events": ["rlctl.task.events.*"],
    "rlctl.deploy": [f"rlctl.limits.{name}" for name in ("limits", "safety_filter", "bounds.SafetyEvent")],
    "rlctl.errors": ["rlctl.errors"],
}


def write_pages() -> None:
    """Write all pages and the files that they link to."""
    shutil.rmtree(TARGET, ignore_errors=True)
    for page in [*ROOT.glob("docs/**/*.md"), *(file for pattern in ELSEWHERE for file in ROOT.glob(pattern))]:
        _write(_place(page), _move_links(page))
    for name in ("style.css", "pictures/favicon.svg"):
        _write(TARGET / name, (ROOT / "docs" / name).read_text(encoding="utf-8"))
    _write(TARGET / "commands.md", render_commands())
    for page, objects in API.items():
        names = [name for written in objects for name in _list_objects(written)]
        headed = len(names) > len(objects) or page == "rlctl"
        parts = [f"::: {name}\n    options: {{show_root_heading: {headed}}}" for name in names]
        _write(TARGET / "api" / f"{page}.md", "\n\n".join([f"# {page}", *parts]))


def _list_objects(written: str) -> list[str]:
    """Return a name, or for `package.*` the functions and classes that the package imports, where they are defined."""
    package, star, _ = written.partition(".*")
    if not star:
        return [written]
    values = vars(importlib.import_module(package)).values()
    own = [value for value in values if inspect.isclass(value) or inspect.isfunction(value)]
    return [f"{value.__module__}.{value.__qualname__}" for value in own if value.__module__.startswith(package)]


def render_commands() -> str:
    """Return the page of all commands with their options."""
    group = typer.main.get_command(build_app(list_names()))
    return get_docs_for_click(obj=group, ctx=typer.Context(group), name="rlctl", title="Commands")


def _place(file: Path) -> Path:
    """Return where a file of the repository lies in the source: `docs/` is its root."""
    path = file.relative_to(ROOT)
    return TARGET / str(path).removeprefix("docs/").removeprefix(".")  # no hidden folder is published


def _move_links(page: Path) -> str:
    """Return the text of a page with links that lead to the places of their targets."""

    def move(match: re.Match[str]) -> str:
        target = (page.parent / match[2]).resolve()
        if target.is_dir():
            target /= "README.md"
        if target.suffix != ".md":
            _place(target).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(target, _place(target))
        return match[1] + PurePosixPath(os.path.relpath(_place(target), _place(page).parent)).as_posix()

    return LINK.sub(move, page.read_text(encoding="utf-8"))


def _write(file: Path, text: str) -> None:
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    write_pages()
