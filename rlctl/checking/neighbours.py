"""What happens to an instance that is played beside another one."""

from rlctl.checking.differences import compare, require_independent
from rlctl.checking.experiment import INSTANCES
from rlctl.checking.failures import select_failures
from rlctl.checking.records import Records
from rlctl.checking.rule import NotJudged, Rule, RuleFinding


def require_same_alone(records: Records) -> None:
    """Raise `NotJudged` if instances already differ when each is used alone."""
    if compare(records, "fresh process", "fresh instance") is not None:
        raise NotJudged("two instances already differ when each is used alone (RL301 to RL304)")
    require_independent(records)


def find_failure(records: Records, rule: Rule, phase: str, doing: str) -> RuleFinding | None:
    """Return the finding that a call failed in a phase of the experiment `instances`, and did not when it was alone."""
    alone = {(failure.call, failure.error) for failure in select_failures(records, "raised")}
    for failure in records.failures:
        is_here = failure.process == INSTANCES and failure.phase == phase and failure.call != "build"
        if is_here and (failure.call, failure.error) not in alone:
            return RuleFinding(rule, f"{doing}, {failure.message}", failure.place)
    return None
