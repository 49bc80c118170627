"""RL842: drawn or timed, and never acts."""

import itertools
from collections.abc import Iterator

from rlctl.checking.experiments.expressions import NotedEpisodes, judges_expressions
from rlctl.checking.idle_draws import IdleDraws
from rlctl.checking.late_events import LateEvents
from rlctl.checking.rule import Rule, RuleFinding, Severity
from rlctl.checking.source_code import write_code

RULE = Rule(
    "RL842",
    "drawn or timed, and never acts",
    Severity.WARNING,
    meaning="""
        A new command, a push or the next goal is to come at a time after each episode's end, or its timer is never
        moved: the check saw how the clock goes on in short episodes, and where the time limit is. Or a reset draws a
        number that nothing reads, or that decides how a robot moves, such as a wind or a mass, and with other draws the
        same actions earn the same to the last bit: it is not written to the engine, or to another body, or the
        equations do not have it. Or reset sets the world back after it has placed the robot, or a line only computes
        something. The policy is trained without it. Events of a task are judged by RL014.
    """,
    fix="""
        Count in the same units, steps or seconds, and let what comes come within max_steps; apply what is drawn in the
        equations, or write it to the engine: changeDynamics, model.body_mass.
    """,
)


@judges_expressions(RULE)
def _find_idle(noted: NotedEpisodes) -> Iterator[RuleFinding]:
    every = itertools.chain(LateEvents(noted).find(), IdleDraws(noted).find())
    for one in itertools.islice(every, 1):
        yield RuleFinding(RULE, one.what, {"element": write_code(one.node)}, where=one.where)
