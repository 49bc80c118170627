"""RL104: observation not finite."""

from collections.abc import Iterator

import numpy as np

from rlctl.checking.experiment import judges_records
from rlctl.checking.observations import name_moment
from rlctl.checking.records import Records
from rlctl.checking.rule import Rule, RuleFinding, Severity

RULE = Rule(
    "RL104",
    "observation not finite",
    Severity.ERROR,
    meaning="An observation is NaN or infinite. One such number turns all weights of a network into NaN.",
    fix="""
        Find the division, square root or diverging simulation that causes it; np.nan_to_num would only hide it.
    """,
)


@judges_records(RULE)
def _find_not_finite(records: Records) -> Iterator[RuleFinding]:
    built = records.require_built()
    for index, _ in enumerate(built.leaves):
        first = next((pair for pair in records.series(index) if not np.isfinite(pair[1].rows).all()), None)
        if first is not None:
            trajectory, series = first
            row, flat = np.argwhere(~np.isfinite(series.rows))[0].tolist()
            step, element, value = int(series.steps[row]), built.element(index, flat), str(series.rows[row, flat])
            evidence = trajectory.at(step, element=element, value=value, expected="finite")
            yield RuleFinding(RULE, f"{element} is {value} {name_moment(step)}", evidence)
