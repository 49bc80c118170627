"""Which of a run's evaluated policies is the best: by success, and by return where success cannot tell."""

import math

from rlctl.policy.file import Score
from rlctl.runs.tables import Rows

_STANDARD_ERRORS = 1.645
"""A success rate is lower beyond this many standard errors: 5 % of equal policies count as lower (one-sided)."""


def is_lower(success: float, highest: float, episodes: float) -> bool:
    """Return whether a success rate is lower than the highest by more than chance, over `episodes` episodes each."""
    pooled = (success + highest) / 2
    standard_error = math.sqrt(max(2 * pooled * (1 - pooled), 0.0) / max(episodes, 1))
    return highest - success > _STANDARD_ERRORS * standard_error


def is_better(new: Score, best: Score | None, highest: float, episodes: float) -> bool:
    """Return whether a policy is better than the best so far: by success, and by return where success cannot tell.

    `highest` is the highest success rate so far, in [0, 1]. Success cannot tell where neither rate is lower than it by
    more than chance; comparing with the highest keeps many small losses from adding up.
    """
    if best is None:
        return True
    if new.success is None or best.success is None:
        return new.mean_return > best.mean_return
    highest = max(highest, new.success)
    new_is_lower, best_is_lower = (is_lower(score.success or 0.0, highest, episodes) for score in (new, best))
    if new_is_lower != best_is_lower:
        return best_is_lower
    return (new.mean_return, new.success) > (best.mean_return, best.success)


def find_best_row(rows: Rows) -> dict[str, float | None] | None:
    """Return the evaluation that selected the training's best policy; None if no row has a return."""
    best_row, best_score, highest = None, None, 0.0
    for row in rows:
        if (mean_return := row.get("return")) is None:
            continue
        score = Score(success=row.get("success"), mean_return=mean_return)
        if is_better(score, best_score, highest, row.get("episodes") or 1):
            best_row, best_score = row, score
        highest = max(highest, score.success or 0.0)
    return best_row
