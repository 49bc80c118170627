"""RL002: constructor."""

import traceback
from collections.abc import Iterator

from rlctl.checking.experiments.build import FailedBuild, explains_failures, judges_unreadable
from rlctl.checking.instance import describe
from rlctl.checking.rule import Rule, RuleFinding, Severity
from rlctl.environments.places import find_line

RULE = Rule(
    "RL002",
    "constructor",
    Severity.ERROR,
    meaning="The constructor raises, so there is nothing to train on.",
    fix="""
        Repair what the message names; `rlctl.make("TASK")` in Python, with the same TASK, shows the whole
        traceback.
    """,
    needs_instance=False,
)


@explains_failures(RULE, place=80)  # what no other rule explains
def _explain_constructor(failed: FailedBuild) -> Iterator[RuleFinding]:
    yield RuleFinding(RULE, failed.message_from_first, failed.details, fix=failed.fix, where=failed.where)


@judges_unreadable(RULE)
def _find_unreadable_attribute(error: Exception) -> Iterator[RuleFinding]:
    trace = {"traceback": "".join(traceback.format_exception(error))}
    yield RuleFinding(RULE, f"reading an attribute raises {describe(error)}", trace, where=find_line(error))
