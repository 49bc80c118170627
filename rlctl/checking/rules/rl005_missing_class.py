"""RL005: missing class."""

from collections.abc import Iterator

from rlctl.checking.experiments.build import FailedBuild, explains_failures
from rlctl.checking.rule import Rule, RuleFinding, Severity
from rlctl.errors import NoSuchClassError

RULE = Rule(
    "RL005",
    "missing class",
    Severity.ERROR,
    meaning="The module was imported, but does not define the class.",
    fix="Correct the name after the colon; it is case-sensitive.",
    needs_instance=False,
)


@explains_failures(RULE, place=10)
def _explain_missing_class(failed: FailedBuild) -> Iterator[RuleFinding]:
    if isinstance(failed.error, NoSuchClassError):
        yield RuleFinding(RULE, str(failed.error), failed.details)
