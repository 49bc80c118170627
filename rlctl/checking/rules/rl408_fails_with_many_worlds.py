"""RL408: fails with many worlds."""

from collections.abc import Iterator

from rlctl.checking.experiments.batches import WORLDS, judges_failures
from rlctl.checking.instance import EnvironmentRaised, describe
from rlctl.checking.rule import Rule, RuleFinding, Severity
from rlctl.environments.places import find_line

RULE = Rule(
    "RL408",
    "fails with many worlds",
    Severity.ERROR,
    meaning="""
        A BatchTask works with one world, and raises or returns too few rows with several. An axis is summed
        away, or an array has one row for all worlds.
    """,
    fix="""
        Return a row per world: np.zeros(self.worlds), not np.zeros(1); np.sum(x, axis=-1) for x of shape
        (worlds, n).
    """,
)


@judges_failures(RULE)
def _report_failure(error: EnvironmentRaised) -> Iterator[RuleFinding]:
    message = f"{error.call} with {WORLDS} worlds raises {describe(error.cause)}"
    yield RuleFinding(RULE, message, {"call": error.call, "worlds": WORLDS}, where=find_line(error.cause))
