"""`rlctl tasks new --motors --backlash`: plugins of robots with real motors."""

import contextlib
import math

import numpy as np
import pytest

import rlctl
from rlctl.engine import MUJOCO
from rlctl.environments.spec import EnvSpec
from rlctl.errors import UsageError
from rlctl.tasks import new
from tests.tasks.test_hand_robot import write_parallel
from tests.tasks.test_new import run
from tests.tasks.test_new_walk import FEET, check_that_it_stands, read_task, write_dog

LEVER = """<mujoco model="lever"><compiler angle="radian"/><worldbody>
<geom type="plane" size="1 1 1"/><body name="base"><geom size="0.1"/><body name="arm" pos="0 0 0.3">
<joint name="lift" axis="0 1 0" range="-1 1" {more}/>
<geom type="capsule" fromto="0 0 0 0.1 0 0" size="0.01" mass="0.1"/>
</body></body></worldbody></mujoco>"""


@pytest.mark.slow
def test_a_dog_with_hobby_servos(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_dog(tmp_path)
    plugin = new.create("servo-dog", model="dog.xml", walk=True, motors="sts3215", backlash="1deg")
    task = read_task(plugin)
    assert task.motor == "sts3215"
    assert task.motor_values == {"backlash_rad": 0.0175}  # [rad], of 1 degree
    names = ["torque_constant", "motor_bias", "voltage", "motor_friction", "backlash"]
    assert set(names) < set(task.servodog.events)
    assert "motor_strength" not in task.servodog.events
    check_that_it_stands(plugin, [f"{leg}_shank" for leg in FEET], task.height)
    with contextlib.closing(EnvSpec(plugin.target, randomize=True, sim=MUJOCO).make()) as env:
        _, info = env.reset(seed=0)
        assert set(names) <= set(info["events"])
        joints = env.unwrapped.task.describe_joints()
    assert joints.drive_gain == pytest.approx([32.0] * 12)


@pytest.mark.slow
def test_motors_that_are_too_weak(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_dog(tmp_path)
    plugin = new.create("weak-dog", model="dog.xml", walk=True, motors="xl320")
    assert "xl320 is too weak for it" in plugin.summary


def test_what_a_data_sheet_does_not_have_is_a_guess_that_is_marked(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "lever.xml").write_text(LEVER.format(more='actuatorfrcrange="-5 5"'))
    plugin = new.create("my-lever", model="lever.xml", link="arm", motors="mg90s", backlash="0.02rad")
    task = read_task(plugin)
    assert list(task.motor_values) == [
        "stiffness_nm_per_rad",
        "armature_kgm2",
        "damping_nms_per_rad",
        "backlash_rad",
    ]
    code = (plugin.folder / "my_lever" / "task.py").read_text()
    assert "CHANGE: guesses are stiffness_nm_per_rad, armature_kgm2," in code
    with contextlib.closing(rlctl.make(plugin.target)) as env:  # its recipe has MuJoCo
        env.reset(seed=0)
        for _ in range(5):
            env.step(np.ones(1, np.float32))
        assert env.unwrapped.task.arm.motors["lift"].backlash_rad == 0.02


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"motors": "sts3251"}, "--motors: no motor 'sts3251'. Did you mean 'sts3215'?"),
        ({"backlash": "1deg"}, "--backlash needs --motors"),
        ({"motors": "sts3215", "backlash": "1"}, "give an angle with its unit, such as 1deg or 0.02rad"),
        ({"motors": "sts3215", "backlash": "1e999deg"}, "give an angle with its unit"),
        ({"motors": "sts3215", "backlash": "-1deg"}, "from 0 to 20deg"),
        ({"motors": "sts3215", "backlash": "1rad"}, "from 0 to 20deg"),
        ({"motors": "sts3215", "model": None}, "--motors needs --model"),
    ],
)
def test_options_that_cannot_be(tmp_path, monkeypatch, options, message):
    monkeypatch.chdir(tmp_path)
    write_dog(tmp_path)
    with pytest.raises(UsageError) as caught:
        new.create("my-dog", **({"model": "dog.xml", "walk": True} | options if "model" not in options else options))
    assert message in str(caught.value)
    assert not (tmp_path / "my-dog").exists()


@pytest.mark.slow
def test_an_arm_with_hobby_servos_and_another_gripper(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_parallel(tmp_path)
    plugin = new.create("my-arm", model="arm.xml", hand=["pick"], motors="sts3215", backlash="0.5deg")
    with contextlib.closing(EnvSpec(plugin.target, randomize=True, sim=MUJOCO).make()) as env:
        env.reset(seed=0)
        env.step(np.zeros(6, np.float32))
        motors = env.unwrapped.task.arm.motors
    assert list(motors) == ["turn", "shoulder", "elbow", "bend", "roll"]
    assert motors["turn"].backlash_rad == pytest.approx(math.radians(0.5), rel=0.01)
    assert "5 passed" in run("pytest", "-q", "my-arm", cwd=tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["walk", "reach"])
def test_a_plugins_own_files(tmp_path, monkeypatch, kind):
    monkeypatch.chdir(tmp_path)
    if kind == "walk":
        write_dog(tmp_path)
        plugin = new.create("my-dog", model="dog.xml", walk=True, motors="sts3215", backlash="1deg")
    else:
        (tmp_path / "lever.xml").write_text(LEVER.format(more='actuatorfrcrange="-5 5"'))
        plugin = new.create("my-lever", model="lever.xml", link="arm", motors="xl430-w250", backlash="1deg")
    assert "passed" in run("pytest", "-q", str(plugin.folder), cwd=tmp_path)
    rules = "E,F,W,I,UP,B,SIM,C4,PT,RET,PIE,NPY"
    run("ruff", "check", "--isolated", "--line-length", "120", "--select", rules, cwd=plugin.folder)
    run("ruff", "format", "--check", "--isolated", "--line-length", "120", cwd=plugin.folder)
    run("rlctl", "check-env", plugin.target, cwd=tmp_path)
