"""Units of angles, by factors, names and comments."""

import ast

import pytest

from rlctl.checking.angle_units import Unit, list_factors, read_comment, read_words


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
