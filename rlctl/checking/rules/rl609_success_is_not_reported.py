"""RL609: success is not reported."""

from collections.abc import Iterator

from rlctl.checking import rewards
from rlctl.checking.experiment import judges_records
from rlctl.checking.records import Records
from rlctl.checking.rule import NotJudged, Rule, RuleFinding, Severity
from rlctl.environments.success import SUCCESS

RULE = Rule(
    "RL609",
    "success is not reported",
    Severity.INFO,
    meaning="""
        info has no `is_success`, and no `success` that is a bool, 0 or 1, which counts too. rlctl eval can then
        report no success rate, only returns, which depend on the reward's weights and do not tell whether the
        task is done.
    """,
    fix="Put info['is_success'] = bool(...) into every step's info; with rlctl.task, write is_success().",
)

OTHER_NAMES = ("success", "succeed", "succeeded", "goal_reached", "is_goal")


@judges_records(RULE, *rewards.WITH_SEARCH, of_absence=True)
def _find_unreported_success(records: Records) -> Iterator[RuleFinding]:
    episodes = rewards.require_readable(records)
    if rewards.reports_success(episodes):
        return
    if not any(episode.has_ended for episode in episodes):
        raise NotJudged("no episode ended, and success may be reported at the end only")
    names = dict.fromkeys(name for episode in episodes for name in episode.infos if name.split("/")[-1] in OTHER_NAMES)
    instead = f"; {', '.join(map(repr, names))} in info is not used by any tool" if names else ""
    message = f"is_success is not in info: rlctl eval cannot report a success rate{instead}"
    yield RuleFinding(RULE, message, {"value": list(names), "expected": SUCCESS})
