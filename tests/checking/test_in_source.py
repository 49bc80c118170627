"""What the expressions of a source alone show: each form of a mistake by its rule, and its twin by none."""

import pytest

from rlctl.checking.previous_values import KeptDifferences
from tests.checking.judging import case, check_case, findings, found_in_source, mark_slow, notes_of

SHOWN = {
    "broken_ahead.py": {
        "HovercraftAnyWay": ("RL633", "Hovercraft"),
        "HovercraftOffTheStreet": ("RL633", "HovercraftOnTheStreet"),
        "HovercraftOfLengths": ("RL633", "HovercraftOfTerms"),
    },
    "broken_angles.py": {
        "RL132BoatUpTheRiverInRadians": ("RL132", "BoatUpTheRiver"),
        "RL132BoatUpTheRiverTwice": ("RL132", "BoatUpTheRiver"),
        "RL132BoatUpTheRiverBackwards": ("RL132", "BoatUpTheRiver"),
        "RL132BoatByCompassInRadians": ("RL132", "BoatByCompass"),
        "RL132BoatKeepsItsCoursePerDegree": ("RL132", "BoatKeepsItsCourse"),
        "RL126BoatLooksAsideInDegrees": ("RL126", "BoatLooksAside"),
        "RL132BoatHeelsAnyhow": ("RL132", "BoatHeels"),
        "BoatHeelsBetweenKeywords": ("RL132", "BoatHeels"),
        "BoatLooksAnywhere": ("RL132", "BoatLooksAhead"),
    },
    "broken_compass.py": {"KayakTurnsItsSpeedBack": ("RL124", "Kayak")},
    "broken_early.py": {
        "RaftKeepsFirst": ("RL642", "Raft"),
        "RaftHeadingOfTheModel": ("RL642", "RaftNominal"),
        "RL642PuckDistanceBeforeTheSpot": ("RL642", "Puck"),
        "LanderBeginsFirst": ("RL642", "Lander"),
        "LanderUnpacksFirst": ("RL642", "Lander"),
    },
    "broken_exchanged.py": {
        "RL645BoatKeepsNoSpeeds": ("RL645", "BoatKeepsSpeeds"),
        "RL645BoatIsPushedBySomethingElse": ("RL645", "BoatIsPushed"),
    },
    "broken_fields.py": {
        "RamAny": ("RL834", "Ram"),
        "RamConstant": ("RL834", "Ram"),
        "RamSum": ("RL834", "Ram"),
        "RamLargest": ("RL834", "Ram"),
        "RamForces": ("RL839", "Ram"),
        "RamForceSum": ("RL839", "Ram"),
        "RamTorqueAsSpeed": ("RL839", "Ram"),
        "RamSpeeds": ("RL839", "Ram"),
        "RL839RamSwapped": ("RL839", "Ram"),
        "RamTurnAsSpeed": ("RL839", "Ram"),
        "RamNormalAsPlace": ("RL839", "Ram"),
    },
    "broken_idle.py": {
        "RL815SkiffLooksOnce": ("RL815", "SkiffKnowsItsStart"),
        "RL638SkiffShowsItsFirstGate": ("RL638", "Skiff"),
        "RL842SkiffWithoutCurrent": ("RL842", "Skiff"),
        "SkiffGustsTooLate": ("RL842", "SkiffGustsLate"),
        "RL817SkiffGetsHeavier": ("RL817", "Skiff"),
        "SkiffOfOneSeed": ("RL306", "Skiff"),
        "SkiffOnOneCourse": ("RL306", "Skiff"),
        "SkiffByItsOldestFix": ("RL815", "SkiffByItsFixes"),
    },
    "broken_frames.py": {
        "RL129BargeFeelsTheWindOfTheWorld": ("RL129", "Barge"),
        "RL125BargeHasItsBowBehind": ("RL125", "Barge"),
        "RL125BargeForgetsASign": ("RL125", "Barge"),
        "RL125BargeTurnsOneTheOtherWay": ("RL125", "Barge"),
        "RL130BargeMovesItsSpeed": ("RL130", "Barge"),
        "RL134BargeTurnsInDegrees": ("RL134", "Barge"),
        "RL701BargePushesTwice": ("RL701", "Barge"),
        "RL640HopperWatchesAnotherPart": ("RL640", "HopperWatchesItself"),
        "RL819HopperBrakesItsBase": ("RL819", "HopperWatchesItself"),
    },
    "broken_kernels.py": {
        "CartNearByTurning": ("RL643", "Cart"),
        "RL643CartAlignedByDistance": ("RL643", "CartOfTerms"),
        "CartSwapsTheWidth": ("RL643", "CartShapesItsWidth"),
        "CartSwapsItInTerms": ("RL643", "CartOfTerms"),
    },
    "broken_late.py": {
        "RL815CrabLooksFirst": ("RL815", "Crab"),
        "SnailSeesFirst": ("RL815", "Snail"),
        "LobsterReadsFirst": ("RL815", "Lobster"),
        "LobsterReadsFirstInOneStep": ("RL815", "LobsterInOneStep"),
    },
    "broken_parts.py": {
        "BoatForgetsToShift": ("RL701", "BoatWithAThrottle"),
        "BoatShiftsTooLittle": ("RL701", "BoatWithAThrottle"),
        "CarriageOffItsRail": ("RL619", "Carriage"),
        "PosedBeyondItsElbow": ("RL619", "Posed"),
        "LiftAboveItsShaft": ("RL619", "Lift"),
    },
    "broken_previous.py": {
        "RL620BoatSmoothTooEarly": ("RL620", "BoatSmooth"),
        "RL620BoatNormedTooEarly": ("RL620", "BoatNormed"),
        "RL627BoatOnCourseOldBuoy": ("RL627", "BoatOnCourse"),
        "RL627BoatInTimeOldBuoy": ("RL627", "BoatInTime"),
        "RL627BoatInTimeBuoyFirst": ("RL627", "BoatInTime"),
        "RL627BoatsMaskOldGoal": ("RL627", "BoatsMask"),
        "RL627BoatsWhereOldGoal": ("RL627", "BoatsWhere"),
        "RL628BoatPaddlesInEachStep": ("RL628", "BoatPaddles"),
        "RL628BoatPaddlesAtOnceInEachStep": ("RL628", "BoatPaddlesAtOnce"),
        "BoatPaddlesAtOnceTooLate": ("RL834", "BoatPaddlesAtOnce"),
        "RL637BoatAheadFromTheStart": ("RL637", "BoatAhead"),
        "RL626BoatFromBothEnds": ("RL626", "BoatFromItsBow"),
        "RL638BoatOnCommandShowsTheFirst": ("RL638", "BoatOnCommand"),
        "RL638BoatKeepsItsFirstWay": ("RL638", "BoatShowsItsWay"),
        "RL641BoatStaysNowAndThen": ("RL641", "BoatStays"),
        "RL641BoatStaysMaskedNowAndThen": ("RL641", "BoatStaysMasked"),
    },
    "broken_refreshed.py": {
        "SledRefreshesFirst": ("RL131", "Sled"),
        "SledAliases": ("RL131", "SledInPlace"),
        "SledReadsTheNewest": ("RL131", "SledOfHistory"),
        "SledKeepsItAfterwards": ("RL131", "SledInOneMethod"),
        "SledOfNoRates": ("RL131", "SledOfRates"),
        "SledGainsNothing": ("RL620", "SledOfGains"),
        "RL131FloatFiltersNothing": ("RL131", "Float"),
        "FloatKeepsAView": ("RL620", "FloatShowsTwice"),
    },
    "broken_seen.py": {
        "ProbeSeesByTheMatrix": ("RL125", "Probe"),
        "ProbeForgetsToNegate": ("RL125", "ProbeOfMujoco"),
        "ScoutSeesTheOtherWay": ("RL125", "ScoutInObserve"),
        "LoaderSeesTheOtherWay": ("RL125", "Loader"),
        "LoaderByThePoseItself": ("RL125", "LoaderByPoses"),
    },
    "broken_starts.py": {
        "RL644BoatTowsFromTheStart": ("RL644", "BoatTows"),
        "RL644BoatTowsWithATautRope": ("RL644", "BoatTows"),
        "BoatSlowsDown": ("RL644", "BoatLightsUp"),
        "RL610BoatFloatsAtItsAim": ("RL610", "BoatToItsAim"),
        "RL306BoatToOneAim": ("RL306", "BoatToItsAim"),
        "RL306BoatOfOneGenerator": ("RL306", "BoatToItsAim"),
        "RL621HopperOfForcesLeans": ("RL621", "HopperOfForces"),
        "RL839HopperOfForcesSideways": ("RL839", "HopperOfForces"),
        "RL116BoatWithAGyroReadAsWxyz": ("RL116", "BoatWithAGyro"),
        "RL841HopperOfTheOtherSole": ("RL841", "HopperOfItsSoles"),
        "RL841HopperOfItsShin": ("RL841", "HopperOfItsSoles"),
    },
    "broken_success.py": {
        "RL646BoatMoorsToOneSide": ("RL646", "BoatMoors"),
        "BoatMoorsAnyhow": ("RL646", "BoatMoorsAtEitherEnd"),
        "BoatMoorsWithOneOfThem": ("RL646", "BoatMoorsFully"),
        "BoatMoorsByTheSmallerOne": ("RL646", "BoatMoorsFully"),
        "BoatLeavesItsCrate": ("RL626", "BoatFetchesItsCrate"),
        "BoatTurnsFromItself": ("RL620", "BoatTurnsSlowly"),
        "BoatLeavesItsCourse": ("RL634", "BoatKeepsCourse"),
        "RL647BoatForgetsItsTurns": ("RL647", "BoatTurnsSlowly"),
        "BoatAlwaysOwes": ("RL602", "BoatOwesUntilItIsNear"),
        "BoatForgetsToCharge": ("RL647", "BoatChargesForTurns"),
        "BoatSpends": ("RL621", "BoatSpares"),
        "BoatIsPaidForBeingLost": ("RL621", "BoatStopsPaying"),
        "BoatLimitsItsTurnsTheWrongWay": ("RL645", "BoatLimitsItsTurns"),
        "BoatCountsNoVisits": ("RL620", "BoatCountsVisits"),
        "BoatTurnsOnSinceTheStart": ("RL637", "BoatTurnsOn"),
    },
    "broken_unwrapped.py": {
        "RL133BoatShowsTheLongWay": ("RL133", "BoatShowsItsError"),
        "RL618BoatPointsTheLongWay": ("RL618", "BoatPoints"),
        "RL618ValveTurnsTheLongWay": ("RL618", "Valve"),
    },
}
"""The rule and the twin of each mistake, by files."""
SOUND = {
    "broken_ahead.py": ["HovercraftIsFast", "Tricycle"],
    "broken_early.py": ["RaftSettles", "RaftLevels", "PuckGlides"],
    "broken_exchanged.py": ["BoatLooksBack"],
    "broken_fields.py": ["RamApart", "RamOtherNames"],
    "broken_frames.py": ["BargeTurnsInPartsOfATurn"],
    "broken_idle.py": ["SkiffKnowsItsCourse", "SkiffTellsOfGates"],
    "broken_late.py": ["CrabSteersByIt", "CrabKeepsAView", "CrabKeepsTime", "SnailRemembers", "SnailGains"],
    "broken_parts.py": ["BoatStartsItsEngine", "BoatBrakes", "BoatSaturates"],
    "broken_previous.py": ["BoatRestOfCourse"],
    "broken_seen.py": ["Scout", "LoaderOnItsHead"],
    "broken_starts.py": ["HopperOfFriction", "BoatLightsUp"],
    "broken_success.py": ["BoatIsPaidForItsRest", "BoatKeepsToItsLane", "BoatTellsOfItsTurns"],
    "broken_unwrapped.py": ["ValveHasStops"],
}
"""What looks like one of these mistakes, and is none."""
SEVERAL = {"broken_ahead.py", "broken_early.py", "broken_kernels.py", "broken_starts.py"}
"""Files whose mistakes have consequences that the source shows, too."""
MUJOCO = {
    "broken_early.py",
    "broken_frames.py",
    "broken_late.py",
    "broken_parts.py",
    "broken_refreshed.py",
    "broken_seen.py",
    "broken_starts.py",
}
BULLET = {"broken_early.py", "broken_fields.py", "broken_late.py", "broken_seen.py"}
ERRORS = {"RL116"}


