"""RL839: another field is read."""

import ast
from collections.abc import Iterator

from rlctl.checking.bullet_fields import BulletFields, find_other_meaning
from rlctl.checking.experiments.expressions import NotedEpisodes, judges_expressions
from rlctl.checking.rule import Rule, RuleFinding, Severity

RULE = Rule(
    "RL839",
    "another field is read",
    Severity.WARNING,
    meaning="""
        PyBullet returns tuples, whose fields have places and no names. The source reads a field that is something else
        than what the result is called: the torque of a joint as its velocity, the distance of a contact as its force,
        the angular velocity of a base as the linear one. The numbers look plausible and are wrong. Of MuJoCo's
        mj_contactForce, one of the tangential forces is read and never the normal one.
    """,
    fix="""
        Read the place that the documentation of the function names: getJointState has position, velocity, reaction
        forces, torque; getBaseVelocity linear, angular; getContactPoints at 5 and 6 positions, 7 the normal, 8 the
        distance, 9 the normal force; getLinkState at 4 and 5 the frame of the link, 6 and 7 its velocities.
    """,
)

TANGENTIAL = (1, 2)
NORMAL = "Read element 0: the frame of a contact begins with its normal."


@judges_expressions(RULE)
def _find_other_fields(noted: NotedEpisodes) -> Iterator[RuleFinding]:
    source = noted.source
    for read, names in BulletFields(noted.definitions).list_read(noted.functions):
        for name in names:
            if (found := find_other_meaning(read, name)) is None:
                continue
            meaning, called, place = found
            message = f"{name} is field {read.field} of {read.function}, {meaning}: the {called} is field {place}"
            where = source.find_place(read.node)
            yield RuleFinding(RULE, message, {"element": name, "value": read.field}, where=where)
            return


@judges_expressions(RULE)
def _find_tangential_forces(noted: NotedEpisodes) -> Iterator[RuleFinding]:
    for function in noted.functions:
        for node in ast.walk(function):
            match node:
                case ast.Call(func=ast.Attribute(attr="mj_contactForce"), args=[_, _, _, ast.Name(id=name)]):
                    place = _find_only_element(function, name)
                    if place is not None and place in TANGENTIAL:
                        message = f"{name}[{place}] of mj_contactForce is a tangential force, in the frame of the"
                        message += f" contact: the normal force is {name}[0], which nothing reads"
                        where = noted.source.find_place(node)
                        yield RuleFinding(RULE, message, {"element": name, "value": place}, where=where, fix=NORMAL)
                        return


def _find_only_element(function: ast.AST, name: str) -> int | None:
    """Return which element of an array a function reads, where it is one, and nothing else is done with the array but
    to give it to one call."""
    reads = [node for node in ast.walk(function) if isinstance(node, ast.Name) and node.id == name]
    inside: list[ast.expr] = []
    places: set[int] = set()
    for node in ast.walk(function):
        match node:
            case ast.Subscript(value=owner, slice=ast.Constant(value=int(place))) if owner in reads:
                inside.append(owner)
                places.add(place)
    others = [read for read in reads if read not in inside and isinstance(read.ctx, ast.Load)]
    return places.pop() if len(places) == 1 and len(others) == 1 else None
