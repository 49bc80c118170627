"""RL647: reward is thrown away."""

import ast
from collections.abc import Iterator

from rlctl.checking.discarded_rewards import find_discarded_rewards, find_unread_terms
from rlctl.checking.experiments.expressions import NotedEpisodes, judges_expressions
from rlctl.checking.rule import Rule, RuleFinding, Severity, list_others
from rlctl.checking.source_code import write_code

RULE = Rule(
    "RL647",
    "reward is thrown away",
    Severity.WARNING,
    meaning="""
        A step computes a part of the reward, and the next statement sets the reward to something else instead of
        adding to it: reward = -cost in place of reward -= cost. Nothing reads what was computed before, so that
        progress, say, is not paid. Or it computes a term under a name of its own, such as collision_cost, which
        nothing reads.
    """,
    fix="Add it to the reward, reward += term, or leave out what is not meant to count.",
)


@judges_expressions(RULE)
def _find_discarded(notes: NotedEpisodes) -> Iterator[RuleFinding]:
    for one in find_discarded_rewards(notes):
        text, where = write_code(one.after.statement), notes.source.find_place(one.after.statement)
        message = f"{text} replaces the reward of {write_code(one.before.statement)}, which nothing reads before"
        yield RuleFinding(RULE, message, {"element": text}, where=where)
        return


@judges_expressions(RULE, decides=False)
def _find_unread(notes: NotedEpisodes) -> Iterator[RuleFinding]:
    unread = list(find_unread_terms(notes))
    for first in unread[:1]:
        names = [ast.unparse(one.target) for one in unread]
        message = f"a step computes {names[0]}, and nothing reads it{list_others(names)}"
        yield RuleFinding(RULE, message, {"element": names[0]}, where=notes.source.find_place(first.statement))