def mark(file, *values):
    """The parameters of a test: slow ones, with the engine that the environments of a file need."""
    return pytest.param(file, *values, marks=[pytest.mark.slow, *([pytest.mark.pybullet] if file in BULLET else [])])


PAIRS = [(file, name, rule, twin) for file, shown in SHOWN.items() for name, (rule, twin) in shown.items()]
CASES = [
    case(
        f"{file}:{name}",
        (rule, "error" if rule in ERRORS else "warning"),
        twin=f"{file}:{twin}",
        pybullet=file in BULLET,
        slow=True,
    )
    for file, name, rule, twin in PAIRS
    if name.startswith(rule)
]


@pytest.mark.parametrize("case", mark_slow(CASES), ids=lambda case: case.broken)
def test_finds_the_mistake_and_only_that(case):
    if case.broken.partition(":")[0] in MUJOCO:
        pytest.importorskip("mujoco")
    check_case(case)


@pytest.mark.parametrize(("file", "name", "rule", "twin"), [mark(*pair) for pair in PAIRS])
def test_the_source_shows_the_mistake(file, name, rule, twin):
    if file in MUJOCO:
        pytest.importorskip("mujoco")
    found = found_in_source(f"{file}:{name}")
    assert rule in found if file in SEVERAL else [*found] == [rule]
    assert found[rule].where[0].endswith(file)
    assert not found_in_source(f"{file}:{twin}")


