"""RL001: import."""

from collections.abc import Iterator

from rlctl.checking.experiments.build import FailedBuild, explains_failures
from rlctl.checking.rule import Rule, RuleFinding, Severity

RULE = Rule(
    "RL001",
    "import",
    Severity.ERROR,
    meaning="""
        The module cannot be imported, so there is nothing to train on. Where one error led to another, the
        message has both.
    """,
    fix="""
        Repair the line that the message names; `python -c "import my_module"` shows the whole traceback.
    """,
    needs_instance=False,
)


@explains_failures(RULE, place=50)
def _explain_import(failed: FailedBuild) -> Iterator[RuleFinding]:
    if failed.context.progress.read().call == "load":
        yield RuleFinding(RULE, failed.message_from_first, failed.details, fix=failed.fix, where=failed.where)
