"""RL626: success of another link than the observed one, in arms and on rails."""

import pytest

from tests.checking.judging import case, check_case, findings, mark_slow

pytest.importorskip("mujoco")


def broken(name, twin, **settings):
    return case(f"broken_links.py:{name}", ("RL626", "warning"), twin=twin, **settings)


CASES = [
    broken("RL626GantryBridge", "broken_links.py:Gantry", slow=True),
    broken("RL626ArmElbow", "mujoco_robots.py:MujocoArm", slow=True),
    broken("RL626ReachElbow", "broken_reach.py:Arm", slow=True),
    broken("RL626ReacherElbow", "broken_reach_bullet.py:Reacher", pybullet=True, slow=True),
    broken("RL626CrankOtherLink", "broken_links.py:CrankPoints", pybullet=True, slow=True),
    broken("RL626CrankGoesItself", "broken_links.py:CrankPlacesCube", pybullet=True, slow=True),
    broken("RL626ArmGoesItself", "broken_links.py:ArmBringsCube", pybullet=True, slow=True),
    broken("RL626ArmAchievesItself", "broken_links.py:ArmAchieves", pybullet=True, slow=True),
]


@pytest.mark.parametrize("case", mark_slow(CASES), ids=lambda case: case.broken)
def test_finds_the_mistake_and_only_that(case):
    check_case(case)


@pytest.mark.slow
def test_the_finding_names_the_link():
    (finding,) = findings("broken_links.py:RL626GantryBridge", "RL626")
    assert finding.message == "is_success is true with self.goal at bridge, and not where observation[4] is 0"
