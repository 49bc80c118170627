"""In which order the elements of a source's quaternions are, and where they are read in another one."""

import ast
from collections.abc import Iterator, Mapping, Sequence

from rlctl.checking.assignments import list_assignments, read_converted, read_key, read_name
from rlctl.checking.bullet_fields import BulletFields
from rlctl.checking.definitions import ReadExpression
from rlctl.checking.experiments.expressions import NotedEpisodes
from rlctl.checking.rule import Rule, RuleFinding
from rlctl.checking.source_code import Function, walk_own, write_code
from rlctl.checking.term_names import split_name

WXYZ, XYZW = "w, x, y, z", "x, y, z, w"
SOURCES: Mapping[str, str] = {
    **dict.fromkeys(("xquat", "mocap_quat", "body_quat", "geom_quat", "site_quat"), WXYZ),
    **dict.fromkeys(("getQuaternionFromEuler", "base_orientation", "link_orientation", "as_quat"), XYZW),
}
"""Attributes and functions of libraries whose order is known."""
PAIRS = {"getBasePositionAndOrientation", "multiplyTransforms", "invertTransform"}  # a position, and a quaternion
TURN_FIELDS = {("getBasePositionAndOrientation", 1), *(("getLinkState", field) for field in (1, 3, 5))}
TAKING: Mapping[str, tuple[str, tuple[int, ...]]] = {
    "from_quat": (XYZW, (0,)),
    "getMatrixFromQuaternion": (XYZW, (0,)),
    "getEulerFromQuaternion": (XYZW, (0,)),
    "resetBasePositionAndOrientation": (XYZW, (2,)),
    "multiplyTransforms": (XYZW, (1, 3)),
    "invertTransform": (XYZW, (1,)),
    "set_base": (XYZW, (1,)),
    "mju_rotVecQuat": (WXYZ, (2,)),
    "mju_quat2Mat": (WXYZ, (1,)),
    "mju_negQuat": (WXYZ, (1,)),
    "mju_mulQuat": (WXYZ, (1, 2)),
    "mju_quat2Vel": (WXYZ, (1,)),
}
"""Functions that take quaternions: in which order, and which arguments these are."""
PLACES = {WXYZ: {"w": 0, "x": 1, "y": 2, "z": 3}, XYZW: {"x": 0, "y": 1, "z": 2, "w": 3}}
TURNED = {(1, 2, 3, 0): (WXYZ, XYZW), (3, 0, 1, 2): (XYZW, WXYZ)}
"""The places from which elements are taken: the order before, and after."""
FORMULAS = {frozenset({frozenset({0, 1}), frozenset({2, 3})}): (XYZW, WXYZ),
            frozenset({frozenset({0, 3}), frozenset({1, 2})}): (WXYZ, XYZW)}  # fmt: skip
"""Which elements are multiplied in the sine of the yaw, and in that of the roll: in which orders."""
YAW_WORDS, ROLL_WORDS = {"yaw", "heading"}, {"roll"}
DEEPEST = 12


