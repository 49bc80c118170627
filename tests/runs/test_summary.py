"""Which policy is kept as the best: by success, and by return where success cannot tell."""

import pytest

from rlctl.policy.file import Score
from rlctl.runs.best import find_best_row, is_better, is_lower


def score(successes, mean_return, episodes=30):
    return Score(success=None if successes is None else successes / episodes, mean_return=mean_return)


@pytest.mark.parametrize(
    ("new", "best", "highest", "better"),
    [
        (score(None, -3.0), None, 0, True),
        (score(None, -3.0), score(None, -2.0), 0, False),
        (score(None, 5.0), score(3, -2.0), 3, True),  # success is not always reported
        (score(2, 86.0), score(1, 195.0), 1, False),  # 2 against 1 of 30 is chance
        (score(1, 195.0), score(2, 86.0), 2, True),
        (score(20, 1.0), score(5, 9.0), 5, True),
        (score(5, 9.0), score(20, 1.0), 20, False),
        (score(30, 1.0), score(30, 1.0), 30, False),
        (score(29, 1.0), score(28, 1.0), 28, True),
        # Each loss is small, but against the highest it is not: 30 of 30 a while ago.
        (score(25, 9.0), score(28, 3.0), 30, False),
    ],
)
def test_the_better_policy(new, best, highest, better):
    assert is_better(new, best, highest / 30, 30) == better


def test_what_is_lower_by_more_than_chance():
    # 27 and 30 of 30: both 0.95; 1.645 * sqrt(2 * 0.95 * 0.05 / 30) = 0.0926 < 0.1
    assert is_lower(27 / 30, 1.0, 30)
    # 28 and 30: both 0.9667; 1.645 * sqrt(2 * 0.9667 * 0.0333 / 30) = 0.0762 > 0.0667
    assert not is_lower(28 / 30, 1.0, 30)
    assert is_lower(0.0, 1.0, 2)
    assert not is_lower(0.0, 1.0, 1)  # of one episode nothing can be told


def test_the_best_row_is_of_the_policy_that_training_keeps():
    # 1 and 2 of 30 are chance, so the return decides; 20 of 30 is higher than both.
    rows = [
        {"steps": 10.0, "episodes": 30.0, "success": 1 / 30, "return": 195.0},
        {"steps": 20.0, "episodes": 30.0, "success": 2 / 30, "return": 86.0},
    ]
    assert find_best_row(rows) is rows[0]
    rows.append({"steps": 30.0, "episodes": 30.0, "success": 20 / 30, "return": 1.0})
    assert find_best_row(rows) is rows[2]
    assert find_best_row([{"steps": 10.0, "return": None}]) is None


def test_a_success_rate_above_1_in_a_damaged_table_raises_nothing():
    rows = [{"success": 7.0, "return": 1.0, "episodes": 0.0}, {"success": -3.0, "return": 2.0, "episodes": 1.0}]
    assert find_best_row(rows) is rows[0]
