"""In which unit of angles the expressions of a source are, and where degrees and radians are mixed."""

import ast
import dataclasses
import functools
from collections.abc import Sequence
from pathlib import Path

from rlctl.checking.angle_units import (
    CONSTANT,
    CONVERTED,
    INVERSE,
    NUMBER,
    TARGETS,
    Angle,
    Unit,
    are_mixed,
    list_factors,
    read_comment,
    read_turn,
    read_words,
    unite,
)
from rlctl.checking.assignments import METHODS, read_name, read_root
from rlctl.checking.bullet_fields import BulletFields
from rlctl.checking.definitions import ReadExpression
from rlctl.checking.experiments.expressions import NotedEpisodes
from rlctl.checking.source_code import Function, write_code

CONVERSIONS_TO = {
    "degrees": Unit.TO_DEGREES, "rad2deg": Unit.TO_DEGREES, "radians": Unit.TO_RADIANS, "deg2rad": Unit.TO_RADIANS,
}  # fmt: skip
OF_RADIANS = {
    "arctan2", "atan2", "arctan", "atan", "arccos", "acos", "arcsin", "asin", "getEulerFromQuaternion",
}  # fmt: skip
OF_ROTATIONS = {"as_euler", "as_rotvec"}
TAKING_RADIANS = {"sin": 0, "cos": 0, "tan": 0, "getQuaternionFromEuler": 0, "from_euler": 1, "from_rotvec": 0}
"""Functions of angles, and which of their arguments these are."""
NUMBERS = {
    *("sin", "cos", "tan", "tanh", "exp", "sign", "random", "normal", "standard_normal", "uniform", "integers"),
    *("choice", "zeros", "zeros_like", "ones", "ones_like", "rand", "randn", "len"),
}
"""Functions whose result has no unit, unless what they are given has one."""
COMPARING = {"clip", "maximum", "minimum", "max", "min", "normal", "uniform", "isclose", "allclose", "hypot"}
KEEPING = {
    *("abs", "fabs", "float", "array", "asarray", "stack", "concatenate", "hstack", "vstack", "mean", "median", "sum"),
    *("round", "norm", "choice", "linspace", "append", "list", "tuple", "atleast_1d", "column_stack", "unwrap"),
    *("sorted", "deepcopy", "float32", "float64", *METHODS, *COMPARING),
}
"""Functions whose result is in the unit of what they are given, or of the array whose methods they are."""
STATES = {"qpos", "qvel", "joint_positions", "joint_velocities", "base_angular_velocity", "jnt_range"}
"""What engines hold in radians, where it is an angle."""
PLAIN = {"action", "actions", "dt", "timestep", "control_dt", "sim_dt", "step_dt"}
"""To multiply by these does not change the unit of an angle: a rate is one, too."""
DEEPEST = 14


@dataclasses.dataclass(frozen=True)
class MixedAngles:
    """A piece of code in which the unit of an angle is wrong."""

    node: ast.expr
    takes_radians: bool  # it is a function of radians; else two units are mixed, or one is converted wrongly
    what: str


