"""What a user may have meant by the name of a task that does not exist: another form of it, or a close file."""

import ast
import difflib
import itertools
import re
from collections.abc import Iterator, Sequence
from pathlib import Path

from rlctl.entry_points import find_module_file

_MOST_NAMED = 4


def suggest(task: str) -> str:
    """Return ". Did you mean 'walk.py:Walker'?" for a file or module that exists; empty if there is none."""
    meant = _list_in_module(task) or list(itertools.islice(_list_forms(task.strip()), 1))
    return f". Did you mean {' or '.join(map(repr, meant[:_MOST_NAMED]))}?" if meant else ""


def suggest_name(task: str, installed_names: Sequence[str]) -> str:
    """Return ". Did you mean 'half-cheetah' or 'HalfCheetah-v5'?" for the closest installed name, and the newest id of
    Gymnasium that only lacks its version; an id that differs in case only is the one. Empty if there is none."""
    import gymnasium

    specs = sorted(gymnasium.registry.values(), key=lambda spec: spec.version or 0)
    if same := next((spec.id for spec in specs if spec.id.lower() == task.lower()), None):
        return f". Did you mean {same!r}?"
    versions = {spec.name.lower(): spec.id for spec in specs if spec.namespace is None}
    names = difflib.get_close_matches(task, installed_names, n=1, cutoff=0.5)
    names += [versions[task.lower()]] if task.lower() in versions else []
    return f". Did you mean {' or '.join(map(repr, names))}?" if names else ""


def _list_in_module(task: str) -> list[str]:
    """Return the classes of a module that is named without a class."""
    is_module = re.fullmatch(r"\w+(\.\w+)+", task) is not None
    file = find_module_file(task, in_current_folder=True) if is_module else None
    return [f"{task}:{name}" for name in list_classes(file)] if file is not None and file.suffix == ".py" else []


def find_only_class(task: str) -> str:
    """Return `file.py:Class` for a file with one environment class; empty for anything else."""
    file = Path(task)
    classes = _list_public(file)[0] if file.suffix == ".py" and file.is_file() else []
    return f"{task}:{classes[0]}" if len(classes) == 1 else ""


def explain_model_file(name: str) -> str:
    """Return why a robot's model file is not a task, and what to do; empty for any other name."""
    if not name.endswith((".urdf", ".xml")) or not Path(name).is_file():
        return ""
    return f"{name}: a model file, not a task: `rlctl tasks new NAME --model {name}` makes a task of it"


def _list_forms(task: str) -> Iterator[str]:
    """Yield existing files and modules with the class of a task that is written in another form, or misspelt."""
    parts = [part for part in re.split(r":+|\s+", task) if part]
    if len(parts) == 1:  # package.module.Class, path/to/file/Class
        parts = next(([task[: at.start()], task[at.end() :]] for at in re.finditer(r"[./](?=\w+$)", task)), parts)
    if len(parts) < 2:
        return
    place, name = parts[:2]
    for form in (place, f"{place}.py"):
        if form.endswith(".py") and Path(form).is_file():
            yield f"{form}:{name}"
    if "/" not in place and find_module_file(place, in_current_folder=True) is not None:
        yield f"{place}:{name}"
    file = Path(place)
    if file.parent.is_dir():
        files = [known for known in file.parent.glob("*.py") if known.is_file()]
        names = [known.name if file.suffix == ".py" else known.stem for known in files]
        for close in difflib.get_close_matches(file.name, names, n=1):
            yield f"{file.parent / close}:{name}"


def list_classes(file: Path) -> list[str]:
    """Return the public classes in a file, without importing it: those that look like tasks, else all."""
    tasks, classes = _list_public(file)
    return tasks or classes


def _list_public(file: Path) -> tuple[list[str], list[str]]:
    """Return the public classes in a file that look like tasks, and all."""
    try:
        tree = ast.parse(file.read_bytes())
    except (SyntaxError, ValueError, RecursionError):
        return [], []
    bases = {node.name: list(map(ast.unparse, node.bases)) for node in tree.body if isinstance(node, ast.ClassDef)}
    tasks: set[str] = set()
    for name, names in bases.items():  # a base class comes before what is derived from it
        if tasks & set(names) or any("Task" in base or "Env" in base for base in names):
            tasks.add(name)
    public = [name for name in bases if not name.startswith("_")]
    return [name for name in public if name in tasks], public
