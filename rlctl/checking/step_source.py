"""What the code of an environment's step says about the flags that it returns."""

import ast
import inspect
import re
import textwrap
from collections.abc import Collection, Sequence
from typing import Any


def read_flags(env: Any) -> dict[str, Any]:
    """Return `truncation`, `counter` and `counter_place` of `records.Built`; what is not known is left out."""
    step = getattr(type(env), "step", None)
    try:
        lines, first = inspect.getsourcelines(step)  # type: ignore[arg-type]  # what is no function raises
        nodes = list(ast.walk(ast.parse(textwrap.dedent("".join(lines)))))
        file = inspect.getsourcefile(step) or ""  # type: ignore[arg-type]
    except (OSError, TypeError, SyntaxError):
        return {}
    returned = [node.value for node in nodes if isinstance(node, ast.Return) and isinstance(node.value, ast.Tuple)]
    flags = [values.elts[2:4] for values in returned if len(values.elts) == 5]
    assigned = _find_assigned(nodes)
    if not flags:
        return {}
    if any(_list_values(truncated, assigned) != {"False"} for _, truncated in flags):
        return {"truncation": "computed"}
    values = [value for terminated, _ in flags for value in assigned.get(ast.unparse(terminated), [terminated])]
    counters = {
        ast.unparse(node.target)
        for node in nodes
        if isinstance(node, ast.AugAssign) and isinstance(node.op, ast.Add) and ast.unparse(node.value) == "1"
    }
    limit = _find_limit(values, counters) if counters else None
    if limit is None:
        return {"truncation": "never"}
    place = (file, first + limit.lineno - 1)
    return {"truncation": "never", "counter": ast.unparse(limit), "counter_place": place}


def _find_assigned(nodes: Sequence[ast.AST]) -> dict[str, list[ast.expr]]:
    assigned: dict[str, list[ast.expr]] = {}
    for node in nodes:
        if isinstance(node, ast.Assign | ast.AnnAssign | ast.AugAssign) and node.value is not None:
            for target in node.targets if isinstance(node, ast.Assign) else [node.target]:
                assigned.setdefault(ast.unparse(target), []).append(node.value)
    return assigned


def _list_values(flag: ast.expr, assigned: dict[str, list[ast.expr]]) -> set[str]:
    return {ast.unparse(value) for value in assigned.get(ast.unparse(flag), [flag])}


def _find_limit(values: Sequence[ast.expr], counters: Collection[str]) -> ast.expr | None:
    """Return the comparison of a counter with a limit that a value contains."""
    names = "|".join(map(re.escape, counters))
    pattern = re.compile(rf"(?:{names})\s*(?:>=|>|==)\s*[\w.]+")
    for value in values:
        for node in ast.walk(value):
            if isinstance(node, ast.Compare) and pattern.fullmatch(ast.unparse(node)):
                return node
    return None
