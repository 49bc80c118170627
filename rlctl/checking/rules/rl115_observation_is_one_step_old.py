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
        step reads the observation before it advances the simulation.
    """,
    fix="Apply the action, advance the simulation, and then read the observation that step returns.",
)


@judges_actions(RULE)
def _find_late_observation(shown: ActionTrials) -> Iterator[RuleFinding]:
    if shown.is_late:
        message = "the first action does not change the observation before step 2: the observation is one step old"
        yield RuleFinding(RULE, message, {"seed": FIRST_SEED, "value": 2, "expected": 1, "step": 1})
