"""Where the source compares the ids of contacts with ids of another kind, or looks one part up twice."""

import ast
import collections
from collections.abc import Collection, Iterator, Sequence

from rlctl.checking.assignments import CONVERSIONS, read_name
from rlctl.checking.bullet_fields import DISTANCE, NORMAL_FORCE, BulletFields
from rlctl.checking.definitions import Definitions
from rlctl.checking.expressions import NotedCall
from rlctl.checking.rule import Rule, RuleFinding
from rlctl.checking.source_code import SourceCode
from rlctl.checking.term_names import split_name

KINDS = {"geom": "geom", "body": "body", "joint": "joint", "jnt": "joint", "site": "site", "actuator": "actuator"}
LOADERS = {"loadURDF", "createMultiBody", "loadMJCF", "loadSDF"}
POINT_KINDS = {1: {"body"}, 2: {"body"}, 3: {"link"}, 4: {"link"}}  # by fields of a contact point of PyBullet
LOOKUPS = {"id", "name2id", "index", "find", "link", "joint", "geom", "body", "site", "sensor", "actuator"}
CONTACT_WORDS = {"touch", "touches", "touching", "contact", "contacts"}
FEWEST = 10
DEEPEST = 6  # assignments that are followed


class Ids:
    """Of which kind the ids are that expressions hold: those of geoms, bodies, joints, sites, actuators, or links."""

    def __init__(self, definitions: Definitions) -> None:
        self._definitions, self._fields = definitions, BulletFields(definitions)

    def find(self, node: ast.expr, depth: int = 0) -> set[str]:
        """Return the kinds of an expression, or of what it holds; empty for what is not known."""
        if depth > DEEPEST:
            return set()
        match node:
            case ast.Attribute(attr="geom1" | "geom2"):
                return {"geom"}
            case ast.Subscript(value=ast.Attribute(attr="geom", value=ast.expr() as owner)) if self.is_contact(owner):
                return {"geom"}
            case ast.Subscript(value=owner, slice=ast.Constant(value=int(field))) if self.is_point(owner):
                return POINT_KINDS.get(field, set())
            case ast.Subscript(value=ast.Attribute(attr=name)) if name in ("geom_bodyid", "body_rootid", "site_bodyid"):
                return {"body"}
            case ast.Attribute(attr="id", value=ast.Call(func=ast.Attribute(attr=name))) if name in KINDS:
                return {KINDS[name]}
            case ast.Call(func=ast.Attribute(attr="mj_name2id"), args=[_, kind, *_]):
                words = ast.unparse(kind).rsplit("mjOBJ_", 1)
                return {KINDS[words[-1].lower()]} if words[-1].lower() in KINDS else set()
            case ast.Call(func=ast.Attribute(attr=name)) if name in LOADERS:
                return {"body"}
            case ast.List(elts=parts) | ast.Tuple(elts=parts) | ast.Set(elts=parts):
                return {kind for part in parts for kind in self.find(part, depth + 1)}
            case ast.ListComp(elt=part) | ast.SetComp(elt=part) | ast.GeneratorExp(elt=part):
                return self.find(part, depth + 1)
            case ast.Call(func=function, args=[part, *_]) if read_name(function) in (
                *("set", "list", "tuple", "sorted", "frozenset", "int", *CONVERSIONS),
            ):
                return self.find(part, depth + 1)
            case ast.Name() | ast.Attribute():
                return self._unite(self._definitions.read(node), depth)
            case ast.Call():
                return self._unite(self._definitions.read_returned(node), depth)
        return set()

    def _unite(self, values: Sequence[ast.expr], depth: int) -> set[str]:
        found = [self.find(value, depth + 1) for value in values]
        return set[str]().union(*found) if found and all(found) else set()

    def is_point(self, node: ast.expr) -> bool:
        """Say whether an expression is a contact point of PyBullet."""
        return self._fields.find_row(node) == "getContactPoints"

    def is_contact(self, node: ast.expr) -> bool:
        """Say whether an expression is called a contact, or several."""
        return bool({"contact", "contacts", "con", "c"} & set(split_name(ast.unparse(node).rsplit(".", 1)[-1])))


