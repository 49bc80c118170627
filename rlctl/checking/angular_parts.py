"""Where the source reads the angular part of a velocity that has both parts."""

import ast
from collections.abc import Iterator, Sequence

from rlctl.checking.assignments import CONVERSIONS, read_name
from rlctl.checking.experiments.expressions import NotedEpisodes
from rlctl.checking.term_names import split_name
from rlctl.environments.simulations import find_mujoco

FREE = 0  # MuJoCo's type of a joint
OTHER_NAMES = {"vel", "velocity", "v"}  # of linear velocities, without a word for an angular one
LINEAR, ANGULAR = (
    {"lin", "linear", "slip", "speed", "linvel"},
    {"ang", "angular", "omega", "gyro", "rot", "rate", "spin", "turn", "yaw", "w"},
)


def find_angular_parts(notes: NotedEpisodes) -> Iterator[tuple[str, str, tuple[str, int]]]:
    """Yield where the angular part of a velocity that has both is read as the linear one: what is called so, the
    expression, and its place."""
    for one in notes.source.expressions:
        node = one.node
        if not isinstance(node, ast.Subscript):
            continue
        names = _list_names(notes, one.function, node)
        words = {word for name in names for word in split_name(name)}
        if not words & LINEAR or words & ANGULAR:
            continue
        is_six = _is_filled(one.function, node.value) or read_name(node.value) == "cvel"
        if is_six and _is_first_half(node.slice) and any(call.values.get(one.number) for call in notes.steps):
            yield sorted(words & LINEAR)[0], one.text, one.where


def find_other_halves(notes: NotedEpisodes) -> Iterator[tuple[str, str, str, tuple[str, int]]]:
    """Yield where another half of a free joint's velocity is read than what it is called: that, the half, the
    expression, and its place."""
    simulation = find_mujoco(notes.instance.env)
    if simulation is None:
        return
    model = simulation[0]
    first = [int(place) for place in model.jnt_dofadr[model.jnt_type == FREE]]
    for one in notes.source.expressions:
        match one.node:
            case ast.Subscript(
                value=ast.Attribute(attr="qvel"), slice=ast.Slice(lower=lower, upper=ast.Constant(value=int(end)))
            ):
                begin = lower.value if isinstance(lower, ast.Constant) and isinstance(lower.value, int) else 0
            case _:
                continue
        halves = [place for place in first if place <= begin and end <= place + 6]
        words = {word for name in _list_kept(notes, one.node) for word in split_name(name)}
        if not halves or end - begin != 3 or one.function not in notes.of_steps:
            continue
        what = ["linear", "mixed", "mixed", "angular"][begin - halves[0]]
        called = _name_half(words)
        if called and called != what:
            yield called, what, one.text, one.where


def _name_half(words: set[str]) -> str:
    if words & ANGULAR:
        return "angular"
    return "linear" if words & (LINEAR | OTHER_NAMES) else ""


def _list_kept(notes: NotedEpisodes, node: ast.expr) -> Sequence[str]:
    """Return the names in which a value is kept as it is."""
    above = notes.source.parents[node]
    while read_name(above.func if isinstance(above, ast.Call) else above) in CONVERSIONS:  # type: ignore[arg-type]
        above = notes.source.parents[above]
    return [read_name(target) for target in above.targets] if isinstance(above, ast.Assign) else []


def _list_names(
    notes: NotedEpisodes, function: ast.FunctionDef | ast.AsyncFunctionDef, node: ast.expr
) -> Sequence[str]:
    statement = notes.source.find_statement(node)
    targets = statement.targets if isinstance(statement, ast.Assign) else []
    names = [read_name(target) for target in targets]
    return names if names else [function.name]


def _is_filled(function: ast.AST, owner: ast.expr) -> bool:
    """Say whether an array is what MuJoCo writes an object's velocity into: angular first."""
    for node in ast.walk(function):
        if isinstance(node, ast.Call) and read_name(node.func) == "mj_objectVelocity":
            arrays = [*node.args[4:5], *(word.value for word in node.keywords if word.arg == "res")]
            if any(ast.unparse(one) == ast.unparse(owner) for one in arrays):
                return True
    return False


def _is_first_half(index: ast.expr) -> bool:
    last = index.elts[-1] if isinstance(index, ast.Tuple) and index.elts else index
    match last:
        case ast.Slice(lower=None | ast.Constant(value=0 | 1), upper=ast.Constant(value=1 | 2 | 3), step=None):
            return True
        case ast.Constant(value=0 | 1 | 2) if isinstance(index, ast.Constant):
            return True
    return False
