"""Robots that a colleague could have written: each mistake is found in two of them, and nothing in their twins."""

import pytest

from tests.checking.judging import case, check_case, findings, mark_slow


def broken(name, rule, severity, twin, **settings):
    file = "robots.py" if twin in ("Arm", "Boat", "Crawler", "Pusher", "Tank") else "broken_robots.py"
    return case(f"broken_robots.py:{name}", (rule, severity), twin=f"{file}:{twin}", **settings)


CASES = [
    broken("BoatHiddenBuoy", "RL114", "warning", "Boat"),
    broken("TankHiddenWish", "RL114", "warning", "Tank"),
    broken("BoatOldObservation", "RL115", "error", "Boat"),
    broken("ArmOldObservation", "RL115", "error", "Arm"),
    broken("ArmQuaternion", "RL116", "error", "ArmRightQuaternion", slow=True),
    broken("BoatWraps", "RL117", "info", "Boat", slow=True),
    broken("CrawlerWraps", "RL117", "info", "Crawler"),
    case(
        "broken_robots.py:CrawlerQuaternion", ("RL116", "error"), ("RL117", "info"), twin="robots.py:Crawler"
    ),  # at pi
    broken("BoatMillimetres", "RL118", "info", "Boat"),
    broken("CrawlerDegrees", "RL118", "info", "Crawler"),
    broken("BoatStaysAtBuoy", "RL310", "error", "BoatArrives"),
    broken("TankCountsOn", "RL310", "error", "TankCountsAnew"),
    broken("BoatGusts", "RL311", "error", "BoatSeededGusts"),
    broken("TankSpills", "RL311", "error", "TankSeededSpills"),
    broken("TankFailsAsTruncated", "RL507", "warning", "Tank"),
    broken("CrawlerFallsAsTruncated", "RL507", "warning", "CrawlerFalls"),
    broken("BoatTermsOff", "RL607", "warning", "BoatTerms", slow=True),
    broken("CrawlerTermsOff", "RL607", "warning", "CrawlerTerms"),
    broken("BoatMovingBuoy", "RL615", "warning", "BoatFixedBuoy", slow=True),
    broken("TankOtherWish", "RL615", "warning", "TankOneWish"),
    broken("BoatLateReward", "RL616", "warning", "Boat"),
    broken("ArmLateReward", "RL616", "warning", "Arm"),
    broken("BoatNan", "RL704", "info", "Boat"),
    broken("TankNan", "RL704", "info", "Tank"),
    broken("PusherInsideItsCube", "RL803", "warning", "Pusher"),
    broken("ArmDegrees", "RL810", "error", "Arm"),
    broken("CrawlerStartsInDegrees", "RL810", "error", "Crawler"),
    broken("ArmOrder", "RL811", "error", "Arm"),
    broken("CrawlerOrder", "RL811", "error", "Crawler"),
    broken("ArmTouchesNothing", "RL812", "warning", "ArmTouches"),
    broken("CrawlerOtherFloor", "RL812", "warning", "CrawlerFloor"),
    broken("ArmLongPhysicsSteps", "RL813", "warning", "Arm"),
    broken("ArmWeakMotors", "RL814", "warning", "Arm"),
    broken("ArmOldHand", "RL815", "info", "Arm"),
    broken("CrawlerOldFoot", "RL815", "info", "CrawlerFoot"),
]


@pytest.mark.parametrize("case", mark_slow(CASES), ids=lambda case: case.broken)
def test_finds_the_mistake_and_only_that(case):
    check_case(case)


@pytest.mark.pybullet
@pytest.mark.parametrize(
    ("name", "rule", "text"),
    [
        ("BoatGusts", "RL311", "self.gusts = np.random.default_rng()"),
        ("TankSpills", "RL311", "np.random.default_rng().uniform(0.0, 0.1)"),
        ("BoatHiddenBuoy", "RL114", "self.buoy = self.draw_buoy()"),
        ("CrawlerStartsInDegrees", "RL810", "p.resetJointState(self.robot, 0, np.rad2deg(0.3)"),
    ],
)
def test_finding_points_at_the_line_that_causes_it(name, rule, text):
    (finding,) = findings(f"broken_robots.py:{name}", rule)
    file, line = finding.where
    with open(file) as lines:
        assert text in lines.readlines()[line - 1]
