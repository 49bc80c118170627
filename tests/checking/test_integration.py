"""RL823: what the environment moves by its own velocity; RL820: velocities over the wrong time. In both engines."""

import pytest

from tests.checking.judging import case, check_case, findings, mark_slow

pytest.importorskip("mujoco")


def broken(name, twin, **settings):
    return case(f"broken_integration.py:{name}", ("RL823", "warning"), twin=twin, **settings)


def measures(robot, **settings):
    file = "broken_integration.py"
    twin = f"{file}:{robot}Measures"
    return case(f"{twin}PerPhysicsStep", ("RL820", "warning"), twin=twin, slow=True, **settings)


CART, BELT = "broken_integration.py:RL823CartIsPushed", "broken_integration.py:RL823PusherWithABelt"
CASES = [
    broken("RL823FlyerTwice", "broken_turned.py:Flyer", slow=True),
    broken("RL823CartTwice", CART, slow=True),
    broken("RL823ArmTwice", "mujoco_robots.py:MujocoArm", slow=True),
    broken("RL823HopperTwice", "mujoco_robots.py:MujocoHopper", slow=True),
    broken("RL823BulletArmTwice", "robots.py:Arm", pybullet=True, slow=True),
    broken("RL823PusherTwice", BELT, pybullet=True, slow=True),
    broken("RL823CrawlerTwice", "robots.py:Crawler", pybullet=True, slow=True),
    measures("Flyer"),
    measures("Cart"),
    measures("Puck", pybullet=True),
    measures("Crawler", pybullet=True),
    measures("Pusher", pybullet=True),
]


@pytest.mark.parametrize("case", mark_slow(CASES), ids=lambda case: case.broken)
def test_finds_the_mistake_and_only_that(case):
    check_case(case)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "seconds"), [("RL823CartTwice", 0.01), ("RL823FlyerTwice", 0.02), ("RL823BulletArmTwice", 1 / 30)]
)
def test_finding_names_the_time(name, seconds):
    (finding,) = findings(f"broken_integration.py:{name}", "RL823")
    assert finding.evidence["value"] == pytest.approx(seconds, rel=1e-3)
