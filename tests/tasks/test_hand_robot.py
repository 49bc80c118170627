"""`rlctl tasks new --pick`: the gripper is found by moving its joints, and a block where the arm gets to it."""

import contextlib
import ctypes.util
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
from rlctl.tasks.finger_shapes import find_unfit, fit_boxes, replace_shapes
from rlctl.tasks.grippers import Gripper, GripperSearch
from rlctl.tasks.linkage import Linkage
from rlctl.tasks.surfaces import Surfaces
from tests.tasks.test_new import run

# A turning base, three joints that bend the arm forwards, and a wrist that turns about the direction of the hand.
ARM = """<mujoco model="arm"><compiler angle="radian"/><default><geom contype="1" conaffinity="1"/></default>
<worldbody><body name="base"><geom type="cylinder" size="0.05 {foot}" pos="0 0 {foot}"/>
<body name="turret" pos="0 0 {shoulder}"><joint name="turn" axis="0 0 1" range="-2 2" {limit}/>
<geom type="cylinder" size="0.04 0.02" mass="0.2"/>
<body name="upper"><joint name="shoulder" axis="0 1 0" range="-1.6 1.6" {limit}/>
<geom type="capsule" fromto="0 0 0.05 0 0 0.2" size="0.02" mass="0.2"/>
<body name="lower" pos="0 0 0.25"><joint name="elbow" axis="0 1 0" range="-2.6 2.6" {limit}/>
<geom type="capsule" fromto="0 0 0.05 0 0 0.15" size="0.02" mass="0.15"/>
<body name="wrist" pos="0 0 0.2"><joint name="bend" axis="0 1 0" range="-2.2 2.2" {limit}/>
<geom type="capsule" fromto="0 0 0.01 0 0 0.03" size="0.015" mass="0.05"/>
<body name="palm" pos="0 0 0.05"><joint name="roll" axis="0 0 1" range="-2.8 2.8" {limit}/>
<geom type="box" size="0.015 0.05 0.01" mass="0.05"/>{gripper}
</body></body></body></body></body></body></worldbody>{more}</mujoco>"""
LIMIT = 'actuatorfrcrange="-8 8"'
FINGER = """<body name="{name}" pos="0 {y} 0.01"><joint name="{name}_slide" type="slide" axis="0 {side} 0"
range="0 {way}" actuatorfrcrange="-20 20"/><geom type="box" size="0.008 0.004 0.025" pos="0 {shape} 0.025" mass="0.02"/>
{more}</body>"""
MIMIC = '<equality><joint joint1="right_slide" joint2="left_slide"/></equality>'
# The fixed finger is thin, its collision shape fills the space that the jaw closes.
JAW = """<geom type="box" size="0.008 0.004 0.03" pos="0 -0.02 0.04" contype="0" conaffinity="0"/>{fill}
<body name="jaw" pos="0 0.02 0.01"><joint name="jaw_hinge" axis="1 0 0" range="-1.4 0.3" actuatorfrcrange="-3 3"/>
<geom type="box" size="0.008 0.004 0.03" pos="0 0 0.03" mass="0.02"/></body>"""


def write_parallel(folder: Path, *, way: float = 0.03, gap: float = 0.0, more: str = "", **others: str) -> Path:
    """Write an arm whose fingers' faces are `gap` apart when it is closed, and open by `way` each [m]."""
    fingers = [
        FINGER.format(name=name, y=side * gap / 2, side=side, way=way, shape=side * 0.004, more=more)
        for name, side in (("left", 1), ("right", -1))
    ]
    return write_arm(folder, "".join(fingers), **others)


def write_arm(
    folder: Path, gripper: str, *, limit: str = LIMIT, more: str = "", equality: str = "", shoulder: float = 0.1
) -> Path:
    file = folder / "arm.xml"
    foot = max(0.01, (shoulder - 0.02) / 2)
    text = ARM.format(gripper=gripper, limit=limit, more=equality + more, shoulder=shoulder, foot=foot)
    file.write_text(text)
    return file


def load(file: Path) -> tuple[Linkage, Surfaces]:
    return Linkage(MujocoSim(control_dt=0.04, substeps=10).load("arm", file, fixed=True)), Surfaces(file)


def find(file: Path, joint: str | None = None) -> Gripper:
    return GripperSearch(*load(file)).find(joint)


def read_task(plugin: new.NewPlugin) -> SimpleNamespace:
    """Return what `task.py` defines, in lower case."""
    names = runpy.run_path(str(plugin.folder / plugin.package / "task.py"))
    return SimpleNamespace(**{name.lower(): value for name, value in names.items()})


