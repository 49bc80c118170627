"""RL835: two contacts in the observation that are those of one foot."""

import pytest

from tests.checking.judging import case, check_case, mark_slow

pytest.importorskip("mujoco")
FILE = "broken_feet.py"


def broken(name, twin, **settings):
    return case(f"{FILE}:{name}", ("RL835", "warning"), twin=f"{FILE}:{twin}", slow=True, **settings)


CASES = [
    broken("RL835HopperFeelsTheLeftTwice", "HopperFeels", pybullet=True),
    broken("RL835HopperWeighsTheBackTwice", "HopperWeighs", pybullet=True),
    broken("RL835CrawlerFeelsTheRightTwice", "CrawlerFeels", pybullet=True),
]


@pytest.mark.parametrize("case", mark_slow(CASES), ids=lambda case: case.broken)
def test_finds_the_mistake_and_only_that(case):
    check_case(case)
