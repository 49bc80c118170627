"""Elements that no line reads of what follows the action, such as thrusts of slow motors, and of what a function is
given as the action, while another element is read twice."""

import ast
import collections
from collections.abc import Collection, Iterator, Sequence

from rlctl.checking.assignments import list_assignments, list_parameters, read_name
from rlctl.checking.definitions import Definitions
from rlctl.checking.rule import Rule, RuleFinding
from rlctl.checking.source_code import Function, SourceCode, walk_own
from rlctl.checking.term_names import split_name
from rlctl.checking.unread_actions import ACTORS, COSTS, OLD_WORDS, SAME_SHAPE, count_statements, read_elements
from rlctl.checking.vector_series import VectorSeries

SHOWING = {"concatenate", "array", "append", "hstack", "dict", "where"}
SHOWN_WORDS = {"obs", "observation", "observe", "info", "energy", "effort", "cost"}
ACTION_WORDS = {"action", "actions", "act", "cmd", "command", "u", "ctrl", "control"}


def find_unread_followers(
    rule: Rule, definitions: Definitions, series: VectorSeries, evaluated: Collection[ast.AST], size: int
) -> Iterator[RuleFinding]:
    """Yield each element that is never read of an attribute that follows the action, such as the thrusts of slow
    motors, or of a function's parameter that is given the action, where another element is read twice."""
    source = definitions.source
    functions = [one for one in evaluated if isinstance(one, Function)]
    nodes = [(node, function) for function in functions for node in walk_own(function)]
    for text, owner in _list_followers(series, functions, size):
        read = collections.defaultdict[int, list[ast.Subscript]](list)
        is_whole = False
        for node, function in nodes:
            is_load = isinstance(getattr(node, "ctx", None), ast.Load) and (owner is None or function is owner)
            if not is_load or not isinstance(node, ast.expr) or ast.unparse(node) != text:
                continue
            above = source.parents[node]
            if isinstance(above, ast.Subscript) and above.value is node:
                elements = read_elements(above.slice, size)
                is_whole |= elements is None or not isinstance(above.ctx, ast.Load)
                for element in elements or ():
                    read[element].append(above)
            else:
                is_whole |= not _keeps_elements(source, node, text)
        missing = sorted(set(range(size)) - set(read))
        twice = [element for element, found in read.items() if count_statements(source, found) > 1]
        if is_whole or len(missing) != 1 or len(twice) != 1:
            continue
        if owner is not None and missing[0] in _list_elements(nodes):
            continue  # another function uses it
        where = source.find_place(read[twice[0]][-1])
        lines = ", ".join(str(node.lineno) for node in read[twice[0]])
        message = f"{text} has {size} elements, as the action, and {text}[{twice[0]}] is read twice (lines {lines}) and"
        message += f" {text}[{missing[0]}] never"
        yield RuleFinding(rule, message, {"element": f"{text}[{missing[0]}]", "value": missing[0]}, where=where)


def _list_elements(nodes: Sequence[tuple[ast.AST, Function]]) -> set[int]:
    """Return which elements of what is called an action are read alone."""
    found = set[int]()
    for node, _ in nodes:
        match node:
            case ast.Subscript(value=ast.Name(id=name), slice=ast.Constant(value=int(element))) if {
                *split_name(name)
            } & ACTION_WORDS:
                found.add(element)
    return found


def _list_followers(
    series: VectorSeries, functions: Sequence[Function], size: int
) -> Iterator[tuple[str, Function | None]]:
    """Yield attributes that a sum of themselves and of a vector changes, and parameters that are given the action: each
    with its function, where it is a name."""
    for function in functions:
        for name in list_parameters(function)[:1] if function.name not in ACTORS else ():
            if {*split_name(name)} & ACTION_WORDS:
                yield name, function
        for one in list_assignments(function):
            text = ast.unparse(one.target)
            is_filter = isinstance(one.target, ast.Attribute) and any(
                isinstance(part, ast.Name) and {*split_name(part.id)} & ACTION_WORDS for part in ast.walk(one.value)
            )
            if is_filter and one.added and (rows := series.read(one.value)) is not None and rows.shape[1] == size:
                yield text, None


def _keeps_elements(source: SourceCode, node: ast.expr, text: str) -> bool:
    """Say whether a whole vector is only changed element by element, observed, or paid for."""
    below, above = node, source.parents[node]
    while not isinstance(above, ast.stmt):
        match above:
            case ast.Call(func=function) if below is not function:
                name = read_name(function)
                if name in COSTS:
                    return True
                if name not in SAME_SHAPE | SHOWING:
                    return False
            case ast.BinOp(op=ast.MatMult()) | ast.Subscript() | ast.Compare():
                return False
        below, above = above, source.parents[above]  # type: ignore[assignment]
    match above:
        case ast.Assign(targets=[target]) | ast.AugAssign(target=target):
            own = ast.unparse(target)
            return own == text or bool({*split_name(own)} & (OLD_WORDS | SHOWN_WORDS))
        case ast.Return():
            return bool({*split_name(source.find_function(above).name)} & SHOWN_WORDS)
    return False