def test_two_fingers_that_slide(tmp_path):
    gripper = find(write_parallel(tmp_path))
    assert gripper.palm == "palm"
    assert gripper.arm == [0, 1, 2, 3, 4]
    assert gripper.drivers == gripper.joints == [5, 6]
    assert gripper.fingers == (["left"], ["right"])
    assert gripper.opening == pytest.approx(0.06, abs=1e-3)
    assert gripper.open[5:] == pytest.approx([0.03, 0.03])
    assert gripper.closed[5:] == pytest.approx([0.0, 0.0], abs=2e-3)
    assert gripper.width == pytest.approx(0.03, abs=1e-3)
    assert gripper.frame[:, 2] == pytest.approx([0, 0, 1])
    assert gripper.frame[:, 0] == pytest.approx([0, 1, 0])
    # The tips are 6 cm above the palm's origin.
    assert gripper.point == pytest.approx([0, 0, 0.06 - gripper.depth], abs=2e-3)


def test_a_joint_that_follows_is_no_driver(tmp_path):
    gripper = find(write_parallel(tmp_path, equality=MIMIC))
    assert gripper.joints == [5, 6]
    assert gripper.drivers == [5]
    assert gripper.closed[6] == pytest.approx(gripper.closed[5], abs=1e-4)
    assert gripper.open[6] == pytest.approx(0.03, abs=1e-4)


def test_one_jaw_that_turns(tmp_path):
    gripper = find(write_arm(tmp_path, JAW.format(fill="")))
    assert gripper.drivers == [5]
    assert gripper.fingers == (["jaw"], ["palm"])
    assert gripper.has_fixed_finger
    # The jaw is 4 cm away and 6 cm long: atan(0.032 / 0.06) is about 0.5 rad. It does not turn by more than 1.1 rad.
    assert gripper.open[5] == pytest.approx(gripper.closed[5] - 1.1, abs=0.1)
    assert gripper.closed[5] == pytest.approx(0.3, abs=0.05)
    assert gripper.frame[:, 2] == pytest.approx([0, 0, 1], abs=1e-6)


def test_loops_are_closed(tmp_path):
    linkage, _ = load(write_parallel(tmp_path, equality=MIMIC))
    positions = np.zeros(7)
    positions[5] = 0.02
    assert linkage.close_loops(positions, [6])[6] == pytest.approx(0.02, abs=1e-5)
    assert linkage.parents == [-1, 0, 1, 2, 3, 4, 4]


def test_a_hull_that_fills_the_gripper_becomes_boxes(tmp_path):
    fill = '<geom type="box" size="0.008 0.02 0.03" pos="0 -0.004 0.04" group="3"/>'
    file = write_arm(tmp_path, JAW.format(fill=fill))
    linkage, surfaces = load(file)
    gripper = GripperSearch(linkage, surfaces).find(None)
    assert find_unfit(file, linkage, gripper) == ["palm"]
    boxes = fit_boxes(["palm"], linkage, surfaces, gripper)
    files = {Path("arm.xml"): file.read_bytes()}
    replace_shapes(files, Path("arm.xml"), boxes)
    file.write_bytes(files[Path("arm.xml")])
    assert find_unfit(file, *load(file)[:1], gripper) == []


def test_shapes_that_hold_are_kept(tmp_path):
    file = write_parallel(tmp_path)
    linkage, surfaces = load(file)
    assert find_unfit(file, linkage, GripperSearch(linkage, surfaces).find(None)) == []


@pytest.mark.parametrize(
    ("gripper", "expected"),
    [
        ("", "no gripper: no joint at its end moves a link towards another one; name one with --gripper JOINT"),
        (
            "".join(
                FINGER.format(name=name, y=side * 0.04, side=side, way=0.03, shape=side * 0.004, more="")
                for name, side in (("left", 1), ("right", -1))
            ),
            "the gripper never closes: between 'left' and 'right' remain 80 of 140 mm; correct the limits",
        ),
    ],
)
def test_grippers_that_are_none(tmp_path, gripper, expected):
    with pytest.raises(UsageError, match=r"arm\.xml") as error:
        find(write_arm(tmp_path, gripper))
    assert expected in str(error.value)


