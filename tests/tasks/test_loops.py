"""Loops of links in grippers: how they close, which springs move, and joints that follow instead in a copy."""

import xml.etree.ElementTree as ElementTree
from pathlib import Path

import numpy as np
import pytest

from rlctl.tasks import new
from rlctl.tasks.grippers import GripperSearch
from rlctl.tasks.loops import replace_loops, write_armature
from tests.tasks.test_hand_robot import MIMIC, load, write_arm, write_parallel
from tests.tasks.test_new import run

# A four-bar linkage for each finger: it stays upright while its two knuckles, 4 cm long, turn inwards.
FINGER = """<body name="{side}_knuckle" pos="0 {outer} 0.01"><joint name="{side}_knuckle" axis="{axis} 0 0"
range="0 1" {limit}/><geom type="capsule" fromto="0 0 0.005 0 0 0.035" size="0.004" mass="0.01"/>
<body name="{side}_finger" pos="0 0 0.04"><joint name="{side}_finger" axis="{axis} 0 0" range="-1.5 1.5"/>
<geom type="box" size="0.008 0.004 0.02" pos="0 0 0.02" mass="0.02"/></body></body>
<body name="{side}_inner" pos="0 {inner} 0.01"><joint name="{side}_inner" axis="{axis} 0 0" range="-0.2 1.2"/>
<geom type="capsule" fromto="0 0 0.005 0 0 0.035" size="0.003" mass="0.01" contype="0" conaffinity="0"/></body>"""
FOUR_BARS = "".join(
    FINGER.format(side=side, outer=sign * 0.04, inner=sign * 0.03, axis=sign, limit='actuatorfrcrange="-3 3"')
    for side, sign in (("left", 1), ("right", -1))
)
LOOPS = """<equality><connect body1="left_finger" body2="left_inner" anchor="0 -0.01 0"/>
<connect body1="right_finger" body2="right_inner" anchor="0 0.01 0"/>
<joint joint1="right_knuckle" joint2="left_knuckle"/></equality>
<actuator><motor joint="left_knuckle"/></actuator>"""
# Three bars of 10 cm, whose end is held 15 cm above their root: one joint is free.
CHAIN = """<mujoco><compiler angle="radian"/><worldbody><body name="base"><geom size="0.01"/>
<body name="one"><joint name="one" axis="0 1 0" range="-3 3"/><geom type="capsule" fromto="0 0 0 0 0 0.1" size="0.01"/>
<body name="two" pos="0 0 0.1"><joint name="two" axis="0 1 0" range="-3 3"/>
<geom type="capsule" fromto="0 0 0 0 0 0.1" size="0.01"/>
<body name="three" pos="0 0 0.1"><joint name="three" axis="0 1 0" range="{limits}" stiffness="0.1" springref="1.2"/>
<geom type="capsule" fromto="0 0 0 0 0 0.1" size="0.01"/><site name="end" pos="0 0 0.1"/></body></body></body></body>
<site name="held" pos="0 0 0.2"/></worldbody>
<equality><connect site1="end" site2="held"/></equality></mujoco>"""


@pytest.fixture
def arm(tmp_path):
    return write_arm(tmp_path, FOUR_BARS, equality=LOOPS)


@pytest.mark.slow
def test_a_finger_of_a_linkage_stays_upright(arm):
    linkage, surfaces = load(arm)
    gripper = GripperSearch(linkage, surfaces).find(None)
    names = linkage.body.joint_names
    assert [names[joint] for joint in gripper.drivers] == ["left_knuckle"]
    # What a loop connects is one finger.
    assert {frozenset(links) for links in gripper.fingers} == {
        frozenset({f"{side}_knuckle", f"{side}_finger", f"{side}_inner"}) for side in ("left", "right")
    }
    closed = dict(zip(names, gripper.closed.tolist(), strict=True))
    # The faces are 3.6 cm from the middle, and 4 cm * sin(q) of that is closed: q is 1.12 rad, beyond the limit of 1.
    assert closed["left_knuckle"] == pytest.approx(1.0, abs=0.05)
    for side in ("left", "right"):
        assert closed[f"{side}_finger"] == pytest.approx(-closed["left_knuckle"], abs=1e-3)
        assert closed[f"{side}_inner"] == pytest.approx(closed["left_knuckle"], abs=1e-3)


@pytest.mark.parametrize(("limits", "expected"), [("-2 2", 1.2), ("-2 0.7", 0.7)])
def test_springs_move_what_loops_leave_free(tmp_path, limits, expected):
    file = tmp_path / "chain.xml"
    file.write_text(CHAIN.format(limits=limits))
    linkage, _ = load(file)
    closed = linkage.close_loops(np.array([0.5, -0.9, 0.1]), [0, 1, 2])
    assert closed[2] == pytest.approx(expected, abs=0.01)
    angles = np.cumsum(closed)
    # The end stays at x = 0, z = 20 cm.
    assert 0.1 * np.sin(angles).sum() == pytest.approx(0.0, abs=1e-5)
    assert 0.1 * np.cos(angles).sum() == pytest.approx(0.2, abs=1e-5)


def test_joints_follow_the_driver_instead(arm):
    linkage, surfaces = load(arm)
    gripper = GripperSearch(linkage, surfaces).find(None)
    files = {Path("arm.xml"): arm.read_bytes()}
    (note,) = replace_loops(files, Path("arm.xml"), linkage, gripper)
    assert "5 joints follow left_knuckle" in note
    root = ElementTree.fromstring(files[Path("arm.xml")])
    assert root.find("equality/connect") is None
    ways = {joint.get("joint1"): joint.get("polycoef", "").split() for joint in root.iterfind("equality/joint")}
    assert float(ways["right_finger"][1]) == pytest.approx(-1.0, abs=1e-3)
    assert float(ways["right_knuckle"][1]) == pytest.approx(1.0, abs=1e-3)
    arm.write_bytes(files[Path("arm.xml")])
    assert load(arm)[0].list_loops() == []


def test_armature_goes_into_the_copy(arm):
    files = {Path("arm.xml"): arm.read_bytes()}
    write_armature(files, Path("arm.xml"), {"left_finger": 0.002})
    joints = ElementTree.fromstring(files[Path("arm.xml")]).iterfind("worldbody//joint")
    assert {joint.get("name"): joint.get("armature") for joint in joints if joint.get("armature")} == {
        "left_finger": "0.002"
    }


def test_grippers_without_loops_are_kept(tmp_path):
    linkage, surfaces = load(write_parallel(tmp_path, equality=MIMIC))
    gripper = GripperSearch(linkage, surfaces).find(None)
    assert replace_loops({}, Path("arm.xml"), linkage, gripper) == []


@pytest.mark.slow
def test_a_gripper_with_loops_holds_a_block(tmp_path, monkeypatch, arm):
    monkeypatch.chdir(tmp_path)
    plugin = new.create("my-picker", model="arm.xml", hand=["pick"])
    assert "5 joints follow left_knuckle" in plugin.summary
    assert "5 passed" in run("pytest", "-q", "my-picker", cwd=tmp_path)
