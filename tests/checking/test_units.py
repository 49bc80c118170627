"""RL119 and RL820: velocities over the wrong time, and units of the engine's values, in robots that differ."""

import pytest

from tests.checking.judging import case, check_case, findings, found, mark_slow

pytest.importorskip("mujoco")
UNITS, INTEGRATION, TURNED = "broken_units.py", "broken_integration.py", "broken_turned.py"


def broken(name, twin, severity="warning", **settings):
    rule = name.partition("RL")[2][:3]
    return case(f"{UNITS}:{name}", (f"RL{rule}", severity), twin=twin, slow=True, **settings)


def bullet(name, twin):
    return broken(name, twin, pybullet=True)


BULLET_HAND = f"{UNITS}:BulletArmHandMoves"
CASES = [
    bullet("RL820PusherFarPerPhysicsStep", f"{UNITS}:PusherFar"),
    broken("RL820ArmWithBallPerPhysicsStep", f"{UNITS}:ArmWithBall"),
    broken("RL820ArmWithBallUndivided", f"{UNITS}:ArmWithBall"),
    broken("RL820FlyerUndivided", f"{INTEGRATION}:FlyerMeasures"),
    broken("RL820CartUndivided", f"{INTEGRATION}:CartMeasures"),
    bullet("RL820PusherUndivided", f"{INTEGRATION}:PusherMeasures"),
    broken("RL820HopperChanges", "mujoco_robots.py:MujocoHopper"),
    broken("RL820FlyerWithNoise", f"{UNITS}:FlyerMeasuresWithNoise"),
    bullet("RL820PusherWithNoise", f"{UNITS}:PusherMeasuresWithNoise"),
    broken("RL119FlyerGyro", f"{TURNED}:Flyer"),
    broken("RL119CartGyro", f"{TURNED}:Cart"),
    bullet("RL119CrawlerGyro", f"{TURNED}:CrawlerTurns"),
    bullet("RL119PuckGyro", f"{TURNED}:Puck"),
    broken("RL119FlyerGyroWithNoise", f"{UNITS}:FlyerWithNoise"),
    broken("RL119HopperGyro", f"{UNITS}:HopperTurns"),
    broken("RL119ArmTipMillimetres", f"{UNITS}:ArmTipMoves"),
    bullet("RL119BulletArmHandMillimetres", BULLET_HAND),
    bullet("RL119BulletArmHandPlaceMillimetres", BULLET_HAND),
    bullet("RL119BulletArmHandDegrees", BULLET_HAND),
    bullet("RL119BulletArmHandMillimetresWithNoise", BULLET_HAND),
    broken("RL119ArmWithBallMillimetres", f"{UNITS}:ArmWithBall"),
    bullet("RL119PuckHeading", f"{TURNED}:Puck"),
]


@pytest.mark.parametrize("case", mark_slow(CASES), ids=lambda case: case.broken)
def test_finds_the_mistake_and_only_that(case):
    check_case(case)


@pytest.mark.slow
def test_changes_may_be_observed_on_purpose():
    assert found(f"{UNITS}:ArmChangesOnly", "RL820") == {("RL820", "info")}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "rule", "words"),
    [
        # A ball that nothing touches is thrown; the physics takes 5 steps of 0.004 s
        ("RL820ArmWithBallUndivided", "RL820", ("observation['object'][3]", "not divided by the 0.02 s")),
        ("RL820PusherFarPerPhysicsStep", "RL820", ("4 times too large",)),
        ("RL119ArmTipMillimetres", "RL119", ("velocity of site tip, in millimetres per second", "1000 times")),
        ("RL119PuckGyro", "RL119", ("angular velocity of a body in its own frame, in degrees per second",)),
    ],
)
def test_finding_names_what_is_wrong(name, rule, words):
    (finding,) = findings(f"{UNITS}:{name}", rule)
    assert [word for word in words if word not in finding.message] == []
