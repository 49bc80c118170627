"""RL123, RL124, RL618: robots with a free base whose heading matters."""

import subprocess
import sys

import pytest

from tests.checking.judging import case, check_case, findings, found, mark_slow, verdict_of

pytest.importorskip("mujoco")


def broken(name, twin, rule, **settings):
    file = "mujoco_robots.py" if twin == "MujocoHopper" else "broken_turned.py"
    return case(f"broken_turned.py:{name}", (rule, "warning"), twin=f"{file}:{twin}", **settings)


CASES = [
    broken("RL123FlyerNorth", "Flyer", "RL123"),
    broken("RL123CartNorth", "Cart", "RL123"),
    broken("RL123HopperNorth", "MujocoHopper", "RL123", slow=True),
    broken("RL123CrawlerNorth", "CrawlerLooks", "RL123", pybullet=True),
    broken("RL123PuckNorth", "Puck", "RL123", pybullet=True),
    broken("RL123FlyerFollowsNorth", "FlyerFollows", "RL123", slow=True),
    broken("RL123CartFollowsNorth", "CartFollows", "RL123", slow=True),
    broken("RL123PuckFollowsNorth", "PuckFollows", "RL123", pybullet=True, slow=True),
    broken("RL124FlyerWrongWay", "Flyer", "RL124", slow=True),
    broken("RL124CartWrongWay", "Cart", "RL124", slow=True),
    broken("RL124HopperTurnsTwice", "MujocoHopper", "RL124", slow=True),
    broken("RL124CrawlerWrongWay", "CrawlerTurns", "RL124", pybullet=True, slow=True),
    broken("RL124PuckWrongWay", "Puck", "RL124", pybullet=True, slow=True),
    broken("RL618FlyerLooksRound", "FlyerLooks", "RL618", slow=True),
    broken("RL618CartLooksRound", "CartLooks", "RL618", slow=True),
    broken("RL618HopperLooksRound", "HopperLooks", "RL618", slow=True),
    broken("RL618CrawlerLooksRound", "CrawlerLooksAway", "RL618", pybullet=True, slow=True),
    broken("RL618PuckLooksRound", "PuckLooks", "RL618", pybullet=True, slow=True),
]


@pytest.mark.parametrize("case", mark_slow(CASES), ids=lambda case: case.broken)
def test_finds_the_mistake_and_only_that(case):
    check_case(case)


@pytest.mark.slow
def test_a_robot_that_always_begins_with_the_same_heading_is_an_info():
    (finding,) = findings("broken_turned.py:FlyerNorthAlwaysTheSame", "RL123")
    assert finding.severity == "info"
    # North is along x: from backwards to forwards at 0.5 m/s.
    assert finding.evidence["value"] == pytest.approx(1.0, abs=0.1)


@pytest.mark.slow
def test_level_ground_is_known_before_the_engine_has_computed_anything():
    assert found("broken_turned.py:CartNorthOnlyPlaced", "RL123") == {("RL123", "warning")}


@pytest.mark.slow
@pytest.mark.pybullet
def test_a_large_box_is_level_ground_for_feet_that_begin_in_it():
    assert found("broken_turned.py:CrawlerNorthOnABox", "RL123") == {("RL123", "warning")}


@pytest.mark.slow
def test_bumps_are_no_level_ground():
    # MuJoCo's models of tasks list which geoms touch, in pairs.
    assert found("walk-rough", "RL123") == set()


@pytest.mark.slow
@pytest.mark.pybullet
def test_a_robot_that_a_later_reset_puts_beside_a_wall_is_not_judged():
    verdict = verdict_of("broken_turned.py:PuckBesideAWall", "RL123")
    assert verdict.not_judged["RL123"] == "not each reset puts the robot on level ground"


@pytest.mark.slow
@pytest.mark.pybullet
def test_pybullet_is_not_asked_for_shapes_that_it_dies_of():
    lines = [
        "import pybullet, pybullet_data",
        "from rlctl.checking.experiments.turned import _find_free_bodies",
        "client = pybullet.connect(pybullet.DIRECT)",
        "pybullet.loadMJCF(pybullet_data.getDataPath() + '/mjcf/reacher.xml', physicsClientId=client)",
        "assert _find_free_bodies([client]) == []",
    ]
    subprocess.run([sys.executable, "-c", "\n".join(lines)], check=True, timeout=120)
