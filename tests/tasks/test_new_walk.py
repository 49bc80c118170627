"""`rlctl tasks new --walk`: the plugin of a legged robot stands in a stance that was found in its model."""

import contextlib
import re
import runpy
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from rlctl.engine import MUJOCO
from rlctl.environments.spec import EnvSpec
from rlctl.errors import UsageError
from rlctl.task.mujoco.sim import MujocoSim
from rlctl.tasks import new
from rlctl.tasks.legs import Skeleton, find_legs
from rlctl.tasks.stance import StanceSearch
from rlctl_locomotion.humanoid_walk import SOLE, HumanoidWalk
from rlctl_locomotion.mini_walk import MiniWalk
from tests.tasks.test_new import run

LEG = """<body name="{leg}_hip" pos="{x} {y} 0"><joint name="{leg}_hip" axis="1 0 0" range="-0.8 0.8"
actuatorfrcrange="-9 9"/><geom size="0.02" mass="0.2"/><body name="{leg}_thigh"><joint name="{leg}_thigh" axis="0 1 0"
range="-2 2" actuatorfrcrange="-9 9"/><geom type="capsule" fromto="0 0 -0.02 0 0 -0.13" size="0.01" mass="0.2"/>
<body name="{leg}_shank" pos="0 0 -0.15"><joint name="{leg}_knee" axis="0 1 0" range="-2.6 -0.3"
actuatorfrcrange="-9 9"/><geom type="capsule" fromto="0 0 -0.02 0 0 -0.13" size="0.008" mass="0.08"/>
<geom pos="0 0 -0.15" size="0.015" mass="0.02"/></body></body></body>"""
DOG = """<mujoco model="dog"><compiler angle="radian"/><worldbody><geom type="plane" size="5 5 1"/>
<body name="trunk" pos="0 0 0.4">{free}<geom type="box" size="0.15 0.06 0.04" mass="2"/>{legs}
<body name="head" pos="0.18 0 0.05"><joint name="neck" axis="0 1 0" range="0.2 0.6" actuatorfrcrange="-9 9"/>
<geom size="0.03" mass="0.2"/></body></body></worldbody>{keyframe}</mujoco>"""
KEY = '<keyframe><key name="down" qpos="{0} 0.3"/><key name="home" qpos="{1} 0.3"/></keyframe>'
FEET = ["front_left", "front_right", "rear_left", "rear_right"]


def write_dog(
    folder: Path, *, free: str = "<freejoint/>", keyframe: str = "", pairs: tuple[float, ...] = (0.15, -0.15)
) -> Path:
    places = [(x, y) for x in pairs for y in (0.08, -0.08)]
    legs = "".join(LEG.format(leg=leg, x=x, y=y) for leg, (x, y) in zip(FEET, places, strict=False))
    file = folder / "dog.xml"
    file.write_text(DOG.format(free=free, legs=legs, keyframe=keyframe))
    return file


def write_keyframe(legs: str) -> str:
    folded, given = (f"0 0 0.4 1 0 0 0 {' '.join([leg] * 4)}" for leg in ("0 1.6 -2.5", legs))
    return KEY.format(folded, given)


def read_task(plugin: new.NewPlugin) -> SimpleNamespace:
    """Return what `task.py` defines, in lower case."""
    names = runpy.run_path(str(plugin.folder / plugin.package / "task.py"))
    return SimpleNamespace(**{name.lower(): value for name, value in names.items()})


def check_that_it_stands(plugin: new.NewPlugin, feet: list[str], height: float) -> None:
    """Play 50 steps with zero actions: it must stay up, on its feet only, within 10 % of the stance's height."""
    with contextlib.closing(EnvSpec(plugin.target, sim=MUJOCO).make()) as env:
        env.reset(seed=0)
        task = env.unwrapped.task
        for _ in range(50):
            _, _, terminated, _, _ = env.step(np.zeros(env.action_space.shape, np.float32))
            assert not terminated
        assert task.body.links_touching(task.ground) == set(feet)
        assert task.height == pytest.approx([height], rel=0.1)


