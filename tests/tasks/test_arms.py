"""The arms of starter plugins: tips, grippers, and robots that hang into the floor."""

import contextlib
import warnings

import numpy as np
import pytest

from rlctl.engine import MUJOCO
from rlctl.environments.spec import EnvSpec
from rlctl.tasks import new

LINK = (
    '<link name="{name}"><inertial><origin xyz="{middle}"/><mass value="0.2"/><inertia ixx="5e-4" iyy="5e-4" '
    'izz="5e-4" ixy="0" ixz="0" iyz="0"/></inertial>{shape}</link>'
)
BOX = '<collision><origin xyz="{middle}"/><geometry><box size="{size}"/></geometry></collision>'
JOINT = (
    '<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/><origin xyz="{place}"/>'
    '<axis xyz="{axis}"/><limit {limit} effort="5" velocity="3"/></joint>'
)


def link(name, middle="0 0 0.05", size="0.02 0.02 0.1"):
    shape = BOX.format(middle=middle, size=size) if size else ""
    return LINK.format(name=name, middle=middle, shape=shape)


def joint(name, parent, child, place="0 0 0.1", axis="0 1 0", kind="revolute", limit='lower="-1" upper="1"'):
    return JOINT.format(name=name, parent=parent, child=child, place=place, axis=axis, kind=kind, limit=limit)


ARM = [link("foot"), link("one"), link("two"), link("hand")]
ARM += [joint("pan", "foot", "one", axis="0 0 1"), joint("lift", "one", "two"), joint("wrist", "two", "hand")]


def write(folder, *parts):
    (folder / "robot.urdf").write_text(f'<robot name="robot">{"".join(parts)}</robot>', encoding="utf-8")


@pytest.mark.slow_except("parts4-tool0-joints4")
@pytest.mark.parametrize(
    ("parts", "tip", "joints"),
    [
        ([], "hand", ["pan", "lift", "wrist"]),
        (
            [link("moving_jaw"), joint("gripper", "hand", "moving_jaw")],
            "hand",
            ["pan", "lift", "wrist"],
        ),
        (  # fingers without a name that says so
            [link("left"), link("right"), joint("l", "hand", "left"), joint("r", "hand", "right")],
            "hand",
            ["pan", "lift", "wrist"],
        ),
        (
            [link("wrist_camera", size=""), joint("mount", "two", "wrist_camera", kind="fixed")],
            "hand",
            ["pan", "lift", "wrist"],
        ),
        (
            [
                *(link(name, size="") for name in ("flange", "tool0", "camera_tool")),
                *(joint(f"to {name}", "hand", name, kind="fixed") for name in ("flange", "tool0", "camera_tool")),
            ],
            "tool0",
            ["pan", "lift", "wrist"],
        ),
    ],
)
def test_the_tip(tmp_path, monkeypatch, parts, tip, joints):
    monkeypatch.chdir(tmp_path)
    write(tmp_path, *ARM, *parts)
    task = (new.create("tipped", model="robot.urdf").folder / "tipped" / "task.py").read_text()
    assert f'TIP = "{tip}"' in task
    assert f"JOINTS = {joints}".replace("'", '"') in task