@pytest.mark.parametrize(("file", "name"), [mark(file, name) for file, names in SOUND.items() for name in names])
def test_what_looks_like_a_mistake_is_none(file, name):
    if file in MUJOCO:
        pytest.importorskip("mujoco")
    assert not found_in_source(f"{file}:{name}")


@pytest.mark.slow
def test_names_what_has_been_replaced():
    pytest.importorskip("mujoco")
    (finding,) = findings("broken_refreshed.py:RL131FloatFiltersNothing", "RL131")
    assert finding.message.startswith("self.smooth = self.filtered() is computed where self.data.qpos - self.last_q is")


@pytest.mark.slow
@pytest.mark.pybullet
def test_names_both_lines():
    pytest.importorskip("mujoco")
    (finding,) = findings("broken_late.py:RL815CrabLooksFirst", "RL815")
    assert "for which to_body @ self.data.qvel[:2] is read before the robot moves" in finding.message


@pytest.mark.slow
@pytest.mark.pybullet
def test_names_both_values():
    pytest.importorskip("mujoco")
    (finding,) = findings("broken_early.py:RaftHeadingOfTheModel", "RL642")
    assert finding.message.startswith("self.heading = start_yaw reads 0, and at the end of the same reset start_yaw is")


def test_a_target_of_a_motor_in_the_same_step_is_no_new_goal():
    with notes_of("broken_previous.py:BoatStrides") as notes:
        kept = notes.share(KeptDifferences)
        in_step = [one for one in notes.definitions.assigned["last_error"] if one.function.name == "step"]
        assert in_step
        assert not any(map(kept.comes_with_goal, in_step))
