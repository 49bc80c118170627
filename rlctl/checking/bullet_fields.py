"""Which fields of the tuples that PyBullet returns the source reads, and what it calls them."""

import ast
import dataclasses
from collections.abc import Iterator, Mapping, Sequence

from rlctl.checking.assignments import read_name
from rlctl.checking.definitions import Definitions
from rlctl.checking.noted_numbers import NotedNumbers
from rlctl.checking.source_code import Function
from rlctl.checking.term_names import split_name

PLACE, TURN = {"pos", "position", "positions"}, {"orn", "orientation", "quat", "quaternion"}
LINEAR = {"lin", "linear", "linvel", "vx", "vy", "vz"}
ANGULAR = {"ang", "angular", "omega", "gyro", "angvel"}
ANGLED = ANGULAR | {"angle", "attitude", "euler", "rot", "rotation"}
PLAIN = {"vel", "velocity", "speed", "v"}  # of a base: what is angular is called so
TURNS = {"w", "rot", "turn", "turning", "spin", "yaw", "roll", "pitch", "rate", "rates", "wheel", "twist"}
SPEED = {"vel", "vels", "velocity", "velocities", "speed", "speeds", "qvel", "qd", "dq", "qdot", "rate", "rates"}
_POINT = {
    "position": ({5, 6}, PLACE),
    "normal": ({7}, {"normal"}),
    "distance": ({8}, {"dist", "distance", "depth", "penetration", "gap"}),
    "force": ({9, 10, 12}, {"force", "forces", "load", "pressure", "newton", "newtons"}),
}
_JOINT = {"position": ({0}, {*PLACE, "angle", "angles", "qpos"}), "velocity": ({1}, SPEED)}
_LINK = {
    "position": ({0, 2, 4}, PLACE),
    "orientation": ({1, 3, 5}, TURN),
    "linear velocity": ({6}, LINEAR),
    "angular velocity": ({7}, ANGULAR),
}
FIELDS: Mapping[str, Mapping[str, tuple[set[int], set[str]]]] = {
    "getContactPoints": _POINT,
    "getClosestPoints": _POINT,
    "getJointState": _JOINT,
    "getLinkState": _LINK,
    "getBaseVelocity": {"linear velocity": ({0}, LINEAR | PLAIN), "angular velocity": ({1}, ANGULAR | TURNS)},
    "getEulerFromQuaternion": {"roll": ({0}, {"roll"}), "pitch": ({1}, {"pitch"}), "yaw": ({2}, {"yaw", "heading"})},
    "getBasePositionAndOrientation": {"position": ({0}, PLACE), "orientation": ({1}, TURN)},
    "rayTest": {"fraction": ({2}, {"fraction"}), "position": ({3}, PLACE), "normal": ({4}, {"normal"})},
}
"""Where the fields are that have a meaning, by functions, and the words by which they are called."""
OTHER_MEANINGS = {"normal", "offset", "delta", "old", "and", "or", "state", "dot", "error", "change"}
"""Words next to which another one may mean anything: a normal force, a normal at a position."""
LISTS = {"getContactPoints", "getClosestPoints", "getJointStates", "getLinkStates", "rayTest", "rayTestBatch"}
ROWS = {"getJointStates": "getJointState", "getLinkStates": "getLinkState", "rayTestBatch": "rayTest"}
PASSED_ON = {
    *("array", "asarray", "float", "list", "tuple", "sorted", "max", "min", "sum", "mean", "abs", "fabs", "norm"),
    *("append", "extend", "astype", "copy", "round", "clip", "stack", "concatenate"),
}
DEEPEST = 6
DISTANCE, FARTHEST = 8, 0.02  # field of a contact point, and how far apart the bodies of one are at most [m]
NORMAL_FORCE = "Compare the normal force, field 9 of a contact point, with the threshold."


@dataclasses.dataclass(frozen=True)
class ReadField:
    """A field of a tuple of PyBullet that is read."""

    node: ast.expr
    function: str  # of PyBullet
    field: int


