"""RL302: trajectory not repeatable."""

from collections.abc import Iterator

from rlctl.checking.differences import compare_itself
from rlctl.checking.experiment import judges_records
from rlctl.checking.records import Records
from rlctl.checking.rule import Rule, RuleFinding, Severity

RULE = Rule(
    "RL302",
    "trajectory not repeatable",
    Severity.ERROR,
    meaning="""
        One instance, seed and sequence of actions give two different trajectories: something random does not
        depend on the seed, or reset does not reset everything.
    """,
    fix="""
        Call super().reset(seed=seed) first, and draw only from self.np_random; use no np.random.*, random.* or time.
        Reset every attribute that step changes.
    """,
    task_fix="""
        Draw only from `rng`, the argument of reset; use no np.random.*, random.*, default_rng() or time. Reset
        every attribute that act changes.
    """,
    shows_one=True,
)


@judges_records(RULE, "comparisons", "instances")
def _compare_repetition(records: Records) -> Iterator[RuleFinding]:
    return compare_itself(RULE, records, "played twice by one instance", at_reset=False)
