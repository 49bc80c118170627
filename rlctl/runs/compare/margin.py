"""The margin of `rlctl runs compare`: whether so many episodes can show that a loss is smaller."""

import math

from rlctl.errors import UsageError
from rlctl.runs.compare.significance import find_least_pairs, find_smallest_loss


def check_margin(margin: float, episodes: int, *, of_success: bool) -> None:
    """Raise `UsageError` for a margin in the success rate that even policies with equal episodes would miss."""
    if not of_success:  # of equal returns the interval has no width
        return
    if margin > 1:
        raise UsageError(f"--margin {margin:g}: a success rate is at most 1; 5 points are 0.05")
    if (loss := find_smallest_loss(episodes)) > margin:
        needed = find_least_pairs(margin)
        enough = f"--episodes {needed} or more can" if math.isfinite(needed) else "no number of episodes can"
        raise UsageError(
            f"--margin {margin:g}: {episodes} episodes cannot exclude that success is lower by {loss:.3g}, even if all "
            f"are equal; {enough}"
        )
