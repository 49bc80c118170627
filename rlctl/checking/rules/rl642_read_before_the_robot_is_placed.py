"""RL642: read before the robot is placed."""

import ast
from collections.abc import Iterator

import numpy as np

from rlctl.checking.early_readings import EarlyReadings
from rlctl.checking.experiments.expressions import NotedEpisodes, judges_expressions
from rlctl.checking.rule import Rule, RuleFinding, Severity
from rlctl.checking.source_code import write_code

RULE = Rule(
    "RL642",
    "read before the robot is placed",
    Severity.WARNING,
    meaning="""
        A reset keeps where the robot starts, such as its heading, its height or its distance to the goal, and places
        the robot or the goal only afterwards. What is kept is that of the last episode, or of the model as it was
        built, and what steps subtract from it, such as progress or a turn, is wrong by another number in each
        episode. The check evaluated the expression once more at the end of the reset, and it was another number.
    """,
    fix="Read it at the end of reset, after all is placed; in MuJoCo after mj_forward, too.",
)


@judges_expressions(RULE)
def _find_early(noted: NotedEpisodes) -> Iterator[RuleFinding]:
    for one in EarlyReadings(noted).find():
        text = write_code(one.assignment.statement)
        message = f"{text} reads {_write(one.kept)}, and at the end of the same reset {one.value.text} is"
        message += f" {_write(one.later)}: what it is computed from is set afterwards, and {one.difference.whole.text}"
        message += " is wrong from the first step on"
        place = noted.source.find_place(one.assignment.statement)
        evidence = {"element": ast.unparse(one.assignment.target), "call": "reset"}
        yield RuleFinding(RULE, message, evidence, where=place, same=("RL303", "RL815"))
        return


def _write(value: object) -> str:
    return ", ".join(f"{number:.4g}" for number in np.ravel(value)[:4])  # type: ignore[call-overload]
