"""RL705: action changed in place."""

from collections.abc import Iterator

from rlctl.checking.experiment import judges_records
from rlctl.checking.records import Records
from rlctl.checking.rule import Rule, RuleFinding, Severity

RULE = Rule(
    "RL705",
    "action changed in place",
    Severity.WARNING,
    meaning="""
        step writes into the action that it was given, for example by `action *= 0.5` or np.clip(...,
        out=action). A training that stores the action after step then stores another one than the policy chose,
        and learns from the wrong pair.
    """,
    fix="Write action = 0.5 * action, or begin step with action = np.array(action).",
)


@judges_records(RULE)
def _find_changed_actions(records: Records) -> Iterator[RuleFinding]:
    for episode, form in records.forms("action")[:1]:
        message = (
            f"step {form.step} wrote into the action that it was given, as did {form.count} of {episode.steps} steps"
        )
        yield RuleFinding(RULE, message, episode.at(form.step, steps=form.count))
