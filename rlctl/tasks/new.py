"""`rlctl tasks new`: a plugin to begin with, which passes every check and learns at once."""

from __future__ import annotations

import dataclasses
import importlib.util
import keyword
import os
import re
import shutil
import string
from pathlib import Path

from rlctl.environments import installed
from rlctl.errors import ArtifactError, UsageError
from rlctl.recipe import json_schema
from rlctl.storage import files as storage_files

TEMPLATE = Path(__file__).with_name("template")
"""The files of the plugin, with `$name`, `$package` and `$cls` to be filled in; `package/` takes the package's name."""
_SUFFIX = ".tmpl"
_NAME = re.compile(r"[A-Za-z](?:[A-Za-z0-9_-]*[A-Za-z0-9])?")
_TAKEN = {
    "tests": "the plugin's tests are in a folder of that name",
    "latest": "`rlctl eval latest` means the newest run",
}


@dataclasses.dataclass(frozen=True)
class NewPlugin:
    """A plugin that was written."""

    name: str
    folder: Path
    package: str
    cls: str
    files: list[Path]
    """Relative to `folder`."""

    @property
    def target(self) -> str:
        """How to name the task without installing it."""
        return f"{self.folder / self.package / 'task.py'}:{self.cls}"


def create(name: str) -> NewPlugin:
    """Write the plugin `name` into the current folder, whole or not at all; raises `UsageError` for a name in use."""
    package = name.replace("-", "_").lower()
    _check(name, package)
    folder = Path(name)
    if os.path.lexists(folder):
        raise UsageError(f"{folder} exists already; choose another name, or go to another folder")
    sources = _read_sources()
    cls = _make_class_name(name, "".join(sources.values()))
    content = {
        Path(*(package if part == "package" else part for part in path.parts)): string.Template(text).substitute(
            name=name, package=package, cls=cls
        )
        for path, text in sources.items()
    }
    # The editor's schema lies next to the recipe: a path into this machine's packages would mean nothing elsewhere.
    content[Path(package, json_schema.FILE.name)] = json_schema.FILE.read_text(encoding="utf-8")
    write_files(folder, content)
    return NewPlugin(name, folder, package, cls, list(content))


def show(plugin: NewPlugin, json: str | None) -> None:
    """Print what was written and what to type next, or JSON alone for `-`."""
    from rlctl import output

    files = [str(plugin.folder / file) for file in plugin.files]
    content = {"name": plugin.name, "folder": str(plugin.folder), "target": plugin.target, "files": files}
    if output.present(content, json):
        return
    out = output.out()
    for file in plugin.files:
        out.print(f"wrote {plugin.folder / file}")
    out.print("A planar arm that brings its tip to a goal. Every CHANGE in task.py marks a place to make it your own.")
    out.print("next:")
    for command in (
        f"rlctl check-env {plugin.target}",
        f'pip install -e "{plugin.folder}[test]"',
        f"rlctl train {plugin.name}",
        f"pytest {plugin.folder}",
    ):
        out.print(f"  {command}")


def _check(name: str, package: str) -> None:
    if not _NAME.fullmatch(name):
        near = re.sub(r"[^A-Za-z0-9_]+", "-", name).strip("-_0123456789")
        raise UsageError(
            f"name {name!r}: use letters, digits, - and _, with a letter first and no sign last"
            f"{f', such as {near!r}' if _NAME.fullmatch(near) else ''}"
        )
    if entry := installed.find(name):
        raise UsageError(
            f"a task {name!r} is installed already, by {entry.distribution} {entry.version}; choose another name"
        )
    if reason := _TAKEN.get(package):
        raise UsageError(f"name {name!r}: {reason}; choose another name")
    if keyword.iskeyword(package):
        raise UsageError(
            f"name {name!r}: {package} is a word of Python, so no package can have it; choose another name"
        )
    # Installing the plugin would hide the module for everything else here.
    spec = importlib.util.find_spec(package)
    if spec is not None and spec.origin is not None:  # without an origin it is just a folder on the path
        raise UsageError(f"name {name!r}: there is a module {package!r} already ({spec.origin}); choose another name")


def _read_sources() -> dict[Path, str]:
    files = sorted(TEMPLATE.rglob(f"*{_SUFFIX}"))
    if not files:
        raise ArtifactError(f"{TEMPLATE}: the template is missing; install rlctl again")
    return {file.relative_to(TEMPLATE).with_suffix(""): file.read_text(encoding="utf-8") for file in files}


def _make_class_name(name: str, used: str) -> str:
    """`my-arm` -> `MyArm`; with `Task` behind it where the template itself uses the word, or Python does."""
    cls = "".join(part[:1].upper() + part[1:] for part in re.split("[-_]+", name))
    return f"{cls}Task" if keyword.iskeyword(cls) or re.search(rf"\b{cls}\b", used) else cls


def write_files(folder: Path, content: dict[Path, str]) -> None:
    """Write files into a new folder, all or none; raise `OSError` if the folder exists or one cannot be written."""
    beside = folder.with_name(f".{folder.name}.{os.getpid()}.part")
    try:
        with storage_files.name_in_errors(folder):
            for path, text in content.items():
                file = beside / path
                file.parent.mkdir(parents=True, exist_ok=True)
                file.write_text(text, encoding="utf-8")
            beside.rename(folder)  # fails, and removes nothing, if somebody has put files there meanwhile
    finally:
        shutil.rmtree(beside, ignore_errors=True)
