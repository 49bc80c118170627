"""RL301: seed does not determine the start."""

from collections.abc import Iterator

from rlctl.checking.differences import compare_itself
from rlctl.checking.experiment import judges_records
from rlctl.checking.records import Records
from rlctl.checking.rule import Rule, RuleFinding, Severity

RULE = Rule(
    "RL301",
    "seed does not determine the start",
    Severity.ERROR,
    meaning="Two resets of one instance with one seed give different first observations.",
    fix="""
        Call super().reset(seed=seed) first, and draw only from self.np_random; use no np.random.*, random.* or time,
        and no sample() of a space, which reset does not seed.
    """,
    task_fix="""
        Draw only from `rng`, the argument of reset; use no np.random.*, random.*, default_rng() or time.
    """,
    shows_one=True,
)


@judges_records(RULE, "comparisons", "instances")
def _compare_resets(records: Records) -> Iterator[RuleFinding]:
    return compare_itself(RULE, records, "reset twice with one seed", at_reset=True)
