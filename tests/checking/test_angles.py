"""RL126, RL132: degrees and radians, as the source shows them."""

import ast

import pytest

from rlctl.checking.angle_units import Unit, list_factors, read_comment, read_words
from tests.checking.judging import case, check_case, found_in_source, mark_slow

FILE = "broken_angles.py"
PAIRS = {
    "RL132BoatUpTheRiverInRadians": "BoatUpTheRiver",
    "RL132BoatUpTheRiverTwice": "BoatUpTheRiver",
    "RL132BoatUpTheRiverBackwards": "BoatUpTheRiver",
    "RL132BoatByCompassInRadians": "BoatByCompass",
    "RL132BoatKeepsItsCoursePerDegree": "BoatKeepsItsCourse",
    "RL126BoatLooksAsideInDegrees": "BoatLooksAside",
}
CASES = [
    case(f"{FILE}:{name}", (name[:5], "warning"), twin=f"{FILE}:{twin}", slow=True) for name, twin in PAIRS.items()
]


@pytest.mark.parametrize("case", mark_slow(CASES), ids=lambda case: case.broken)
def test_finds_the_mistake_and_only_that(case):
    check_case(case)


@pytest.mark.slow
@pytest.mark.parametrize("name", PAIRS)
def test_reads_the_source(name):
    found = found_in_source(f"{FILE}:{name}")
    assert [*found] == [name[:5]]
    assert found[name[:5]].where[0].endswith(FILE)
    assert not found_in_source(f"{FILE}:{PAIRS[name]}")


@pytest.mark.parametrize(
    ("text", "conversions"),
    [
        ("x * 180 / np.pi", [Unit.TO_DEGREES]),
        ("x / (180 / math.pi)", [Unit.TO_RADIANS]),
        ("2 * np.pi / 360 * x", [Unit.TO_RADIANS]),
        ("-x * 57.3", [Unit.TO_DEGREES]),
        ("180 * x", []),
        ("2 * np.pi * x", []),
    ],
)
def test_what_converts_is_a_factor(text, conversions):
    assert list_factors(ast.parse(text, mode="eval").body).conversions == conversions


@pytest.mark.parametrize(
    ("name", "unit"),
    [
        ("MAX_TILT_DEG", Unit.DEGREES),
        ("yaw_rad", Unit.RADIANS),
        ("DEG2RAD", Unit.TO_RADIANS),
        ("rad_to_deg", Unit.TO_DEGREES),
        ("gain_per_deg", Unit.PER_DEGREE),
        ("degrees_of_freedom", None),
        ("use_degrees", None),
        ("grad", None),
    ],
)
def test_names_tell_units(name, unit):
    found = read_words(name)
    assert (found.unit if found else None) is unit


def test_comments_tell_units():
    assert read_comment(" deg").unit is Unit.DEGREES
    assert read_comment("[rad/s]").unit is Unit.RADIANS
    assert read_comment("[m], [deg]", 1).unit is Unit.DEGREES
    assert read_comment("[N m/rad], [N m s/rad]", 0).unit is Unit.PER_RADIAN
    assert read_comment("degrees of freedom") is None
    assert read_comment("the heading, not in deg") is None
