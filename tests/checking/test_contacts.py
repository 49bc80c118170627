"""RL825: any contact counts, also that of feet with the ground or of an object with the table."""

import pytest

from tests.checking.judging import case, check_case, findings, found, mark_slow

pytest.importorskip("mujoco")
CONTACTS = "broken_contacts.py"


def broken(name, twin, **settings):
    return case(f"{CONTACTS}:{name}", ("RL825", "warning"), twin=f"{CONTACTS}:{twin}", slow=True, **settings)


CASES = [
    broken("RL825PusherCubeTouchesAnything", "PusherTouches", pybullet=True),
    broken("RL825PusherAnything", "PusherTouches", pybullet=True),
    broken("RL825PusherAnythingWithNoise", "PusherTouches", pybullet=True),
    broken("RL825CrawlerStands", "CrawlerBumps", pybullet=True),
    broken("RL825PuckEndsOnTheGround", "PuckWithWall", pybullet=True),
    broken("RL825ArmAnything", "ArmBumps"),
    broken("RL825CartStands", "CartBumps"),
    broken("RL825FlyerAnything", "FlyerBumps"),
]


@pytest.mark.parametrize("case", mark_slow(CASES), ids=lambda case: case.broken)
def test_finds_the_mistake_and_only_that(case):
    check_case(case)


@pytest.mark.slow
@pytest.mark.pybullet
def test_feet_may_touch_anything():
    assert found(f"{CONTACTS}:CrawlerFeet", "RL825") == set()


@pytest.mark.slow
@pytest.mark.pybullet
def test_finding_names_what_rests():
    (finding,) = findings(f"{CONTACTS}:RL825CrawlerStands", "RL825")
    assert "left_foot of crawler" in finding.message
    assert "differs by 0.3" in finding.message  # the penalty
