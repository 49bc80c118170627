"""RL105, RL123, RL124, RL618, RL818: robots on wheels with these mistakes, and with what only looks like one."""

import pytest

from tests.checking.judging import case, check_case, found, mark_slow

pytest.importorskip("mujoco")
FILE = "broken_wheeled_robots.py"

CASES = [
    case(f"{FILE}:RL618BuggyTurnsRound", ("RL618", "warning"), twin=f"{FILE}:Buggy"),
    case(f"{FILE}:RL105BalancerSharesItsWheels", ("RL105", "info"), twin=f"{FILE}:Balancer", slow=True),
    case(f"{FILE}:RL123BalancerSeesX", ("RL123", "warning"), twin=f"{FILE}:Balancer", slow=True),
    case(f"{FILE}:RL124BalancerTurnsBack", ("RL124", "warning"), twin=f"{FILE}:Balancer", slow=True),
]


@pytest.mark.parametrize("case", mark_slow(CASES), ids=lambda case: case.broken)
def test_finds_the_mistake_and_only_that(case):
    check_case(case)


@pytest.mark.slow
def test_speeds_that_change_at_random_are_no_angle():
    assert found(f"{FILE}:Balancer", "RL618") == set()


@pytest.mark.slow
def test_a_count_that_a_reset_leaves_is_no_force():
    # Some repetitions of an episode draw other commands: after 200 steps in all.
    assert found(f"{FILE}:BalancerCountsOn", "RL818") == set()