@pytest.mark.slow
def test_a_plugin_of_a_users_dog(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_dog(tmp_path)
    plugin = new.create("my-dog", model="dog.xml", walk=True)
    task = read_task(plugin)
    assert len(task.joints) == 12
    front_left, front_right, rear_left, rear_right = task.stance[:12].reshape(4, 3)
    assert front_left == pytest.approx(front_right * (-1, 1, 1))  # hips turn about x: the other way on the other side
    assert rear_left == pytest.approx(rear_right * (-1, 1, 1))
    assert (task.stance[1:12:3] > 0).all()  # knees backwards
    assert task.stance[12] == pytest.approx(0.4)  # the neck: the middle of a range without 0
    # The feet are 77 % of the longest leg below the hips. The knee bends to -0.3 at least, the foot's radius is
    # 15 mm: 2 x 0.15 cos(0.15) + 0.015 = 0.31 m.
    assert task.height == pytest.approx(0.77 * 0.31, rel=0.1)  # the joints give way
    # 4.2 kg x 9.81 x 0.24 m.
    assert task.stiffness == pytest.approx(9.9, abs=0.5)
    assert task.highest[0] == pytest.approx(0.6 * np.sqrt(9.81 * 0.24), abs=0.05)
    assert task.other_side == (-4, 5, 6, -1, 2, 3, -10, 11, 12, -7, 8, 9)
    assert "steps in time" not in plugin.summary
    assert "neck keeps STANCE" in plugin.summary
    assert "dog.xml has no floor" in plugin.summary
    assert b"plane" not in (plugin.folder / "my_dog" / "dog.xml").read_bytes()
    check_that_it_stands(plugin, [f"{leg}_shank" for leg in FEET], task.height)


@pytest.mark.slow
def test_two_legs_step_in_time_with_a_clock(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_dog(tmp_path, pairs=(0.0,))
    plugin = new.create("my-bird", model="dog.xml", walk=True)
    task = read_task(plugin)
    assert "steps in time with a clock" in plugin.summary
    assert task.feet == ["front_left_shank", "front_right_shank"]
    assert task.aside == ["front_left_hip", "front_right_hip"]
    assert task.other_side == (-4, 5, 6, -1, 2, 3)
    with contextlib.closing(EnvSpec(plugin.target, {"start_noise": 0.0}, sim=MUJOCO).make()) as env:
        env.reset(seed=0)
        batch = env.unwrapped.task
        first, terminated, steps = int(batch.phase[0, 1] < 0), False, 0
        while not terminated:
            _, _, terminated, _, _ = env.step(np.zeros(6, np.float32))
            steps += 1
        wanted = batch.wanted[0]
    # Near the top of its first step, at a quarter of the period, it has not lifted that foot.
    assert 0.6 * task.period / 4 < 0.02 * steps < task.period / 4
    assert wanted[first] > 0.9 * task.swing
    assert wanted[1 - first] == 0


@pytest.mark.slow
@pytest.mark.parametrize(
    ("legs", "stance"),
    [("0 0.7 -1.4", [0.0, 0.7, -1.4]), ("0 1.6 -2.5", None)],  # legs that are folded are no stance
)
def test_the_stance_of_a_keyframe(tmp_path, monkeypatch, legs, stance):
    monkeypatch.chdir(tmp_path)
    write_dog(tmp_path, keyframe=write_keyframe(legs))
    plugin = new.create("other-dog", model="dog.xml", walk=True)
    task = read_task(plugin)
    assert ("keyframe 'home'" in plugin.summary) == (stance is not None)
    assert (list(task.stance[:3]) == stance) == (stance is not None)


@pytest.mark.slow
def test_two_legs_that_only_turn_about_y(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    file = write_dog(tmp_path, pairs=(0.0,))
    hips = re.sub(r'<joint name="\w+_hip" axis="1 0 0" [^>]*/>', "", file.read_text().replace("\n", " "))
    file.write_text(hips)
    plugin = new.create("flat-bird", model="dog.xml", walk=True)
    assert not hasattr(read_task(plugin), "aside")
    with contextlib.closing(EnvSpec(plugin.target, sim=MUJOCO).make()) as env:
        env.reset(seed=0)
        _, reward, _, _, _ = env.step(np.zeros(4, np.float32))
    assert np.isfinite(reward)


@contextlib.contextmanager
def search_stance(model):
    """Give the skeleton of a model, its legs and the stance that is found, in which it is placed."""
    with contextlib.closing(MujocoSim(control_dt=0.02, substeps=4)) as sim:
        skeleton = Skeleton(sim.load("robot", model))
        legs, mirror = find_legs(skeleton)
        stance = StanceSearch(skeleton, legs, mirror).find()
        skeleton.place(stance.positions)
        yield skeleton, legs, stance


@pytest.mark.slow
def test_sprawled_legs_stand_to_the_sides():
    """The ant's hips turn about z: all feet are level, farther out than the hips, and the body is off the ground."""
    with search_stance(HumanoidWalk.model.parent / "mujoco/ant.xml") as (skeleton, legs, stance):
        feet = np.array([skeleton.touch(leg.foot) for leg in legs])
    assert (len(legs), [leg.other for leg in legs]) == (4, [3, 2, 1, 0])
    assert np.ptp(feet[:, 2]) < 0.01
    assert np.linalg.norm(feet[:, :2], axis=1).min() > 0.6
    assert stance.clearance > 0.1


# What files of CAD programs have: the axes of a link's frame point anywhere, and a joint is anywhere along its axis.
OTHER_FRAMES = {
    'name="right_knee"': 'name="right_knee" pos="0 0.03 0"',
    'name="right_foot"': 'name="right_foot" euler="1.5708 0 0"',
    'name="left_foot"': 'name="left_foot" euler="1.5708 0 0"',
    'pos="0.005 0 -0.022" size="0.05 0.028 0.008"': 'pos="0.005 -0.022 0" size="0.05 0.008 0.028"',  # of the feet
}


@pytest.mark.slow
def test_the_stance_of_a_robot_with_long_feet_whatever_the_frames_of_its_file(tmp_path):
    text = MiniWalk.model.read_text()
    with search_stance(MiniWalk.model) as (_, legs, stance):
        left, right = (stance.positions[leg.joints] for leg in legs)
    hip_yaw, hip_roll, hip_pitch, knee, ankle_pitch, ankle_roll = left
    assert (hip_yaw, hip_roll, ankle_roll) == (0.0, 0.0, 0.0)
    assert knee > 0.4  # although the feet, pointing down, make the legs longer by a third
    assert hip_pitch + knee + ankle_pitch == pytest.approx(0.0, abs=0.01)  # the soles are level
    assert right.tolist() == left.tolist()
    for before, after in OTHER_FRAMES.items():
        assert before in text
        text = text.replace(before, after)
    (tmp_path / "mini.xml").write_text(text)
    with search_stance(tmp_path / "mini.xml") as (_, _, other):
        assert other.positions == pytest.approx(stance.positions, abs=0.01)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"model": "dog.urdf"}, "--model: model file 'dog.urdf' not found"),
        ({"model": "plane.urdf"}, "--model plane.urdf: it has no joints; --walk makes a task for a robot with legs"),
        (
            {"model": "kuka_iiwa.urdf"},
            "--model: the base 'lbr_iiwa_link_0' of kuka_iiwa.urdf cannot be free without mass",
        ),
        ({"model": "arm.urdf"}, "--model arm.urdf: no link that a joint moves has a collision shape"),
        ({"model": "one.xml"}, "--model one.xml: found no legs: --walk needs pairs of chains of joints"),
        ({"model": "dog.xml"}, "--model dog.xml: its base is fixed; add <freejoint/> to the body 'trunk'"),
        ({"model": "dog.xml", "link": "head"}, "--walk and --link exclude each other"),
        ({}, "--walk needs --model"),
    ],
)
def test_models_that_cannot_be(tmp_path, monkeypatch, given, message):
    monkeypatch.chdir(tmp_path)
    write_dog(tmp_path, free="")
    Path("one.xml").write_text(DOG.format(free="<freejoint/>", legs=LEG.format(leg="only", x=0, y=0.1), keyframe=""))
    Path("arm.urdf").write_text((Path(new.__file__).with_name("arm.urdf")).read_text())
    with pytest.raises(UsageError) as caught:
        new.create("other-dog", **given, walk=True)
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)
    assert not Path("other-dog").exists()


