"""Robots that a colleague could have written: each mistake is found in two of them, and nothing in their twins."""

import pytest

from tests.checking.judging import case, check_case, findings, mark_slow


def broken(name, rule, severity, twin, **settings):
    file = "robots.py" if twin in ("Arm", "Boat", "Crawler", "Pusher", "Tank") else "broken_robots.py"
    return case(f"broken_robots.py:{name}", (rule, severity), twin=f"{file}:{twin}", **settings)


CASES = [
    broken("RL114BoatHiddenBuoy", "RL114", "warning", "Boat"),
    broken("RL114TankHiddenWish", "RL114", "warning", "Tank"),
    broken("RL115BoatOldObservation", "RL115", "error", "Boat", slow=True),
    broken("RL115ArmOldObservation", "RL115", "error", "Arm"),
    broken("RL116ArmQuaternion", "RL116", "error", "RL116ArmRightQuaternion", slow=True),
    broken("RL117BoatWraps", "RL117", "info", "Boat", slow=True),
    broken("RL117CrawlerWraps", "RL117", "info", "Crawler", slow=True),
    case(
        "broken_robots.py:RL116CrawlerQuaternion",
        *(("RL116", "error"), ("RL117", "info")),  # at pi
        twin="robots.py:Crawler",
        slow=True,
    ),
    broken("RL118BoatMillimetres", "RL118", "info", "Boat", slow=True),
    broken("RL118CrawlerDegrees", "RL118", "info", "Crawler", slow=True),
    broken("RL310BoatStaysAtBuoy", "RL310", "error", "RL310BoatArrives", slow=True),
    broken("RL310TankCountsOn", "RL310", "error", "RL310TankCountsAnew", slow=True),
    broken("RL311BoatGusts", "RL311", "error", "RL311BoatSeededGusts", slow=True),
    broken("RL311TankSpills", "RL311", "error", "RL311TankSeededSpills", slow=True),
    broken("RL507TankFailsAsTruncated", "RL507", "warning", "Tank", slow=True),
    broken("RL507CrawlerFallsAsTruncated", "RL507", "warning", "RL507CrawlerFalls", slow=True),
    broken("RL607BoatTermsOff", "RL607", "warning", "RL607BoatTerms", slow=True),
    broken("RL607CrawlerTermsOff", "RL607", "warning", "RL607CrawlerTerms", slow=True),
    broken("RL607CrawlerRawTerms", "RL607", "info", "RL607CrawlerTerms", slow=True),
    broken("RL615BoatMovingBuoy", "RL615", "warning", "RL615BoatFixedBuoy", slow=True),
    broken("RL615TankOtherWish", "RL615", "warning", "RL615TankOneWish", slow=True),
    broken("RL616BoatLateReward", "RL616", "warning", "Boat", slow=True),
    broken("RL616ArmLateReward", "RL616", "warning", "Arm", slow=True),
    broken("RL704BoatNan", "RL704", "info", "Boat"),
    broken("RL704TankNan", "RL704", "info", "Tank"),
    broken("RL803PusherInsideItsCube", "RL803", "warning", "Pusher", slow=True),
    broken("RL810ArmDegrees", "RL810", "error", "Arm", slow=True),
    broken("RL810CrawlerStartsInDegrees", "RL810", "error", "Crawler", slow=True),
    broken("RL811ArmOrder", "RL811", "error", "Arm", slow=True),
    broken("RL811CrawlerOrder", "RL811", "error", "Crawler", slow=True),
    broken("RL812ArmTouchesNothing", "RL812", "warning", "RL812ArmTouches", slow=True),
    broken("RL812ArmTouchesWithALinkThatItLacks", "RL812", "warning", "RL812ArmTouches", slow=True),
    broken("RL812CrawlerOtherFloor", "RL812", "warning", "RL812CrawlerFloor", slow=True),
    broken("RL813ArmLongPhysicsSteps", "RL813", "warning", "Arm", slow=True),
    broken("RL814ArmWeakMotors", "RL814", "warning", "Arm", slow=True),
    broken("RL815ArmOldHand", "RL815", "info", "Arm", slow=True),
    broken("RL815PusherOldCube", "RL815", "warning", "Pusher", slow=True),
    broken("RL815CrawlerOldFoot", "RL815", "info", "RL815CrawlerFoot", slow=True),
    broken("ArmIncrementsTooFar", "RL816", "warning", "ArmIncrements", slow=True),
    broken("CrawlerIncrementsTooFar", "RL816", "warning", "CrawlerIncrements", slow=True),
    broken("PusherIncrementsTooFar", "RL816", "warning", "PusherIncrements", slow=True),
    case(
        "broken_robots.py:RL821CrawlerHeldByMotors",
        *(("RL821", "error"), ("RL701", "info")),  # what its motors do is chance
        twin="broken_robots.py:RL821CrawlerDriven",
        slow=True,
    ),
]


@pytest.mark.parametrize("case", mark_slow(CASES), ids=lambda case: case.broken)
def test_finds_the_mistake_and_only_that(case):
    check_case(case)


@pytest.mark.slow_except("RL311TankSpills-RL311-np.random.default_rng().uniform(0.0, 0.1)")
@pytest.mark.pybullet
@pytest.mark.parametrize(
    ("name", "rule", "text"),
    [
        ("RL311BoatGusts", "RL311", "self.gusts = np.random.default_rng()"),
        ("RL311TankSpills", "RL311", "np.random.default_rng().uniform(0.0, 0.1)"),
        ("RL114BoatHiddenBuoy", "RL114", "self.buoy = self.draw_buoy()"),
        ("RL810CrawlerStartsInDegrees", "RL810", "p.resetJointState(self.robot, 0, np.rad2deg(0.3)"),
    ],
)
def test_finding_points_at_the_line_that_causes_it(name, rule, text):
    (finding,) = findings(f"broken_robots.py:{name}", rule)
    file, line = finding.where
    with open(file) as lines:
        assert text in lines.readlines()[line - 1]


@pytest.mark.slow
@pytest.mark.pybullet
def test_joints_that_default_motors_hold_are_named():
    (finding,) = findings("broken_robots.py:ArmHeldByMotors", "RL821")
    assert finding.message.startswith("shoulder, elbow, wrist get torques, and PyBullet's default motors hold them")
    assert finding.evidence["torque"] == pytest.approx(3.0, rel=0.01)
    assert findings("broken_robots.py:ArmDriven", "RL821") == []


@pytest.mark.pybullet
@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "kept"),
    [("ArmKeepsJoints", "joint speeds of arm"), ("CrawlerKeepsBase", "orientation of crawler")],
)
def test_state_of_bodies_that_reset_keeps_is_named(name, kept):
    (finding,) = findings(f"broken_robots.py:{name}", "RL301")
    assert f"reset keeps state ({kept}, " in finding.message
    assert f"; {finding.evidence['element']} is {kept}" in finding.message
    assert "resetBaseVelocity set back bodies of PyBullet" in finding.fix