def find_wrong_ids(
    rule: Rule, definitions: Definitions, episodes: Sequence[Sequence[NotedCall]]
) -> Iterator[RuleFinding]:
    """Yield comparisons of the ids of contacts with those of another kind, and of a distance that is never so large."""
    ids = Ids(definitions)
    for one in definitions.source.expressions:
        if not isinstance(one.node, ast.Compare):
            continue
        left, right = one.node.left, one.node.comparators[0]
        values = [value for episode in episodes for call in episode for value in call.values.get(one.number, ())]
        if isinstance(one.node.ops[0], ast.Eq | ast.NotEq | ast.In | ast.NotIn):
            for contact, others in ((left, right), (right, left)):
                theirs = ids.find(contact)
                for other in _open_literal(others) if theirs in ({"geom"}, {"link"}) and len(values) >= FEWEST else ():
                    wrong = sorted(ids.find(other) - theirs)
                    if not wrong or ids.find(other) & theirs:
                        continue
                    message = (
                        f"{one.text} compares the id of a contact's {min(theirs)} with {ast.unparse(other)}, which is"
                    )
                    message += f" that of a {wrong[0]}: ids of different kinds have nothing to do with each other"
                    yield RuleFinding(rule, message, {"element": one.text, "value": wrong}, where=one.where)
        match left, one.node.ops[0]:
            case ast.Subscript(value=owner, slice=ast.Constant(value=8)), ast.Gt() | ast.GtE() if ids.is_point(owner):
                if len(values) >= FEWEST and not any(values):
                    message = f"{one.text} was false for all {len(values)} contact points: field {DISTANCE} of a"
                    message += (
                        " contact point is the distance, and below 0 where bodies touch; the normal force is field 9"
                    )
                    evidence = {"element": one.text, "value": len(values)}
                    yield RuleFinding(rule, message, evidence, fix=NORMAL_FORCE, where=one.where)


def _open_literal(node: ast.expr) -> list[ast.expr]:
    return node.elts if isinstance(node, ast.Set | ast.Tuple | ast.List) else [node]


def find_doubled_ids(rule: Rule, source: SourceCode, evaluated: Collection[ast.AST]) -> Iterator[RuleFinding]:
    """Yield lists in which one part is looked up twice by its name, in classes whose functions were evaluated."""
    for file, tree in source.trees.items():
        classes = [node for node in ast.walk(tree) if isinstance(node, ast.ClassDef)]
        own = [one for one in classes if one.name in source.classes or any(node in evaluated for node in one.body)]
        for node in (node for one in own for node in ast.walk(one)):
            if not isinstance(node, ast.List | ast.Tuple) or len(node.elts) < 2:
                continue
            texts = [ast.unparse(part) for part in node.elts if _is_lookup(part)]
            doubled = [text for text, count in collections.Counter(texts).items() if count > 1]
            if doubled and len(texts) == len(node.elts):
                message = f"{ast.unparse(node)} looks up {doubled[0]} twice: another part of the list is left out"
                yield RuleFinding(rule, message, {"element": doubled[0]}, where=(file, node.lineno))
        for node in (node for one in own for node in ast.walk(one)):
            if (what := _find_repeated(node)) is not None:
                message = f"{ast.unparse(node)} asks {what}: another part is left out"
                yield RuleFinding(rule, message, {"element": ast.unparse(node)}, where=(file, node.lineno))  # type: ignore[attr-defined]


def _find_repeated(node: ast.AST) -> str | None:
    """Say which contact a list asks for twice, or for each of several parts."""
    match node:
        case ast.List(elts=parts) | ast.Tuple(elts=parts) if len(parts) > 1:
            texts = [ast.unparse(part) for part in parts if _is_contact(part)]
            doubled = [text for text, count in collections.Counter(texts).items() if count > 1]
            if doubled and len(texts) == len(parts):
                return f"for {doubled[0]} twice"
        case ast.ListComp(elt=part, generators=[loop]) | ast.GeneratorExp(elt=part, generators=[loop]):
            names = {one.id for one in ast.walk(loop.target) if isinstance(one, ast.Name)}
            read = {one.id for one in ast.walk(part) if isinstance(one, ast.Name)}
            is_meant = not any(name.startswith("_") for name in names) and not read & names
            if is_meant and not loop.ifs and _is_contact(part):
                return f"for {ast.unparse(part)} each time"
    return None


def _is_contact(node: ast.expr) -> bool:
    """Say whether a call asks for the contact of a part."""
    if not isinstance(node, ast.Call) or not node.args:
        return False
    return bool({*split_name(read_name(node.func))} & CONTACT_WORDS)


def _is_lookup(node: ast.expr) -> bool:
    """Say whether an expression is an id that is looked up by a name, with nothing else that tells them apart."""
    calls = [one for one in ast.walk(node) if isinstance(one, ast.Call)]
    for call in calls:
        name = call.func.attr if isinstance(call.func, ast.Attribute) else ast.unparse(call.func)
        is_named = any(isinstance(one, ast.Constant) and isinstance(one.value, str) for one in call.args)
        is_id = (isinstance(node, ast.Attribute) and node.attr == "id") or "id" in name or "index" in name
        if is_named and is_id and set(split_name(name.replace("2", "_"))) & LOOKUPS:
            return True
    return False