WHEEL = """<body name="{side}" pos="0 {y} 0"><joint name="{side}" axis="0 1 0"/>
<geom type="cylinder" size="0.08 0.02" euler="90 0 0" mass="1"/></body>"""


def test_wheels_are_no_legs(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    file = write_dog(tmp_path, pairs=(0.0,))
    wheels = "".join(WHEEL.format(side=side, y=y) for side, y in (("left", 0.2), ("right", -0.2)))
    dog = file.read_text().replace('<body name="head"', wheels + '<body name="head"').replace("90 0 0", "1.5708 0 0")
    file.write_text(dog)
    with pytest.raises(UsageError, match=r"it stands on wheels \(left, right\), .* docs/task\.md"):
        new.create("wheeled-dog", model="dog.xml", walk=True)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("before", "after", "note"),
    [
        # 4.2 kg x 9.81 x 0.24 m = 9.9 N m
        ("-9 9", "-0.5 0.5", r"The largest torque limit of its legs, 0\.5 N m, is 5.* of weight x leg length, "),
        # 0.3 x 0.12 x 0.08 m is 2,880 cm^3.
        ('mass="2"', 'mass="80"', r"Links denser than any metal: trunk 80 kg in 2\.88e\+03 cm\^3"),
        # A head in a box of 6 m, 216 m^3.
        ('size="0.03" mass="0.2"', 'size="3" mass="0.2"', r"It weighs 4\.2 kg in 216 m\^3, less than air"),
    ],
)
def test_what_cannot_be_is_said(tmp_path, monkeypatch, before, after, note):
    monkeypatch.chdir(tmp_path)
    file = write_dog(tmp_path)
    file.write_text(file.read_text().replace(before, after))
    assert re.search(note, new.create("odd-dog", model="dog.xml", walk=True).summary)


