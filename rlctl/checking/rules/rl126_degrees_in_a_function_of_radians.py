"""RL126: degrees in a function of radians."""

import ast
import itertools
import math
from collections.abc import Collection, Iterator, Mapping, Sequence

from rlctl.checking.angle_mistakes import AngleMistakes, find_first
from rlctl.checking.assignments import peel
from rlctl.checking.experiments.attributes import find_declared_numbers
from rlctl.checking.experiments.build import judges_built
from rlctl.checking.experiments.expressions import NotedEpisodes, judges_expressions
from rlctl.checking.instance import Instance
from rlctl.checking.rule import Rule, RuleFinding, Severity
from rlctl.checking.values import find_author, list_own_classes, parse_sources

RULE = Rule(
    "RL126",
    "degrees in a function of radians",
    Severity.WARNING,
    meaning="""
        The source takes the sine, the cosine or the tangent of a constant that is more than a whole turn in
        radians, such as cos(15), or makes a rotation of it. The constant is in degrees, and a tolerance, a
        limit or a frame is another one than meant. Constants are round numbers, also those of a name in
        capitals or of an attribute. Or what is given was converted to degrees, or is called degrees, where it comes
        from.
    """,
    fix="Convert it, np.cos(np.deg2rad(15)), or write the constant in radians.",
)

FUNCTIONS = {"cos", "sin", "tan"}
ROTATIONS = {"getQuaternionFromEuler": 0, "from_euler": 1}
"""Functions of several angles, and which of their arguments these are."""
TURN = 2 * math.pi


@judges_expressions(RULE, decides=False)
def _find_given_degrees(noted: NotedEpisodes) -> Iterator[RuleFinding]:
    yield from find_first(RULE, noted.share(AngleMistakes).of_functions)


@judges_built(RULE)
def _find_degrees(instance: Instance) -> Iterator[RuleFinding]:
    classes = list_own_classes(find_author(instance.env))
    declared = find_declared_numbers(instance.env)
    names = {cls.__name__ for cls in classes}
    for file, tree in parse_sources(instance.env).items():
        for call, name, value in _list_calls(tree, names, declared):
            text = ast.unparse(call)
            shown = text if name is None else f"{text}, with {name} = {value:g},"
            message = f"{shown} takes {value:g} radians, which is more than a whole turn, and the same as"
            message += f" {math.degrees(value % TURN):.3g} degrees"
            yield RuleFinding(RULE, message, {"element": text, "value": value}, where=(file, call.lineno))
            return


def _list_calls(
    tree: ast.Module, classes: Collection[str], declared: Mapping[str, float]
) -> Iterator[tuple[ast.Call, str | None, float]]:
    """Yield the calls of functions of angles with a constant of more than a turn, and its name if it has one; without
    those of other classes."""
    parts = [part for part in tree.body if not isinstance(part, ast.ClassDef) or part.name in classes]
    declared = {**declared, **_read_lists(tree)}
    for node in itertools.chain(*map(ast.walk, parts)):
        if isinstance(node, ast.Call):
            for angle in _list_angles(node):
                found = _read_constant(angle, declared)
                if found is not None and abs(found[1]) > TURN and 2 * found[1] == round(2 * found[1]):
                    yield node, *found
                    break


def _read_lists(tree: ast.Module) -> Mapping[str, float]:
    """Return the largest of the numbers of each list or array that a module names in capitals."""
    found: dict[str, float] = {}
    for statement in tree.body:
        match statement:
            case ast.Assign(targets=[ast.Name(id=name)], value=value) if name.isupper():
                parts = peel(value)
                numbers = parts.elts if isinstance(parts, ast.List | ast.Tuple) else []
                constants = [one.value for one in numbers if isinstance(one, ast.Constant)]
                values = [float(one) for one in constants if isinstance(one, int | float)]
                if values and len(values) == len(numbers):
                    found[name] = max(values)
    return found


def _list_angles(call: ast.Call) -> Sequence[ast.expr]:
    """Return the arguments of a call that are angles in radians."""
    name = _name_function(call)
    if name in FUNCTIONS and len(call.args) == 1:
        return call.args
    if (
        name in ROTATIONS
        and len(call.args) == ROTATIONS[name] + 1  # the next argument may say that they are degrees
        and not any(one.arg == "degrees" for one in call.keywords)
    ):
        angles = call.args[ROTATIONS[name]]
        return angles.elts if isinstance(angles, ast.List | ast.Tuple) else [angles]
    return ()


def _name_function(call: ast.Call) -> str:
    match call.func:
        case ast.Attribute(attr=name) | ast.Name(id=name):
            return name
    return ""


def _read_constant(value: ast.expr, declared: Mapping[str, float]) -> tuple[str | None, float] | None:
    match value:
        case ast.UnaryOp(op=ast.USub(), operand=operand):
            found = _read_constant(operand, declared)
            return None if found is None else (found[0], -found[1])
        case ast.Constant(value=int() | float() as number) if not isinstance(number, bool):
            return None, float(number)
        case ast.Name(id=name) if name.isupper() and name in declared:
            return name, declared[name]
        case ast.Attribute(value=ast.Name(id="self"), attr=name):
            for known in (f"self.{name}", name):
                if known in declared:
                    return f"self.{name}", declared[known]
    return None