class AngleReadings:
    """Reads the units, and notes the mistakes on the way."""

    def __init__(self, noted: NotedEpisodes) -> None:
        self.definitions, self.source = noted.definitions, noted.source
        self._fields = BulletFields(self.definitions)
        self._open: list[ast.expr] = []
        self._found: dict[ast.expr, Angle | None] = {}
        self.mixed: dict[ast.expr, MixedAngles] = {}

    def find(self, node: ast.expr, function: Function) -> Angle | None:
        """Return the unit of an expression; None where it is not known."""
        if node not in self._found:
            self._found[node] = self._read(ReadExpression(node, function))
        return self._found[node]

    def _read(self, place: ReadExpression) -> Angle | None:
        if len(self._open) > DEEPEST or place.node in self._open:
            return None
        self._open.append(place.node)
        try:
            return self._read_kind(place)
        finally:
            self._open.pop()

    def _read_all(self, place: ReadExpression, nodes: Sequence[ast.expr]) -> list[Angle | None]:
        return [self._read(place.at(node)) for node in nodes]

    def _read_kind(self, place: ReadExpression) -> Angle | None:
        node = place.node
        match node:
            case ast.Constant(value=int() | float()):
                return CONSTANT
            case ast.UnaryOp(op=ast.USub() | ast.UAdd(), operand=part) | ast.Starred(value=part):
                return self._read(place.at(part))
            case ast.ListComp(elt=part) | ast.GeneratorExp(elt=part):
                return self._read(place.at(part))
            case ast.BinOp(op=ast.Add() | ast.Sub(), left=left, right=right):
                parts = self._read_all(place, [left, right])
                self._compare(node, *parts)
                if None in parts:
                    known = parts[0] or parts[1]
                    return dataclasses.replace(known, is_weighted=True) if known else None
                return unite(parts)
            case ast.BinOp(op=ast.Mod(), left=left, right=right):
                known, turn = self._read(place.at(left)), read_turn(right)
                self._compare(node, known, turn)
                return turn or known
            case ast.Compare(left=left, comparators=[right]):
                self._compare(node, *self._read_all(place, [left, right]))
                return None
            case ast.BinOp(op=ast.Mult() | ast.Div()):
                return self._multiply(place)
            case ast.IfExp(body=one, orelse=other):
                return unite(self._read_all(place, [one, other]))
            case ast.List(elts=parts) | ast.Tuple(elts=parts):
                several = self._read_all(place, parts)
                return None if None in several else unite(several)
            case ast.Attribute(attr="pi"):
                return Angle(Unit.RADIANS, "pi")
            case ast.Call():
                return self._read_call(place, node)
            case ast.Subscript() if self._is_inside(node) and (field := self._fields.find_field(node)) is not None:
                is_joint = field.function == "getJointState" and field.field in (0, 1)
                return Angle(Unit.RADIANS, "the state of a joint") if is_joint else None
            case ast.Subscript(value=owner, slice=index) if not read_name(node) or not (
                isinstance(index, ast.Constant) and isinstance(index.value, str)
            ):
                return self._read(place.at(owner))
            case ast.Name() | ast.Attribute() | ast.Subscript():
                return self._read_named(place)
        return None

    def _compare(self, node: ast.expr, one: Angle | None, other: Angle | None) -> None:
        if one is not None and other is not None and are_mixed(one, other) and not one.is_weighted | other.is_weighted:
            self._note(node, f"is {one.unit.value} ({one.why}) next to {other.unit.value} ({other.why})")

    def _note(self, node: ast.expr, what: str, takes_radians: bool = False) -> None:
        self.mixed.setdefault(node, MixedAngles(node, takes_radians, what))

    def _multiply(self, place: ReadExpression) -> Angle | None:
        factors = list_factors(place.node)
        conversions = list(factors.conversions)
        rest: list[tuple[Angle | None, int]] = []
        for node, exponent in factors.others:
            part = NUMBER if read_name(node) in PLAIN else self._read(place.at(node))
            if part is not None and part.is_factor:
                conversions.append(part.unit if exponent > 0 else INVERSE[part.unit])
            else:
                rest.append((part, exponent))
        angles = [(part, exponent) for part, exponent in rest if part is not None and part.unit is not Unit.NUMBER]
        is_known = all(part is not None for part, _ in rest)
        is_weighted = abs(factors.number) != 1 or any(part is not None and part.is_weighted for part, _ in rest)
        text = write_code(place.node)
        if len(conversions) == 1 and not angles:
            is_factor = not rest and abs(factors.number) == 1 and not factors.pi
            return Angle(conversions[0] if is_factor else TARGETS[conversions[0]], text)
        if len(angles) == 2 and not conversions:
            self._note_ratio(place.node, angles)
        if len(angles) != 1:
            is_turn = factors.pi == 1 and not conversions and not angles and is_known
            return Angle(Unit.RADIANS, text) if is_turn else None
        angle, exponent = angles[0]
        assert angle is not None
        if not is_known or exponent < 0 or factors.pi or len(conversions) > 1:
            return None
        if conversions:
            return self._convert(place.node, angle, conversions[0], is_weighted)
        return dataclasses.replace(angle, is_weighted=is_weighted)

    def _note_ratio(self, node: ast.expr, angles: Sequence[tuple[Angle | None, int]]) -> None:
        """Note degrees over radians, and a gain per degree times radians."""
        (one, up), (other, down) = angles
        if one is None or other is None:
            return
        gains = {Unit.PER_DEGREE: Unit.RADIANS, Unit.PER_RADIAN: Unit.DEGREES}
        if up * down < 0:
            is_wrong = are_mixed(one, other)
        else:
            is_wrong = gains.get(one.unit) is other.unit or gains.get(other.unit) is one.unit
        if is_wrong:
            self._note(node, f"is {one.unit.value} ({one.why}) next to {other.unit.value} ({other.why})")

    def _convert(self, node: ast.expr, given: Angle, by: Unit, is_weighted: bool = False) -> Angle | None:
        to = CONVERTED.get((given.unit, by))
        if to is not None:
            return Angle(to, write_code(node), is_weighted)
        self._note(node, f"converts what is {given.unit.value} already ({given.why}), as if it were not")
        return None

    def _read_call(self, place: ReadExpression, call: ast.Call) -> Angle | None:
        name, text = read_name(call.func), write_code(call)
        if name in CONVERSIONS_TO and len(call.args) == 1:
            given = self._read(place.at(call.args[0]))
            if given is None or given.unit is Unit.NUMBER:
                return Angle(TARGETS[CONVERSIONS_TO[name]], text)
            return self._convert(call, given, CONVERSIONS_TO[name])
        if name in TAKING_RADIANS and len(call.args) > TAKING_RADIANS[name]:
            self._take_radians(place, call, TAKING_RADIANS[name])
        if name in OF_ROTATIONS:
            return Angle(Unit.DEGREES if _is_in_degrees(call) else Unit.RADIANS, text)
        if name in OF_RADIANS:
            return Angle(Unit.RADIANS, text)
        returned = self.definitions.list_returned(place)
        if returned:
            return unite([self._read(one) for one in returned])
        parts = call.args[1:2] if name == "full" else list(call.args)
        if isinstance(call.func, ast.Attribute) and read_root(call.func) not in ("np", "numpy", "math", "p"):
            parts = [call.func.value, *parts] if name in KEEPING - {"normal", "uniform", "choice"} else parts
        if name in KEEPING | {"full"} and parts:
            units = self._read_all(place, parts)
            for unit in units[1:] if name in COMPARING else ():
                self._compare(call, units[0], unit)
            return unite(units) or (NUMBER if name in NUMBERS else None)
        return NUMBER if name in NUMBERS else read_words(name)

    def _take_radians(self, place: ReadExpression, call: ast.Call, which: int) -> None:
        argument = call.args[which]
        wanted = Unit.DEGREES if _is_in_degrees(call) else Unit.RADIANS
        parts = argument.elts if isinstance(argument, ast.List | ast.Tuple) else [argument]
        for angle in self._read_all(place, parts):
            if angle is not None and angle.unit in TARGETS.values() and angle.unit is not wanted:
                what = f"is given {angle.unit.value} ({angle.why}), and takes {wanted.value}"
                self._note(call, what, takes_radians=True)

    def _read_named(self, place: ReadExpression) -> Angle | None:
        node, name = place.node, read_name(place.node)
        if isinstance(node, ast.Attribute) and name in STATES:
            return Angle(Unit.RADIANS, f"what {name} holds")
        several = self.list_definitions(place)
        found = unite([self._read(one) for one, _ in several])
        if found is not None and found.unit is not Unit.NUMBER:
            return found
        comments = [self._read_comment(one.node, element) for one, element in several]
        return read_words(name) or unite([one for one in comments if one is not None]) or found

    def list_definitions(self, place: ReadExpression) -> list[tuple[ReadExpression, int | None]]:
        """Return what a name stands for, and which element of it."""
        node = place.node
        several = self.definitions.follow(place)
        is_local = isinstance(node, ast.Name) and node.id in self.definitions.list_assigned(place.function)
        if not several and self._is_inside(node) and (is_local or isinstance(node, ast.Attribute)):
            values = self.definitions.read(node)
            several = [ReadExpression(one, self.source.find_function(one), {}, place.depth) for one in values]
        if not several and is_local and isinstance(node, ast.Name):
            values = self.definitions.read_parts(node)
            several = [ReadExpression(one, self.source.find_function(one), {}, place.depth) for one in values]
        if several or is_local:
            return [(one, None) for one in several]
        constants = self.constants.get(read_name(node), ())
        return [(ReadExpression(value, place.function), element) for value, element in constants]

    def _is_inside(self, node: ast.AST) -> bool:
        while node in self.source.parents and not isinstance(node, Function):
            node = self.source.parents[node]
        return isinstance(node, Function)

    @functools.cached_property
    def constants(self) -> dict[str, list[tuple[ast.expr, int | None]]]:
        """What modules and classes set outside their functions, by its name."""
        found: dict[str, list[tuple[ast.expr, int | None]]] = {}
        for tree in self.source.trees.values():
            classes = [node for node in ast.walk(tree) if isinstance(node, ast.ClassDef) and not self._is_other(node)]
            for body in [tree.body, *(owner.body for owner in classes)]:
                for statement in body:
                    match statement:
                        case ast.Assign(targets=[ast.Tuple(elts=targets)], value=ast.Tuple(elts=values)):
                            for element, (target, value) in enumerate(zip(targets, values, strict=False)):
                                found.setdefault(read_name(target), []).append((value, element))
                        case (
                            ast.Assign(targets=[target], value=value)
                            | ast.AnnAssign(target=target, value=ast.expr() as value)
                        ):
                            found.setdefault(read_name(target), []).append((value, None))
        return found

    def _is_other(self, owner: ast.ClassDef) -> bool:
        """Say whether a class is another environment that inherits from the same."""
        own = self.source.classes
        return owner.name not in own and any(read_name(base) in own for base in owner.bases)

    @functools.cached_property
    def _lines(self) -> dict[str, list[str]]:
        return {file: Path(file).read_text(encoding="utf-8").splitlines() for file in self.source.trees}

    def _read_comment(self, value: ast.expr, element: int | None) -> Angle | None:
        statement = self.source.find_statement(value)
        if not isinstance(statement, ast.Assign | ast.AnnAssign):
            return None
        file, _ = self.source.find_place(statement)
        _, sign, comment = self._lines[file][(statement.end_lineno or 1) - 1].partition("  # ")
        return read_comment(comment, element) if sign else None


def _is_in_degrees(call: ast.Call) -> bool:
    words = [word.value for word in call.keywords if word.arg == "degrees"]
    given = [*words, *call.args[2:3]] if read_name(call.func) == "from_euler" else [*words, *call.args[1:2]]
    return any(isinstance(one, ast.Constant) and one.value is True for one in given)
