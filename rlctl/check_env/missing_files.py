"""Which file a call could not find, where it was looked for, and what of a similar name there is."""

from __future__ import annotations

import ast
import difflib
import linecache
import sys
from pathlib import Path
from types import TracebackType
from typing import Any

from rlctl.check_env.bullet_clients import connected

_LOADERS = (
    "loadURDF",
    "loadMJCF",
    "loadSDF",
    "loadSoftBody",
    "loadTexture",
    "createVisualShape",
    "createCollisionShape",
)
_HARMLESS = (ast.Constant, ast.Name, ast.Attribute, ast.JoinedStr, ast.FormattedValue, ast.BinOp, ast.Add, ast.Div,
             ast.Load, ast.Subscript)  # fmt: skip
_MOST_FILES = 5_000
"""Files that are looked through for a similar name."""


def missing_file(error: BaseException | None) -> dict[str, Any] | None:
    """Describe the file behind an exception, or behind what caused it; None if it is about something else."""
    while error is not None:
        if isinstance(error, FileNotFoundError):
            return _described(str(error.filename or error), [])
        if type(error).__module__ == "pybullet" and "load" in str(error).lower():
            name = _argument(error.__traceback__)
            return None if name is None else _described(name, _pybullet_data())
        error = error.__cause__ or error.__context__
    return None


def _described(name: str, more: list[Path]) -> dict[str, Any]:
    searched = [] if Path(name).is_absolute() else [Path.cwd(), *more]
    return {"file": name, "searched": [str(folder) for folder in searched], "similar": _similar(Path(name), searched)}


def _argument(trace: TracebackType | None) -> str | None:
    """Return the file name that the failing call was given, read from its source line and its variables."""
    while trace is not None and trace.tb_next is not None:
        trace = trace.tb_next
    if trace is None:
        return None
    code = trace.tb_frame.f_code
    lines = linecache.getlines(code.co_filename)
    try:
        tree = ast.parse("".join(lines))
    except SyntaxError:
        return None
    for node in ast.walk(tree):
        if isinstance(node, ast.Call) and node.lineno <= trace.tb_lineno <= (node.end_lineno or node.lineno):
            name = node.func.attr if isinstance(node.func, ast.Attribute) else getattr(node.func, "id", "")
            value = _value(node, trace) if name in _LOADERS else None
            if value:
                return value
    return None


def _value(call: ast.Call, trace: TracebackType) -> str | None:
    named = [keyword.value for keyword in call.keywords if keyword.arg == "fileName"]
    for node in [*call.args[:1], *named]:
        # Nothing that could do anything: the same names and constants that the call itself was given.
        if all(isinstance(each, _HARMLESS) for each in ast.walk(node)):
            code = compile(ast.Expression(node), "<argument>", "eval")
            try:
                return str(eval(code, trace.tb_frame.f_globals, trace.tb_frame.f_locals))
            except Exception:  # only a better message is lost
                return None
        return ast.unparse(node)
    return None


def _pybullet_data() -> list[Path]:
    """Return pybullet_data's folder if PyBullet searches it now; to find out, a model of it is loaded."""
    pybullet, data = sys.modules.get("pybullet"), sys.modules.get("pybullet_data")
    if pybullet is None or data is None:
        return []
    for client in connected()[-1:]:  # the newest is the one that failed
        try:
            pybullet.removeBody(pybullet.loadURDF("plane.urdf", physicsClientId=client), physicsClientId=client)
        except pybullet.error:
            return []
        return [Path(data.getDataPath())]
    return []


def _similar(wanted: Path, searched: list[Path]) -> str | None:
    """Return a file of nearly the same name in the folders that were searched, or in the one that was named."""
    folders = searched or [next((parent for parent in wanted.parents if parent.is_dir()), Path("/nowhere"))]
    for folder in folders:
        names: dict[str, Path] = {}
        for number, path in enumerate(folder.rglob(f"*{wanted.suffix}")):
            if number > _MOST_FILES:
                break
            names.setdefault(path.name, path)
        if close := difflib.get_close_matches(wanted.name, names, n=1, cutoff=0.8):
            return str(names[close[0]])
    return None
