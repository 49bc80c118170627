"""RL644: left over from the episode before."""

import itertools
from collections.abc import Iterator

from rlctl.checking.experiments.expressions import NotedEpisodes, judges_expressions
from rlctl.checking.left_overs import LeftOvers
from rlctl.checking.rule import Rule, RuleFinding, Severity
from rlctl.checking.source_code import write_code

RULE = Rule(
    "RL644",
    "left over from the episode before",
    Severity.WARNING,
    meaning="""
        Steps make or set something under a condition, such as that a cup has reached a box, and no reset takes it
        back: a constraint or a body of PyBullet that is not removed, a force or a switch of MuJoCo's data, an
        attribute such as held. The next episode then begins with a box that hangs on the cup. Random actions may
        never meet the condition: the check made it true, and read the attribute at the next start. What is to last,
        such as a level or total, is left out.
    """,
    fix="""
        Set back in reset what steps set: removeConstraint before its id is forgotten, mj_resetData, and each
        attribute.
    """,
)


@judges_expressions(RULE)
def _find_left_overs(noted: NotedEpisodes) -> Iterator[RuleFinding]:
    left = LeftOvers(noted)
    every = itertools.chain(left.find_made(), left.find_fields(), left.find_attributes())
    for one in itertools.islice(every, 1):
        evidence = {"element": write_code(one.node)}
        yield RuleFinding(RULE, one.what, evidence, where=one.where, same=("RL303",))