def test_meshes_in_millimetres(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_parallel(tmp_path, more='<geom type="box" size="8 4 25" contype="0" conaffinity="0"/>')
    with pytest.raises(UsageError, match=r"'left' is 53 m long.*millimetres.*0.001 0.001 0.001"):
        new.create("my-arm", model="arm.xml", hand=["pick"])


def test_a_model_in_millimetres(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    file = write_parallel(tmp_path)
    text = file.read_text().replace('pos="0 0 0.25"', 'pos="0 0 250"')
    file.write_text(text)
    with pytest.raises(UsageError, match=r"joints are 250 m apart.*millimetres; divide its lengths by 1000"):
        new.create("my-arm", model="arm.xml", hand=["pick"])


def test_missing_meshes(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_parallel(tmp_path, equality='<asset><mesh name="hand" file="hand.stl"/></asset>')
    with pytest.raises(UsageError, match=r"hand\.stl"):
        new.create("my-arm", model="arm.xml", hand=["pick"])


@pytest.mark.slow
def test_an_arm_that_does_not_reach_the_table(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    file = write_parallel(tmp_path)
    file.write_text(file.read_text().replace('range="-1.6 1.6"', 'range="-0.2 0.2"'))
    with pytest.raises(UsageError, match=r"cannot reach the table, z = 0.*--tip FRAME"):
        new.create("my-arm", model="arm.xml", hand=["pick"])


@pytest.mark.slow_except(first=3)
@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ({"hand": ["pick"]}, "--pick needs --model"),
        ({"hand": ["pick", "push"], "model": "arm.xml"}, "--pick and --push exclude each other"),
        ({"hand": ["place"], "walk": True, "model": "arm.xml"}, "--walk and --place exclude each other"),
        ({"hand": ["pick"], "link": "palm", "model": "arm.xml"}, "--pick and --link exclude each other"),
        ({"gripper": "jaw", "model": "arm.xml"}, "--gripper needs --pick, --place or --push"),
        ({"hand": ["pick"], "gripper": "left_slid", "model": "arm.xml"}, "Did you mean 'left_slide'?"),
        ({"hand": ["pick"], "tip": "left", "model": "arm.xml"}, "does not move with the palm; choose one of: palm"),
    ],
)
def test_options_that_do_not_fit(tmp_path, monkeypatch, options, expected):
    monkeypatch.chdir(tmp_path)
    write_parallel(tmp_path)
    with pytest.raises(UsageError) as error:
        new.create("my-arm", **options)
    assert expected in str(error.value)


@pytest.fixture(scope="module")
def plugin(tmp_path_factory):
    """A plugin `my-arm` of an arm without effort limits, raised by 5 cm, whose `tip` is between the fingers."""
    folder = tmp_path_factory.mktemp("pick")
    with contextlib.chdir(folder):
        write_parallel(folder, limit="")
        plugin = new.create("my-arm", model="arm.xml", hand=["pick"])
        yield plugin


@pytest.mark.slow
def test_what_a_plugin_contains(plugin):
    task = read_task(plugin)
    assert task.arm == ["turn", "shoulder", "elbow", "bend", "roll"]
    assert task.gripper == ["left_slide", "right_slide"]
    assert 0.01 < task.half < 0.025
    assert (np.array(task.area_low) < task.area_high).all()
    assert np.linalg.norm(task.area_high) < 0.55  # [m], the arm's length
    assert len(task.max_force) == 7
    assert task.max_force[5] < 20
    assert "no useful effort limit for turn, shoulder, elbow, bend, roll" in plugin.summary
    assert "opens 60 mm" in plugin.summary


@pytest.mark.slow
def test_it_waits_above_the_table_with_an_open_gripper(plugin):
    with contextlib.closing(EnvSpec(plugin.target, sim=MUJOCO).make()) as env:
        env.reset(seed=0)
        task = env.unwrapped.task
        for _ in range(10):
            env.step(np.zeros(6, np.float32))
        assert not task.arm.links_touching(task.ground)
        assert task.opened() == pytest.approx([1.0])
        low, high = np.array(read_task(plugin).area_low), np.array(read_task(plugin).area_high)
        assert task.find_tip()[0, :2] == pytest.approx((low + high) / 2, abs=0.03)
        assert task.find_tip()[0, 2] > 0.05


@pytest.mark.slow
@pytest.mark.skipif(ctypes.util.find_library("EGL") is None, reason="needs libEGL")
def test_its_cameras_see_the_block(plugin):
    spec = EnvSpec(plugin.target, sim=MUJOCO, observe=("camera", "wrist_camera", "tip", "tip_to_goal"))
    with contextlib.closing(spec.make_worlds(2)) as worlds:
        before = worlds.reset(np.arange(2), [0, 1])
        middle = (np.array(read_task(plugin).area_low) + read_task(plugin).area_high) / 2
        worlds.task.block.set_base(np.tile([*middle, 5.0], (2, 1)), (0, 0, 0, 1), worlds=np.arange(2))
        after = worlds.step(np.zeros((2, 6), np.float32)).observation
        for camera in ("camera", "wrist_camera"):
            changed = (np.abs(before[camera].astype(int) - after[camera]) > 30).any(axis=-1)
            assert (changed.reshape(2, -1).sum(axis=1) >= 4).all()  # [pixels], where the block was


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["pick", "place", "push"])
def test_a_plugins_own_tests_pass(tmp_path, monkeypatch, kind):
    monkeypatch.chdir(tmp_path)
    write_parallel(tmp_path, equality=MIMIC)
    new.create(f"my-{kind}er", model="arm.xml", hand=[kind])
    assert "5 passed" in run("pytest", "-q", f"my-{kind}er", cwd=tmp_path)
