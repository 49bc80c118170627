"""Which of a run's evaluated policies is the best: by success, and by return where success cannot tell."""

import math

from rlctl.errors import ArtifactError
from rlctl.policy.file import PolicyFile, Score
from rlctl.runs.directory import RunDirectory
from rlctl.runs.tables import TableRows, read_table

_STANDARD_ERRORS = 1.645
"""A success rate is lower beyond this many standard errors: 5 % of equal policies count as lower (one-sided)."""
_MUCH_NEWER = 0.1  # share of the last policy's steps that followed the last evaluation


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


def find_best_row(rows: TableRows) -> dict[str, float | None] | None:
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


def describe_unevaluated_last(run: RunDirectory) -> str | None:
    """Return that a run's last policy is newer than its best and was never evaluated, and the option that plays it.

    None where little training followed the last evaluation, and where a policy cannot be read.
    """
    try:
        evaluated = [int(row["steps"] or 0) for row in read_table(run.evals_file)]
        best, last = (PolicyFile.read_info(file).training_steps for file in (run.best_policy, run.last_policy))
    except ArtifactError:
        return None
    if not evaluated or last <= best or last - evaluated[-1] < _MUCH_NEWER * last:
        return None
    return f"last is {last - best:,} steps newer than best and was never evaluated: --checkpoint last"