class QuaternionOrders:
    """Finds the orders, and where they are mistaken."""

    def __init__(self, noted: NotedEpisodes) -> None:
        self.noted, self.definitions, self.source = noted, noted.definitions, noted.source
        self._fields = BulletFields(self.definitions)

    def find_mistakes(self, rule: Rule) -> Iterator[RuleFinding]:
        """Yield the pieces of code that read a quaternion in another order than it has."""
        for function in self.noted.own_functions:
            for node in walk_own(function):
                for quaternion, wanted, text in self._list_uses(node, function):
                    order = self.find(ReadExpression(quaternion, function))
                    if order is not None and order != wanted:
                        message = f"{text} takes {write_code(quaternion)} for a quaternion {wanted}; it is {order}"
                        place = self.source.find_place(quaternion)
                        yield RuleFinding(rule, message, {"element": text, "value": order}, where=place)

    def _list_uses(self, node: ast.AST, function: Function) -> Iterator[tuple[ast.expr, str, str]]:
        """Yield quaternions, the order in which a piece of code takes them, and this code."""
        match node:
            case ast.Assign(targets=[ast.Tuple(elts=targets)], value=value) if len(targets) == 4:
                letters = [_read_letter(target) for target in targets]
                for order, places in PLACES.items():
                    if letters == [*places]:
                        yield value, order, write_code(node)
            case ast.Assign(targets=[target], value=ast.Subscript(value=owner) as value):
                place, letter = _read_place(value), _read_letter(target)
                for order, places in PLACES.items():
                    if letter == "w" and places[letter] == place:
                        yield owner, order, write_code(node)
            case ast.Assign(targets=[target], value=value) if _is_free_orientation(target) or read_name(target) in (
                "mocap_quat",
                "body_quat",
            ):
                yield value, WXYZ, write_code(node)
            case ast.Call(args=args) if read_name(node.func) in TAKING:
                order, which = TAKING[read_name(node.func)]
                for place in which:
                    if place < len(args):
                        yield args[place], WXYZ if _is_scalar_first(node) else order, write_code(node)
            case ast.BinOp(left=left, op=ast.Add(), right=right):
                multiplied, pairs = _read_products(left, right)
                orders = FORMULAS.get(pairs)
                words = self._list_names(node, function)
                if multiplied is not None and orders and bool(words & YAW_WORDS) != bool(words & ROLL_WORDS):
                    yield multiplied, orders[0 if words & YAW_WORDS else 1], write_code(node)
            case ast.Subscript() | ast.List() | ast.Call():
                if (turned := read_turned(node)) is not None:
                    yield turned[0], turned[1][0], write_code(node)

    def _list_names(self, node: ast.AST, function: Function) -> set[str]:
        statement = self.source.find_statement(node)
        targets = statement.targets if isinstance(statement, ast.Assign) else []
        texts = [read_name(target) for target in targets] or [function.name]
        return {word for text in texts for word in split_name(text)}

    def find(self, place: ReadExpression, depth: int = 0) -> str | None:
        """Return the order of a quaternion; None where it is not known."""
        node, name = place.node, read_name(place.node)
        if depth > DEEPEST:
            return None
        inner = read_converted(node)
        if inner is not None:
            return self.find(place.at(inner), depth + 1)
        turned = read_turned(node)
        if turned is not None:
            return turned[1][1]
        match node:
            case ast.BinOp(left=left, op=ast.Div() | ast.Mult()):
                return self.find(place.at(left), depth + 1)
            case ast.UnaryOp(operand=part) | ast.Attribute(value=part, attr="T"):
                return self.find(place.at(part), depth + 1)
            case ast.List(elts=parts) | ast.Tuple(elts=parts):
                return read_literal(parts)
            case ast.Call(func=ast.Attribute(attr="as_quat")):
                return WXYZ if _is_scalar_first(node) else XYZW
            case ast.Call(func=ast.Attribute(attr="array" | "asarray" | "stack"), args=[part, *_]):
                return self.find(place.at(part), depth + 1)
        if _is_free_orientation(node):
            return WXYZ
        field = self._fields.find_field(node) if isinstance(node, ast.Subscript) else None
        if field is not None:
            return XYZW if (field.function, field.field) in TURN_FIELDS else None
        found = {self.find(one, depth + 1) for one in self.definitions.follow(place)} or {
            self._find_unpacked(node, place.function)
        }
        order = found.pop() if len(found) == 1 else None
        if order is not None:
            return order
        if isinstance(node, ast.Subscript) and not isinstance(node.slice, ast.Slice):
            return self.find(place.at(node.value), depth + 1)
        is_own = name in self.definitions.functions or read_key(node) in self.definitions.assigned
        if isinstance(node, ast.Attribute | ast.Call) and name in SOURCES and not is_own:
            return SOURCES[name]
        words = "".join(split_name(name))
        return next((order for order, letters in ((WXYZ, "wxyz"), (XYZW, "xyzw")) if words.endswith(letters)), None)

    def _find_unpacked(self, node: ast.expr, function: Function) -> str | None:
        """Return the order of a name to which the second part of a pose is unpacked."""
        several = [one for one in list_assignments(function) if ast.unparse(one.target) == ast.unparse(node)]
        calls = [read_name(one.value.func) for one in several if isinstance(one.value, ast.Call)]
        is_pose = bool(several) and all(one.element == 1 for one in several) and len(calls) == len(several)
        return XYZW if is_pose and {*calls} <= PAIRS else None


def _read_letter(node: ast.expr) -> str:
    name = read_name(node).lower().lstrip("_")
    return (
        name.removeprefix("q").removeprefix("_")[:1] if name in {p + a for p in ("", "q", "q_") for a in "wxyz"} else ""
    )


