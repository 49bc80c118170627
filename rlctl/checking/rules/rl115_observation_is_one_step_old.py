"""RL115: observation is one step old."""

from collections.abc import Iterator

from rlctl.checking.experiments.action_effects import ActionTrials, judges_actions
from rlctl.checking.records import FIRST_SEED
from rlctl.checking.rule import Rule, RuleFinding, Severity

RULE = Rule(
    "RL115",
    "observation is one step old",
    Severity.ERROR,
    meaning="""
        The observation that step returns does not depend on the action of this step, but on the action before.
        The policy sees each effect one step late, and learning gives the credit to the wrong action. Most often
        step reads the observation before it advances the simulation; where the reward too follows only the action
        before, step advances it with that one.
    """,
    fix="""
        Apply the action of this step, advance the simulation, and then read the observation that step returns. A
        delay that is meant belongs to an event, or to a wrapper whose observation has the waiting action.
    """,
)


@judges_actions(RULE)
def _find_late_observation(shown: ActionTrials) -> Iterator[RuleFinding]:
    if shown.is_late:
        message = "the first action does not change the observation before step 2: the observation is one step old"
        if shown.rewarded == {2}:
            message = "the first action changes neither observation nor reward before step 2: it acts one step late"
        yield RuleFinding(RULE, message, {"seed": FIRST_SEED, "value": 2, "expected": 1, "step": 1})
