"""Orders of the elements of quaternions, by what the source does with them."""

import ast

import pytest

from rlctl.checking.quaternion_orders import WXYZ, XYZW, read_literal, read_turned
from tests.checking.judging import found_in_source


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
    found = read_turned(ast.parse(text, mode="eval").body)
    assert (found[1] if found else None) == orders


def test_the_cosine_is_w():
    parts = ast.parse("[np.cos(a / 2), 0, 0, np.sin(a / 2)]", mode="eval").body.elts
    assert read_literal(parts) == WXYZ
    assert read_literal(parts[::-1]) == XYZW
    assert read_literal(parts[:3]) is None


@pytest.mark.slow
def test_a_second_mistake_is_named_with_its_line():
    pytest.importorskip("mujoco")
    finding = found_in_source("broken_starts.py:BoatReadsItsGyroTwice")["RL116"]
    first, second = finding.evidence["places"]
    assert first != second
    assert finding.message.endswith(f"it is x, y, z, w (likewise {second})")