def _read_place(node: ast.Subscript) -> int | None:
    """Return which element of a quaternion, or of several, is read."""
    match node.slice:
        case ast.Constant(value=int(place)) | ast.Tuple(elts=[_, ast.Constant(value=int(place))]):
            return place
        case ast.UnaryOp(op=ast.USub(), operand=ast.Constant(value=int(place))):
            return 4 - place
    return None


def _is_free_orientation(node: ast.expr) -> bool:
    """Say whether an expression is the quaternion of a free joint of MuJoCo: four elements of qpos."""
    match node:
        case ast.Subscript(value=ast.Attribute(attr="qpos"), slice=ast.Slice(lower=lower, upper=upper)):
            pass
        case ast.Subscript(
            value=ast.Attribute(attr="qpos"), slice=ast.Tuple(elts=[*_, ast.Slice(lower=lower, upper=upper)])
        ):
            pass
        case _:
            return False
    match lower, upper:
        case ast.Constant(value=int(first)), ast.Constant(value=int(last)):
            return last - first == 4
        case ast.BinOp(left=a, op=ast.Add(), right=ast.Constant(value=3)), ast.BinOp(
            left=b, op=ast.Add(), right=ast.Constant(value=7)
        ):
            return ast.unparse(a) == ast.unparse(b)
    return False


def _read_products(left: ast.expr, right: ast.expr) -> tuple[ast.expr | None, frozenset[frozenset[int]]]:
    """Return the quaternion of which `q[3] * q[2] + q[0] * q[1]` multiplies elements, and which; None for others."""
    pairs: list[frozenset[int]] = []
    owners: dict[str, ast.expr] = {}
    for one in (left, right):
        match one:
            case ast.BinOp(left=ast.Subscript(value=a) as first, op=ast.Mult(), right=ast.Subscript(value=b) as second):
                places = _read_place(first), _read_place(second)
                pairs.append(frozenset(place for place in places if place is not None))
                owners |= {ast.unparse(a): a, ast.unparse(b): b}
    is_whole = len(pairs) == 2 and len(owners) == 1
    return (next(iter(owners.values())), frozenset(pairs)) if is_whole else (None, frozenset())


def read_turned(node: ast.AST) -> tuple[ast.expr, tuple[str, str]] | None:
    """Return a quaternion whose elements are put into another order, that which it has, and that which it gets."""
    match node:
        case ast.Subscript(value=owner, slice=ast.List() | ast.Tuple() as index) if index.elts:
            places = index.elts[-1].elts if isinstance(index.elts[-1], ast.List) else index.elts
            found = tuple(one.value for one in places if isinstance(one, ast.Constant))
            return (owner, TURNED[found]) if found in TURNED and isinstance(node.ctx, ast.Load) else None
        case ast.List(elts=[ast.Subscript(), ast.Subscript(), ast.Subscript(), ast.Subscript()] as parts):
            owners = {ast.unparse(one.value) for one in parts if isinstance(one, ast.Subscript)}
            found = tuple(_read_place(one) for one in parts if isinstance(one, ast.Subscript))
            return (parts[0].value, TURNED[found]) if len(owners) == 1 and found in TURNED else None  # type: ignore
        case ast.Call(func=ast.Attribute(attr="roll"), args=[owner, shift, *_]):
            turned = {"-1": (1, 2, 3, 0), "1": (3, 0, 1, 2)}.get(ast.unparse(shift))
            return (owner, TURNED[turned]) if turned else None
    return None


def read_literal(parts: Sequence[ast.expr]) -> str | None:
    """Return the order in which a rotation by half an angle's sine and cosine is written."""
    kinds = [_read_half(part) for part in parts]
    if len(kinds) != 4 or kinds.count("cos") != 1 or "sin" not in kinds:
        return None
    return {0: WXYZ, 3: XYZW}.get(kinds.index("cos"))


def _read_half(node: ast.expr) -> str:
    calls = [read_name(one.func) for one in ast.walk(node) if isinstance(one, ast.Call)]
    return calls[0] if len(calls) == 1 and calls[0] in ("sin", "cos") else ""


def _is_scalar_first(call: ast.Call) -> bool:
    words = [word.value for word in call.keywords if word.arg == "scalar_first"]
    return any(isinstance(one, ast.Constant) and one.value is True for one in words)
