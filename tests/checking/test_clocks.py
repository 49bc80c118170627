"""RL124, RL627, RL628, RL629, RL826, RL827: what the attributes of robots of all kinds tell."""

import pytest

from tests.checking.judging import case, check_case, mark_slow

pytest.importorskip("mujoco")


def broken(file, name, twin, rule, **settings):
    return case(f"{file}.py:{name}", (rule, "warning"), twin=f"{file}.py:{twin}", **settings)


PAIRS = (
    ("broken_clocks", "RL826FeetSlowClock", "Feet"),
    ("broken_clocks", "RL826FeetSlowHertz", "FeetByHertz"),
    ("broken_clocks", "RL826FeetCountsAll", "FeetBySine"),
    ("broken_clocks", "RL826HopperSlowTime", "HopperByTime"),
    ("broken_clocks", "RL826PusherSlowTime", "PusherBySeconds"),
    ("broken_timers", "RL826FeetInAirPhysicsTime", "FeetInAir"),
    ("broken_timers", "RL826HopperInAirPhysicsTime", "HopperInAir"),
    ("broken_timers", "RL826PusherPausesPhysicsTime", "PusherPauses"),
    ("broken_clocks", "RL827FeetPhysicsTime", "Feet"),
    ("broken_clocks", "RL827HopperPhysicsTime", "HopperSmooth"),
    ("broken_clocks", "RL827PusherPhysicsTime", "PusherSmooth"),
    ("broken_steps", "RL628FeetPaidAtRest", "Lifts"),
    ("broken_steps", "RL628HopperPaidAtRest", "HopperSteps"),
    ("broken_steps", "RL628CrawlerPaidAtRest", "CrawlerLifts"),
    ("broken_steps", "RL628HopperLandsAlways", "HopperSteps"),
    ("broken_steps", "RL629PickerAnywhere", "Picker"),
    ("broken_steps", "RL629GripperAnywhere", "Gripper"),
    ("broken_waypoints", "RL627CourseOldGoal", "Course"),
    ("broken_waypoints", "RL627RoundsOldGoal", "Rounds"),
    ("broken_waypoints", "RL627CrankOldGoal", "CrankRounds"),
    ("broken_waypoints", "RL124CopterWrongWay", "Copter"),
    ("broken_waypoints", "RL124OmniWrongWay", "Omni"),
    ("broken_waypoints", "RL124DiverWrongWay", "Diver"),
)
CASES = [broken(file, name, twin, name[:5], pybullet=True, slow=True) for file, name, twin in PAIRS]


@pytest.mark.parametrize("case", mark_slow(CASES), ids=lambda case: case.broken)
def test_finds_the_mistake_and_only_that(case):
    check_case(case)
