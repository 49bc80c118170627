"""RL646: success where the task is not done."""

import ast
from collections.abc import Iterator

from rlctl.checking.experiments.expressions import NotedEpisodes, judges_expressions
from rlctl.checking.partial_goals import PartialGoalReader
from rlctl.checking.rule import Rule, RuleFinding, Severity, list_names
from rlctl.checking.success_tests import SuccessTests

RULE = Rule(
    "RL646",
    "success where the task is not done",
    Severity.WARNING,
    meaning="""
        A comparison in what the source calls a success is true in states that are none: an error with its sign has to
        be below a tolerance, and was far below 0, without an absolute value; of two errors that have tolerances of
        their own, one is enough; of the errors of several joints or robots, which the reward adds up, the smallest
        one is enough; or a place is compared with some numbers of a goal only, although the others are drawn, too, and
        the whole difference is computed elsewhere. The success rate is then too high, and what success pays is
        paid for something else.
    """,
    fix="""
        Compare sizes, abs(error) < tolerance, join what all has to be met by and, and use all numbers of the goal.
    """,
)


@judges_expressions(RULE)
def _read_success(notes: NotedEpisodes) -> Iterator[RuleFinding]:
    tests = notes.share(SuccessTests)
    for one in tests.find_one_sided():
        text = ast.unparse(one.place.node)
        message = (
            f"{text} is a part of success, and is true for all values below {one.tolerance:.3g}: in the steps that"
        )
        message += f" were played the number was {one.least:.3g} and more"
        yield RuleFinding(RULE, message, {"element": text}, where=notes.reward.locate(one.place))
        return
    for place, either in tests.find_either():
        message = f"one of {list_names([ast.unparse(test.node) for test in either])} is enough for a success, however"
        message += " large the other error is"
        yield RuleFinding(RULE, message, {"element": ast.unparse(place.node)}, where=notes.reward.locate(place))
        return
    for place in tests.find_any():
        text = ast.unparse(place.node)
        message = f"{text} is a part of success: one small number is enough, and the reward adds up all of them"
        yield RuleFinding(RULE, message, {"element": text}, where=notes.reward.locate(place))
        return
    for partial in PartialGoalReader(notes).find():
        text = ast.unparse(partial.place.node)
        message = (
            f"success compares {text}, and {partial.goal}[{partial.left_out}], which differs between episodes, with"
        )
        message += " nothing"
        yield RuleFinding(RULE, message, {"element": text}, where=notes.reward.locate(partial.place))
        return
