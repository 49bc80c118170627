"""RL006: constructor needs arguments."""

import re
from collections.abc import Iterator

from rlctl.checking.experiments.build import FailedBuild, explains_failures
from rlctl.checking.rule import Rule, RuleFinding, Severity
from rlctl.environments.places import find_line
from rlctl.environments.registrations import describe_registrations
from rlctl.errors import read_message

RULE = Rule(
    "RL006",
    "constructor needs arguments",
    Severity.ERROR,
    meaning="The constructor has arguments without a default. Tools build environments without arguments.",
    fix="Give the constructor's arguments default values.",
    needs_instance=False,
)


@explains_failures(RULE, place=60)
def _explain_missing_arguments(failed: FailedBuild) -> Iterator[RuleFinding]:
    missing = _find_missing_arguments(failed.cause)
    if missing:
        settings = " ".join(f"--set task.{name}=..." for name in missing)
        fix = f"Give them ({settings}), or give them default values."
        registered = describe_registrations(failed.context.spec.task, "check-env")
        if registered:
            fix = f"{fix} The class is {registered}"
        yield RuleFinding(RULE, failed.message_from_first, failed.details, fix=fix)


def _find_missing_arguments(cause: BaseException | None) -> list[str]:
    """Return the arguments that the call of the constructor lacked; none if the error is of code that it runs."""
    if not isinstance(cause, TypeError) or find_line(cause) is not None:
        return []
    missing = re.search(r"missing \d+ required .*?arguments?: (.*)", read_message(cause))
    return re.findall(r"'(\w+)'", missing[1]) if missing else []