class BulletFields:
    """The tuples of PyBullet in a source."""

    def __init__(self, definitions: Definitions) -> None:
        self._source, self._definitions = definitions.source, definitions

    def find_row(self, node: ast.expr, depth: int = 0) -> str:
        """Return the function of PyBullet of which an expression is one tuple; empty for others."""
        if depth > DEEPEST:
            return ""
        match node:
            case ast.Call(func=function):
                name = read_name(function)
                returned = self._definitions.read_returned(node)
                own = self._agree([self.find_row(value, depth + 1) for value in returned])
                return name if name in FIELDS.keys() - LISTS else own
            case ast.Subscript(value=owner, slice=ast.Slice(lower=None | ast.Constant(value=0))):
                return self.find_row(owner, depth + 1)
            case ast.Subscript(value=owner) if not isinstance(node.slice, ast.Slice):
                return self.find_list(owner, depth + 1)
            case ast.Name() if (loop := self._find_loop(node)) is not None:
                return self.find_list(loop, depth + 1)
            case ast.Name() | ast.Attribute():
                return self._agree([self.find_row(value, depth + 1) for value in self._definitions.read(node)])
        return ""

    def find_list(self, node: ast.expr, depth: int = 0) -> str:
        """Return the function of PyBullet of whose tuples an expression is a list; empty for others."""
        if depth > DEEPEST:
            return ""
        match node:
            case ast.Call(func=function, args=args):
                name = read_name(function)
                if name in LISTS:
                    return ROWS.get(name, name)
                if name in ("list", "tuple", "enumerate", "reversed") and args:
                    return self.find_list(args[0], depth + 1)
                returned = self._definitions.read_returned(node)
                return self._agree([self.find_list(value, depth + 1) for value in returned])
            case ast.BoolOp(values=[first, *_]) | ast.Subscript(value=first, slice=ast.Slice()):
                return self.find_list(first, depth + 1)
            case ast.BinOp(left=left, op=ast.Add(), right=right):
                return self._agree([self.find_list(left, depth + 1), self.find_list(right, depth + 1)])
            case ast.ListComp(elt=part) | ast.GeneratorExp(elt=part):
                return self.find_row(part, depth + 1)
            case ast.Name() if self._find_loop(node) is not None:
                return ""
            case ast.Name() | ast.Attribute():
                return self._agree([self.find_list(value, depth + 1) for value in self._definitions.read(node)])
        return ""

    def _agree(self, found: Sequence[str]) -> str:
        return found[0] if len(set(found)) == 1 else ""

    def _find_loop(self, name: ast.Name) -> ast.expr | None:
        """Return through what the loop goes whose variable a name is."""
        node: ast.AST = name
        while not isinstance(node, Function) and node in self._source.parents:
            for loop in [node] if isinstance(node, ast.For) else getattr(node, "generators", ()):
                match loop.target, loop.iter:
                    case ast.Name(id=text), several if text == name.id:
                        return several
                    case ast.Tuple(elts=[_, ast.Name(id=text)]), ast.Call(func=ast.Name(id="enumerate")) if (
                        text == name.id
                    ):
                        return loop.iter
            node = self._source.parents[node]
        return None

    def find_field(self, node: ast.expr, depth: int = 0) -> ReadField | None:
        """Return the field that an expression is, or the sum, mean, largest or smallest of many."""
        match node:
            case ast.Subscript(value=owner, slice=ast.Constant(value=int(field))) if row := self.find_row(owner):
                return ReadField(node, row, field)
            case ast.Call(func=function, args=[part, *_]) if read_name(function) in PASSED_ON and depth < DEEPEST:
                return self.find_field(part, depth + 1)
            case ast.ListComp(elt=part) | ast.GeneratorExp(elt=part) if depth < DEEPEST:
                return self.find_field(part, depth + 1)
            case ast.Name() if self._find_loop(node) is None and depth < DEEPEST:
                values = self._definitions.read(node)
                return self.find_field(values[0], depth + 1) if len(values) == 1 else None
        return None

    def list_read(self, functions: Sequence[Function]) -> Iterator[tuple[ReadField, list[str]]]:
        """Yield the fields that functions read, and what they are called; of names that are unpacked, too."""
        for node in (node for function in functions for node in ast.walk(function)):
            match node:
                case ast.Subscript(value=owner, slice=ast.Constant(value=int(field))) if row := self.find_row(owner):
                    yield ReadField(node, row, field), self._list_names(node)
                case ast.Assign(targets=[ast.Tuple(elts=targets)], value=value) if row := self.find_row(value):
                    yield from self._read_unpacked(targets, row)
                case ast.For(target=ast.Tuple(elts=targets), iter=several) if row := self.find_list(several):
                    yield from self._read_unpacked(targets, row)

    def _read_unpacked(self, targets: Sequence[ast.expr], row: str) -> Iterator[tuple[ReadField, list[str]]]:
        for field, target in enumerate(targets):
            if isinstance(target, ast.Starred):
                return
            if name := read_name(target):
                yield ReadField(target, row, field), [name]

    def _list_names(self, node: ast.expr) -> list[str]:
        """Return what an expression is called: where it is kept, or the function that returns it."""
        below, above = node, self._source.parents[node]
        while True:
            match above:
                case ast.Call() if read_name(above.func) in PASSED_ON:
                    if read_name(above.func) in ("append", "extend") and isinstance(above.func, ast.Attribute):
                        return [read_name(above.func.value)]
                case ast.ListComp(elt=part) | ast.GeneratorExp(elt=part) if part is below:
                    pass
                case ast.List() | ast.Starred() | ast.UnaryOp():
                    pass
                case ast.Subscript(value=owner) if owner is below:
                    pass
                case ast.Attribute():  # `.copy()`
                    pass
                case ast.Tuple(elts=parts) if isinstance(self._source.parents[above], ast.Assign):
                    targets = self._source.parents[above].targets  # type: ignore[attr-defined]
                    several = [
                        one.elts for one in targets if isinstance(one, ast.Tuple) and len(one.elts) == len(parts)
                    ]
                    place = [part is below for part in parts].index(True)
                    return [read_name(elements[place]) for elements in several]
                case ast.Assign(targets=targets):
                    return [name for target in targets if (name := read_name(target))]
                case ast.AugAssign(target=target, op=ast.Add()) | ast.AnnAssign(target=target):
                    return [read_name(target)]
                case ast.Dict(keys=keys, values=values):
                    key = keys[[value is below for value in values].index(True)] if below in values else None
                    return [str(key.value)] if isinstance(key, ast.Constant) else []
                case ast.Return():
                    return [self._source.find_function(above).name]
                case _:
                    return []
            below, above = above, self._source.parents[above]


