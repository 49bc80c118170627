"""What a user may have meant by the name of a task that does not exist: another form of it, or a close file."""

import ast
import difflib
import re
from collections.abc import Iterator
from pathlib import Path

from rlctl.environments import installed


def suggest(task: str) -> str:
    """Return ". Did you mean 'walk.py:Walker'?" for a file or module that exists; empty if there is none."""
    meant = next(_list_forms(task.strip()), None)
    return f". Did you mean {meant!r}?" if meant else ""


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
    if "/" not in place and installed.find_module_file(place, in_current_folder=True) is not None:
        yield f"{place}:{name}"
    file = Path(place)
    if file.parent.is_dir():
        files = [known for known in file.parent.glob("*.py") if known.is_file()]
        names = [known.name if file.suffix == ".py" else known.stem for known in files]
        for close in difflib.get_close_matches(file.name, names, n=1):
            yield f"{file.parent / close}:{name}"


def list_classes(file: Path) -> list[str]:
    """Return the public classes in a file, without importing it: those that look like tasks, else all."""
    try:
        tree = ast.parse(file.read_bytes())
    except (SyntaxError, ValueError, RecursionError):
        return []
    classes = [node for node in tree.body if isinstance(node, ast.ClassDef) and not node.name.startswith("_")]
    bases = {node.name: " ".join(map(ast.unparse, node.bases)) for node in classes}
    return [name for name, base in bases.items() if "Task" in base or "Env" in base] or list(bases)
