"""RL641: time that is never set back."""

import ast
from collections.abc import Iterator

from rlctl.checking.experiments.expressions import NotedEpisodes, judges_expressions
from rlctl.checking.rule import Rule, RuleFinding, Severity
from rlctl.checking.stale_values import StaleValues

RULE = Rule(
    "RL641",
    "time that is never set back",
    Severity.WARNING,
    meaning="""
        A time or a count, such as for how long a goal is held, goes on while a condition holds, has to reach something,
        and is not set back where the condition no longer holds: touching the goal now and then adds up to holding it,
        and what follows from it, such as success, stays for the rest of the episode. The check read it in the source;
        names such as total are left out.
    """,
    fix="Set it to 0 in each step in which the condition does not hold: np.where(inside, self.held + dt, 0.0).",
)


@judges_expressions(RULE)
def _find_never_set_back(noted: NotedEpisodes) -> Iterator[RuleFinding]:
    for one in noted.share(StaleValues).find_never_set_back():
        name = ast.unparse(one.target)
        message = f"{name} goes on under a condition, and no step sets it back where that does not hold"
        place = noted.source.find_place(one.statement)
        yield RuleFinding(RULE, f"{message}: {ast.unparse(one.statement)}", {"element": name}, where=place)