@pytest.mark.slow
def test_a_floor_in_the_file_is_no_part_of_the_robots_volume(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    file = write_dog(tmp_path)
    floor = '<body name="floor"><geom type="plane" size="0 0 1"/></body></worldbody>'
    file.write_text(file.read_text().replace("</worldbody>", floor))
    assert "less than air" not in new.create("floored-dog", model="dog.xml", walk=True).summary


@pytest.mark.slow
def test_a_mirror_that_the_masses_do_not_have_is_left_out(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    file = write_dog(tmp_path)
    # The left thighs are 0.2 kg and the right ones 0.6 kg.
    file.write_text(re.sub(r'(_right_thigh".*?size="0.01" mass=)"0.2"', r'\1"0.6"', file.read_text(), flags=re.DOTALL))
    plugin = new.create("lopsided-dog", model="dog.xml", walk=True)
    assert "Its sides are no mirror images" in plugin.summary
    assert "mirror" not in (plugin.folder / "lopsided_dog" / "task.yaml").read_text()
    assert not hasattr(read_task(plugin), "other_side")


def test_an_arm_that_is_free_may_have_legs(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_dog(tmp_path)
    with pytest.raises(UsageError, match=r"its base is free; .* add --walk"):
        new.create("other-dog", model="dog.xml")


def check_the_plugins_files(plugin: new.NewPlugin, rlctl, *, strict: bool) -> None:
    assert "4 passed" in run("pytest", "-q", "-p", "no:cacheprovider", plugin.folder.name, cwd=plugin.folder.parent)
    run("ruff", "format", "--check", "--isolated", "--line-length", "120", cwd=plugin.folder)
    rules = "E,F,W,I,UP,B,SIM,C4,PT,RET,PIE,NPY"
    run("ruff", "check", "--isolated", "--line-length", "120", "--select", rules, cwd=plugin.folder)
    result = rlctl("check-env", plugin.target, *(["--strict"] if strict else []))
    assert result.returncode == 0, result.stdout


@pytest.mark.slow
def test_the_plugin_of_the_a1(tmp_path, monkeypatch, rlctl):
    monkeypatch.chdir(tmp_path)
    plugin = new.create("my-a1", model="a1.urdf", walk=True)
    task = read_task(plugin)
    # The values that the task `walk` has.
    assert (task.stiffness, task.damping, task.armature) == pytest.approx((35.0, 0.7, 0.01), rel=0.05)
    assert task.highest == pytest.approx([1.0, 0.4, 0.8], rel=0.05)
    check_that_it_stands(plugin, [f"{leg}_toe" for leg in ("FR", "FL", "RR", "RL")], task.height)
    check_the_plugins_files(plugin, rlctl, strict=True)


@pytest.mark.slow
def test_the_plugin_of_a_humanoid(tmp_path, monkeypatch, rlctl):
    monkeypatch.chdir(tmp_path)
    plugin = new.create("my-humanoid", model=str(HumanoidWalk.model), walk=True)
    task = read_task(plugin)
    # The values that the task `humanoid-walk` has.
    assert task.other_side == HumanoidWalk.mirror["action"][:12]
    assert task.highest == pytest.approx(HumanoidWalk.highest, rel=0.05)
    assert task.lowest == pytest.approx(HumanoidWalk.lowest, rel=0.05)
    assert (task.period, task.swing) == pytest.approx((HumanoidWalk.period_s, HumanoidWalk.swing), rel=0.05)
    assert task.soles == pytest.approx([SOLE, SOLE], abs=3e-3)
    assert task.aside == [f"{side}_hip_{axis}" for side in ("left", "right") for axis in ("yaw", "roll")]
    check_the_plugins_files(plugin, rlctl, strict=True)
