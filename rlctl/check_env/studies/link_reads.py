"""Which links an environment reads, found by looking over its shoulder for a few steps."""

from __future__ import annotations

import ast
import contextlib
import sys
from collections.abc import Mapping, Sequence
from types import CodeType, FrameType
from typing import Any

from rlctl.check_env.actions import actions
from rlctl.check_env.evidence import FIRST_SEED
from rlctl.check_env.failures import EnvironmentRaised
from rlctl.check_env.instance import Instance

WATCHED_STEPS = 3

Wanted = Mapping[tuple[str, int], CodeType]
"""Per file and line, the expression that gives the link."""


def links_read(instance: Instance, calls: Mapping[str, Sequence[ast.Call]]) -> list[int] | None:
    """Return the link indices with which calls of getLinkState, given per file, are made; None where not known."""
    wanted: dict[tuple[str, int], CodeType] = {}
    for file, each in calls.items():
        for call in each:
            link = _link(call)
            if link is None:
                return None
            wanted[file, call.lineno] = compile(ast.Expression(link), file, "eval")
    return sorted(_watch(instance, wanted)) or None


def _link(call: ast.Call) -> ast.expr | None:
    given = [each.value for each in call.keywords if each.arg == "linkIndex"] or call.args[1:2]
    # Anything that is called could do something when it is called once more.
    is_plain = given and not any(isinstance(node, ast.Call | ast.Starred) for node in ast.walk(given[0]))
    return given[0] if is_plain else None


def _watch(instance: Instance, wanted: Wanted) -> set[int]:
    found: set[int] = set()
    files = {file for file, _ in wanted}

    def on_line(frame: FrameType, event: str, argument: Any) -> Any:
        code = wanted.get((frame.f_code.co_filename, frame.f_lineno)) if event == "line" else None
        if code is not None:
            with contextlib.suppress(Exception):  # a name that gets its value on this very line
                found.add(int(eval(code, frame.f_globals, frame.f_locals)))
        return on_line

    def on_call(frame: FrameType, event: str, argument: Any) -> Any:
        return on_line if frame.f_code.co_filename in files else None

    before = sys.gettrace()
    sys.settrace(on_call)
    try:
        _live(instance)
    finally:
        sys.settrace(before)
    return found


def _live(instance: Instance) -> None:
    """Live the begin of an episode; what it raises is told by the studies that live whole ones."""
    chosen = actions(instance.env.action_space, "random", FIRST_SEED)
    with contextlib.suppress(EnvironmentRaised):
        instance.call("reset", instance.env.reset, **({"seed": FIRST_SEED} if instance.accepts_seed else {}))
        for step in range(1, WATCHED_STEPS + 1):
            answer = instance.call("step", instance.env.step, next(chosen), step=step)
            if any(map(bool, answer[2:4])):
                return
