"""RL839: another field is read."""

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
        the angular velocity of a base as the linear one. The numbers look plausible and are wrong.
    """,
    fix="""
        Read the place that the documentation of the function names: getJointState has position, velocity, reaction
        forces, torque; getBaseVelocity linear, angular; getContactPoints at 5 and 6 positions, 7 the normal, 8 the
        distance, 9 the normal force; getLinkState at 4 and 5 the frame of the link, 6 and 7 its velocities.
    """,
)


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
