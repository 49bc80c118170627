"""RL119, RL624, RL625, RL706: what is a hundred times too small or too large is found in robots that differ."""

import pytest

from tests.checking.judging import case, check_case, findings, mark_slow

pytest.importorskip("mujoco")


def broken(name, twin, *rules, **settings):
    expected = [(rule, "warning") for rule in rules]
    return case(f"broken_scales.py:{name}", *expected, twin=twin, **settings)


REACHER = "broken_reach_bullet.py:Reacher"
CASES = [
    broken("RL625RoverOnePercent", "broken_meaning.py:Rover", "RL625", slow=True),
    broken("RL625ReachOnePercent", "broken_reach.py:Arm", "RL625", slow=True),
    broken("RL625RL706ReacherOnePercent", REACHER, "RL625", "RL706", pybullet=True, slow=True),
    broken("RL625BoatOnePercent", "broken_progress.py:BoatSeeks", "RL625", pybullet=True, slow=True),
    broken("RL625FlyerOnePercent", "broken_progress.py:FlyerSeeks", "RL625", pybullet=True, slow=True),
    broken("RL706ArmOnePercent", "mujoco_robots.py:MujocoArm", "RL706", slow=True),
    broken("RL706HopperOnePercent", "mujoco_robots.py:MujocoHopper", "RL706", slow=True),
    broken("RL706BulletArmOnePercent", "robots.py:Arm", "RL706", pybullet=True, slow=True),
    broken("RL706CrawlerOnePercent", "robots.py:Crawler", "RL706", pybullet=True, slow=True),
    broken("RL706PusherOnePercent", "robots.py:Pusher", "RL706", pybullet=True, slow=True),
    broken("RL624RoverTolerance", "broken_meaning.py:Rover", "RL624", slow=True),
    broken("RL624DroneTolerance", "broken_meaning.py:Drone", "RL624"),
    broken("RL624ArmTolerance", "mujoco_robots.py:MujocoArm", "RL624"),
    broken("RL624ReachTolerance", "broken_reach.py:Arm", "RL624"),
    broken("RL624ReacherTolerance", REACHER, "RL624", pybullet=True),
    case(
        "broken_reach.py:RL624PlanarArmInMillimetres",
        ("RL624", "warning"),
        ("RL611", "info"),
        twin="broken_reach.py:PlanarArm",
        slow=True,
    ),
    broken("RL119RoverCentimetres", "broken_meaning.py:Rover", "RL119", slow=True),
    broken("RL119DroneCentimetres", "broken_meaning.py:Drone", "RL119", slow=True),
    broken("RL119ArmCentimetres", "mujoco_robots.py:MujocoArm", "RL119", slow=True),
    broken("RL119ReachCentimetres", "broken_reach.py:Arm", "RL119", slow=True),
    broken("RL119HopperCentimetres", "mujoco_robots.py:MujocoHopper", "RL119", slow=True),
    broken("RL119ReacherCentimetres", REACHER, "RL119", pybullet=True, slow=True),
    broken("RL119PusherCentimetres", "robots.py:Pusher", "RL119", pybullet=True, slow=True),
]


@pytest.mark.parametrize("case", mark_slow(CASES), ids=lambda case: case.broken)
def test_finds_the_mistake_and_only_that(case):
    check_case(case)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "rule", "words"),
    [
        # +-0.006 rad of what the actuator may be told: [-0.34, 2.44]
        ("RL706ArmOnePercent", "RL706", ("at most 0.43 %", "bend over [1.194, 1.206] of [-0.34, 2.44]")),
        ("RL625RoverOnePercent", "RL625", ("self.goal is 0.316 away", "(80 steps)")),
        ("RL624RoverTolerance", "RL624", ("false with self.goal 0.00158 away",)),  # its tolerance is 0.0015
        ("RL119ArmCentimetres", "RL119", ("observation[6] is the position of site tip, in centimetres",)),
        ("RL119HopperCentimetres", "RL119", ("the position of body, in centimetres", "100 times")),
    ],
)
def test_finding_names_what_is_wrong(name, rule, words):
    (finding,) = findings(f"broken_scales.py:{name}", rule)
    assert [word for word in words if word not in finding.message] == []
