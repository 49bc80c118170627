"""RL116, RL306, RL610, RL644, RL841: starts of episodes, orders of quaternions and names of parts, as the source shows
them."""

import ast

import pytest

from rlctl.checking.quaternion_orders import WXYZ, XYZW, _read_literal, _read_turned
from tests.checking.judging import case, check_case, found_in_source, mark_slow

FILE = "broken_starts.py"
PAIRS = {
    "RL644BoatTowsFromTheStart": ("warning", "BoatTows"),
    "RL644BoatTowsWithATautRope": ("warning", "BoatTows"),
    "RL610BoatFloatsAtItsAim": ("warning", "BoatToItsAim"),
    "RL306BoatToOneAim": ("warning", "BoatToItsAim"),
    "RL116BoatWithAGyroReadAsWxyz": ("error", "BoatWithAGyro"),
    "RL841HopperOfTheOtherSole": ("warning", "HopperOfItsSoles"),
    "RL841HopperOfItsShin": ("warning", "HopperOfItsSoles"),
}
CASES = [
    case(f"{FILE}:{name}", (name[:5], severity), twin=f"{FILE}:{twin}", slow=True)
    for name, (severity, twin) in PAIRS.items()
]


@pytest.mark.parametrize("case", mark_slow(CASES), ids=lambda case: case.broken)
def test_finds_the_mistake_and_only_that(case):
    check_case(case)


@pytest.mark.slow
@pytest.mark.parametrize("name", PAIRS)
def test_reads_the_source(name):
    found = found_in_source(f"{FILE}:{name}")
    assert name[:5] in found
    assert found[name[:5]].where[0].endswith(FILE)
    assert not found_in_source(f"{FILE}:{PAIRS[name][1]}")


@pytest.mark.parametrize(
    ("text", "orders"),
    [
        ("q[[1, 2, 3, 0]]", (WXYZ, XYZW)),
        ("q[:, [3, 0, 1, 2]]", (XYZW, WXYZ)),
        ("[q[3], q[0], q[1], q[2]]", (XYZW, WXYZ)),
        ("np.roll(q, -1)", (WXYZ, XYZW)),
        ("[q[0], q[1], q[2], q[3]]", None),
    ],
)
def test_elements_in_another_order(text, orders):
    found = _read_turned(ast.parse(text, mode="eval").body)
    assert (found[1] if found else None) == orders


def test_the_cosine_is_w():
    parts = ast.parse("[np.cos(a / 2), 0, 0, np.sin(a / 2)]", mode="eval").body.elts
    assert _read_literal(parts) == WXYZ
    assert _read_literal(parts[::-1]) == XYZW
    assert _read_literal(parts[:3]) is None