def find_taken_for_force(
    definitions: Definitions, functions: Sequence[Function], numbers: NotedNumbers
) -> Iterator[tuple[ast.Compare, float]]:
    """Yield comparisons in which the distance of a contact point has to be larger than it can be, and what than."""
    fields = BulletFields(definitions)
    for node in (node for function in functions for node in ast.walk(function)):
        match node:
            case ast.Compare(left=one, ops=[ast.Gt() | ast.GtE()], comparators=[bound]):
                pass
            case ast.Compare(left=bound, ops=[ast.Lt() | ast.LtE()], comparators=[one]):
                pass
            case _:
                continue
        least = numbers.read_constant(bound)
        read = fields.find_field(one)
        is_distance = read is not None and (read.function, read.field) == ("getContactPoints", DISTANCE)
        if is_distance and least is not None and least >= FARTHEST:
            yield node, least


def find_other_meaning(read: ReadField, name: str) -> tuple[str, str, int] | None:
    """Return what a field is, what it is called, and where that would be; None where the name fits, or says nothing."""
    kinds, words = FIELDS[read.function], set(split_name(name))
    own = [kind for kind, (places, _) in kinds.items() if read.field in places]
    called = [kind for kind, (_, its) in kinds.items() if words & its]
    if "force" in called:
        called = [kind for kind in called if kind != "normal"]
    if len(called) != 1 or called[0] in own or (words & OTHER_MEANINGS - kinds[called[0]][1]):
        return None
    if called == ["position"] and "orientation" in kinds and words & ANGLED:
        return None  # an angular position
    if called == ["normal"] and read.field not in (5, 6, 8):
        return None  # the normal force
    return (own[0] if own else "something else"), called[0], min(kinds[called[0]][0])