@pytest.mark.slow
def test_a_link_that_turns_on_the_spot_brings_its_end_to_the_goal(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    turn = joint("turn", "foot", "one", axis="0 1 0", kind="continuous", limit="")
    write(tmp_path, link("foot"), link("one"), turn)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        plugin = new.create("spinner", model="robot.urdf")
    with contextlib.closing(EnvSpec(plugin.target).make()) as env:
        env.reset(seed=0)
        task = env.unwrapped.task
        task.arm.set_joints(np.array([np.pi / 2]))
        # The link is 0.1 m long along z, 0.1 m above the base: it lies along x.
        assert task.find_tip() == pytest.approx([0.1, 0.0, 0.1], abs=1e-3)


@pytest.mark.slow
def test_what_hangs_below_its_base_is_raised(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    hanging = link("one", middle="0 0 -0.05")
    write(
        tmp_path,
        link("foot"),
        hanging,
        link("two"),
        *(joint("a", "foot", "one", "0 0 -0.02"), joint("b", "foot", "two")),
    )
    plugin = new.create("hanging-arm", model="robot.urdf", link="one")
    assert "m above the floor, into which it hangs" in plugin.summary
    with contextlib.closing(EnvSpec(plugin.target).make()) as env:
        env.reset(seed=0)
        sim = env.unwrapped.sim
        for _ in range(5):
            env.step(np.zeros(1, np.float32))
        assert not sim.bodies["arm"].links_touching(sim.bodies["floor"])


def test_what_only_mujoco_reads_is_simulated_in_mujoco(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "arm.xml").write_text(
        """<mujoco><default><default class="arm"><joint axis="0 1 0" range="-60 60"/></default></default><worldbody>
        <body name="foot"><geom size="0.05"/><body name="one" pos="0 0 0.1" childclass="arm"><joint name="lift"/>
        <geom type="capsule" fromto="0 0 0 0 0 0.2" size="0.02"/></body></body></worldbody></mujoco>"""
    )
    plugin = new.create("mujoco-arm", model="arm.xml")
    assert "sim: mujoco" in (plugin.folder / "mujoco_arm" / "task.yaml").read_text().splitlines()
    assert "PyBullet does not read this file as MuJoCo does" in plugin.summary
    with contextlib.closing(EnvSpec(plugin.target, sim=MUJOCO).make()) as env:
        env.reset(seed=0)
        assert env.unwrapped.task.arm.joint_names == ["lift"]


SITES = """<mujoco><compiler angle="radian"/><size nkey="1"/><visual><map znear="0.1"/></visual>
<worldbody><body name="foot"><geom size="0.05"/><body name="one" pos="0 0 0.1">
<joint name="lift" axis="0 1 0" range="-1 1"/><geom type="capsule" fromto="0 0 0 0 0 0.2" size="0.02"/>
<body name="hand" pos="0 0 0.2"><joint name="wrist" axis="0 1 0" range="-1 1"/>
<geom size="0.02" pos="0 0 0.05"/><site name="mark" pos="0.3 0 0"/>
<site name="tcp" pos="0 0 0.1"/></body></body></body></worldbody><actuator><position joint="lift"/></actuator>
<keyframe><key name="home" qpos="0.5 -0.25"/></keyframe></mujoco>"""


@pytest.mark.parametrize(
    ("name", "asked", "tip", "point"),
    [
        ("site-arm", None, "'tcp' of 'hand'", [0.0, 0.0, 0.1]),
        ("mark-arm", "mark", "'mark' of 'hand'", [0.3, 0.0, 0.0]),
    ],
)
def test_sites_and_keyframe_of_an_mjcf_file_are_used(name, asked, tip, point, tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "arm.xml").write_text(SITES)
    plugin = new.create(name, model="arm.xml", link=asked)
    lines = plugin.summary.split(".\n")
    assert f"lift, wrist of arm.xml bring {tip} to a goal" in lines
    assert "START is the keyframe 'home' of the file" in lines
    assert "Not used of the file: actuators; the task's act() drives the joints by drive_to" in plugin.summary
    with contextlib.closing(EnvSpec(plugin.target, sim=MUJOCO).make()) as env:
        env.reset(seed=0)
        task = env.unwrapped.task
        start = type(task).draw_pose.__globals__["START"]
        assert start == pytest.approx([0.5, -0.25])
        task.arm.set_joints(np.zeros(2))
        assert task.find_tip() == pytest.approx(np.array([0.0, 0.0, 0.3]) + point)
    assert "Attach conflict" not in capfd.readouterr().err  # MuJoCo warns of <size> and <visual>


def test_a_keyframe_outside_the_limits_is_said(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "arm.xml").write_text(SITES.replace('qpos="0.5 -0.25"', 'qpos="30 -15"'))
    summary = new.create("keyed-arm", model="arm.xml").summary
    assert (
        "START is a guess: the keyframe 'home' has lift at 30, outside its limits (a keyframe is in radians)" in summary
    )


def test_a_link_that_its_own_joint_only_turns_is_held_at_its_end(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write(tmp_path, *ARM, link("flange"), joint("roll", "hand", "flange", axis="0 0 1"))
    summary = new.create("end-arm", model="robot.urdf", link="hand").summary
    assert "pan, lift, wrist of robot.urdf bring the end of 'hand' to a goal" in summary
    summary = new.create("roll-arm", model="robot.urdf", link="flange").summary
    assert "bring 'flange' to a goal.\nroll cannot move it, and could be left out of JOINTS" in summary


def test_reach_is_measured_between_joints_not_origins(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "arm.xml").write_text(
        """<mujoco><compiler angle="radian"/><worldbody><body name="foot"><geom size="0.05"/><body name="one">
        <joint name="lift" axis="0 1 0" pos="0 0 0.1" range="-1 1"/><geom size="0.02" pos="0 0 0.3"/><body name="two">
        <joint name="bend" axis="0 1 0" pos="0 0 0.3" range="-1 1"/><geom size="0.02" pos="0.2 0 0.3"/></body></body>
        </body></worldbody></mujoco>"""
    )
    test = (new.create("bent-arm", model="arm.xml").folder / "tests" / "test_task.py").read_text()
    # 0.1 m to the first joint, 0.2 m to the second, 0.3 m to the origin of the last link.
    assert "<= 0.6 " in test
