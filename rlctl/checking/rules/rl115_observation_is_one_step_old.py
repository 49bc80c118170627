"""RL115: observation is one step old."""

from collections.abc import Iterator
from typing import Any

from rlctl.checking.experiments.action_effects import ActionTrials, judges_actions
from rlctl.checking.experiments.attributes import find_declared_numbers
from rlctl.checking.records import FIRST_SEED
from rlctl.checking.rule import Rule, RuleFinding, Severity
from rlctl.checking.term_names import split_name
from rlctl.checking.values import read_attributes

RULE = Rule(
    "RL115",
    "observation is one step old",
    Severity.ERROR,
    meaning="""
        The observation that step returns does not depend on the action of this step, but on the action before; or
        only what repeats the action does, such as the last action. The policy sees each effect one step late, and
        learning gives the credit to the wrong action. Most often step reads the observation before it advances the
        simulation; where the reward too follows only the action before, or the observation has the last action, step
        advances it with that one. Where the reward answers at once, an observation that is several steps old is a
        warning: it may be the oldest entry of a history.
    """,
    fix="""
        Apply the action of this step, advance the simulation, and then read the observation that step returns. A
        delay that is meant belongs to an event, or to a wrapper whose observation has the waiting action.
    """,
)

DELAY_WORDS = {"delay", "delayed", "delays", "fifo", "lag", "latency", "pending", "pipeline", "queue", "queued"}
"""What names a delay that is meant."""


@judges_actions(RULE)
def _find_late_observation(shown: ActionTrials) -> Iterator[RuleFinding]:
    if not shown.is_late:
        return
    (step,) = shown.earliest
    if step > 2:
        yield from _find_older_observation(shown, step)
        return
    severity = Severity.ERROR
    message = "the first action does not change the observation before step 2: the observation is one step old"
    if shown.repeats:
        if _names_delay(shown.trials.instance.env):
            return
        severity = Severity.WARNING
        message = "the first action changes nothing of the observation before step 2 but what repeats the action: "
        message += "it acts one step late"
    elif shown.rewarded == {2}:
        message = "the first action changes neither observation nor reward before step 2: it acts one step late"
    yield RuleFinding(RULE, message, {"seed": FIRST_SEED, "value": 2, "expected": 1, "step": 1}, severity)


def _find_older_observation(shown: ActionTrials, step: int) -> Iterator[RuleFinding]:
    """Yield a finding where the reward answers at once, and nothing names a delay."""
    if shown.rewarded == {1} and not _names_delay(shown.trials.instance.env):
        message = f"the first action changes the reward at once, and the observation not before step {step}: the"
        message += f" observation is {step - 1} steps old"
        yield RuleFinding(
            RULE, message, {"seed": FIRST_SEED, "value": step, "expected": 1, "step": 1}, Severity.WARNING
        )


def _names_delay(env: Any) -> bool:
    """Say whether an attribute, or a number of the environment's class or module, is named after a delay."""
    names = [*read_attributes(env), *find_declared_numbers(env)]
    return any(DELAY_WORDS & set(split_name(name)) for name in names)
