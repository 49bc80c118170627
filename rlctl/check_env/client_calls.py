"""RL808: calls of PyBullet that leave physicsClientId out, in an environment's functions."""

from __future__ import annotations

import ast
import contextlib
import dataclasses
import functools
import inspect
import re
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from types import CodeType, FrameType
from typing import Any

from rlctl.check_env.finding import Finding, Severity, list_names
from rlctl.check_env.own_code import find_author

LIBRARIES = ("gymnasium", "numpy", "torch", "pybullet", "pybullet_utils", "rlctl", "builtins", "stable_baselines3")
"""Packages that are not part of an environment; rlctl's own tasks are in packages of their own."""
NO_CLIENT = re.compile(
    r"connect|error|getAPIVersion|isNumpyEnabled|submitProfileTiming|rotateVector|calculateVelocityQuaternion"
    r"|(multiply|invert)Transforms?|compute(View|Projection)Matrix\w*|get\w*Quaternion\w*|getEuler\w*|getMatrix\w*"
)
"""Functions that are the same for every client: mathematics, and what makes one."""
FIRST_IS_CLIENT = {
    "disconnect", "getConnectionInfo", "getNumBodies", "getNumConstraints", "isConnected", "performCollisionDetection",
    "getKeyboardEvents", "getMouseEvents", "getPhysicsEngineParameters", "removeAllUserDebugItems", "saveState",
    "stepSimulation",
}  # fmt: skip
"""Functions whose only positional argument is the client."""
CLIENT_WORDS = re.compile(r"client|\bcid\b|_cid\b|server", re.IGNORECASE)
"""Names of a client that is passed by position."""
MOST_CALLS, SHOWN = 20, 4
MOST_RECORDED = 2_000_000
"""So many calls of Python functions are recorded, each of which takes a fraction of a microsecond longer."""


@dataclasses.dataclass(frozen=True, order=True)
class BulletCall:
    """A call of a function of PyBullet in the source."""

    file: str
    line: int
    name: str

    @property
    def place(self) -> str:
        """`file.py:12`."""
        return f"{Path(self.file).name}:{self.line}"


@contextlib.contextmanager
def record_calls() -> Iterator[dict[BulletCall, bool]]:
    """Find the calls without a client in the functions that run inside the `with` block, and whether each ran."""
    calls: dict[BulletCall, bool] = {}
    by_line: dict[CodeType, dict[int, list[BulletCall]]] = {}
    before, left = sys.gettrace(), iter(range(MOST_RECORDED))

    def enter(frame: FrameType, event: str, argument: Any) -> Any:
        code = frame.f_code
        if code not in by_line:
            lines = by_line.setdefault(code, {})
            for call in calls_without_client(code, frame.f_globals):
                calls.setdefault(call, False)
                lines.setdefault(call.line, []).append(call)
        if next(left, None) is None:
            sys.settrace(before)
        return run_line if by_line[code] else None

    def run_line(frame: FrameType, event: str, argument: Any) -> Any:
        calls.update(dict.fromkeys(by_line[frame.f_code].get(frame.f_lineno, ()), True))
        return run_line

    sys.settrace(enter)
    try:
        yield calls
    finally:
        sys.settrace(before)


def find_left_out(env: Any, recorded: Mapping[BulletCall, bool]) -> Iterator[Finding]:
    """Yield what `record_calls` recorded: the calls that ran; if none did, those and the ones in other methods."""
    calls, where, severity = sorted(call for call, has_run in recorded.items() if has_run), "", Severity.ERROR
    if not calls:
        others = {call for code, names in _methods(env) for call in calls_without_client(code, names)}
        calls, where, severity = sorted({*recorded, *others}), ", where it did not run", Severity.WARNING
    if calls:
        count = f"{len(calls)} calls" if len(calls) > 1 else "a call"
        shown = list_names([f"{each.place} {each.name}" for each in calls], SHOWN)
        evidence = {"file": calls[0].file, "line": calls[0].line, "places": [each.place for each in calls[:MOST_CALLS]]}
        names = sorted({each.name for each in calls})
        message = f"{count} of PyBullet without physicsClientId{where}: {shown}"
        yield Finding("RL808", message, {**evidence, "functions": names}, severity)


def _methods(env: Any) -> Iterator[tuple[CodeType, Mapping[str, Any]]]:
    """Yield the methods of the environment (or its task) and of the objects of the same package that it holds."""
    author = find_author(env)
    package = _package(type(author).__module__)
    held = [each for each in getattr(author, "__dict__", {}).values() if _package(type(each).__module__) == package]
    for kind in dict.fromkeys(type(each) for each in (author, *held)):
        for _, method in inspect.getmembers(kind, inspect.isfunction):
            yield method.__code__, method.__globals__


def _package(module: str) -> str:
    return module.partition(".")[0]


def calls_without_client(code: CodeType, names: Mapping[str, Any]) -> Iterator[BulletCall]:
    """Yield the calls of PyBullet in a function that pass no client; `names` are those of its module."""
    is_library = _package(names.get("__name__", "")) in LIBRARIES
    function = None if is_library else _functions(code.co_filename).get(code.co_firstlineno)
    if function is None:
        return
    nodes = list(_own_nodes(function))
    local = {*code.co_varnames, *code.co_cellvars, *code.co_freevars}
    visible = {name: value for name, value in names.items() if name not in local}
    for node in nodes:
        if isinstance(node, ast.Import):
            visible |= {each.asname or each.name: sys.modules.get(each.name) for each in node.names}
    for node in nodes:
        name = _bullet_function(node.func, visible) if isinstance(node, ast.Call) else ""
        if name and not NO_CLIENT.fullmatch(name) and not _has_client(name, node):
            yield BulletCall(code.co_filename, node.lineno, name)


@functools.cache
def _functions(file: str) -> dict[int, ast.AST]:
    """Return the functions of a file by their first line, that of a decorator included."""
    try:
        text = Path(file).read_text(encoding="utf-8")
        nodes = ast.walk(ast.parse(text)) if "pybullet" in text else iter(())
    except (OSError, SyntaxError, ValueError):
        return {}
    functions = [each for each in nodes if isinstance(each, ast.FunctionDef | ast.AsyncFunctionDef)]
    return {min([each.lineno, *(d.lineno for d in each.decorator_list)]): each for each in functions}


def _own_nodes(function: ast.AST) -> Iterator[Any]:
    """Yield what is in a function, without the functions inside it, which have names of their own."""
    for node in ast.iter_child_nodes(function):
        if not isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            yield node
            yield from _own_nodes(node)


def _bullet_function(func: ast.expr, visible: Mapping[str, Any]) -> str:
    """Return the name of PyBullet's function that is called; empty for another call."""
    pybullet = sys.modules.get("pybullet")
    if isinstance(func, ast.Attribute) and isinstance(func.value, ast.Name) and pybullet is not None:
        found = visible.get(func.value.id) is pybullet and inspect.isbuiltin(getattr(pybullet, func.attr, None))
        return func.attr if found else ""
    function = visible.get(func.id) if isinstance(func, ast.Name) else None
    name = str(getattr(function, "__name__", ""))
    return name if inspect.isbuiltin(function) and getattr(pybullet, name, None) is function else ""


def _has_client(name: str, call: Any) -> bool:
    if any(each.arg in (None, "physicsClientId") for each in call.keywords):
        return True
    if any(isinstance(each, ast.Starred) or CLIENT_WORDS.search(ast.unparse(each)) for each in call.args):
        return True
    return name in FIRST_IS_CLIENT and bool(call.args)
