"""RL208: ends the process."""

from collections.abc import Iterator

from rlctl.checking.experiment import judges_records
from rlctl.checking.failures import select_failures
from rlctl.checking.instance import display_error
from rlctl.checking.records import Records
from rlctl.checking.rule import Rule, RuleFinding, Severity
from rlctl.environments.graphics import opengl_fix

RULE = Rule(
    "RL208",
    "ends the process",
    Severity.ERROR,
    meaning="A call into the environment crashes or ends the interpreter. In training it ends the worker.",
    fix="""
        Run the episode under `python -X faulthandler`. Often a library is used after close or with an unknown
        id. An environment must not call os._exit.
    """,
)


@judges_records(RULE)
def _find_ends_of_process(records: Records) -> Iterator[RuleFinding]:
    without_opengl = any(opengl_fix(failure.error) for failure in select_failures(records, "raised"))
    # Of a process that ends at once, the last line that says so may be lost: another process has it.
    without_display = {(failure.call, failure.error) for failure in records.failures if display_error(failure)}
    for failure in select_failures(records, "died"):
        if (failure.call, failure.error) not in without_display and not without_opengl:  # RL216 or RL207 says why
            yield RuleFinding(RULE, failure.message, failure.place)
