"""rlctl's own models: found by name, with the numbers of the real robots."""

import sys

import mujoco
import numpy as np
import pytest

from rlctl.errors import TaskError
from rlctl.task.model_files import MODELS, find_model_file
from rlctl.task.pybullet.library import pybullet
from rlctl.task.pybullet.sim import PybulletSim
from rlctl_locomotion import quadruped
from rlctl_manipulation import reach

THEIRS = {"plane.urdf": "plane.urdf", "kuka_iiwa.urdf": "kuka_iiwa/model.urdf", "a1.urdf": "a1/a1.urdf"}
"""The file in pybullet_data that each model takes its numbers from."""


@pytest.fixture
def sim():
    sim = PybulletSim(control_dt=1 / 60, substeps=4)
    yield sim
    sim.close()


def load_both(sim, model):
    """Load a model and the one in pybullet_data, at the same place."""
    data = pytest.importorskip("pybullet_data").getDataPath()
    return sim.load("ours", model, fixed=True), sim.load("theirs", f"{data}/{THEIRS[model]}", fixed=True)


def list_parts(body):
    return range(-1, len(body.link_names))  # -1 is the base


def test_a_file_of_the_current_folder_comes_before_a_model_of_that_name(tmp_path, monkeypatch):
    assert find_model_file("a1.urdf") == MODELS / "a1.urdf"
    monkeypatch.chdir(tmp_path)
    (tmp_path / "a1.urdf").write_text("<robot/>")
    assert find_model_file("a1.urdf").resolve() == tmp_path / "a1.urdf"


def test_models_of_pybullet_data_have_their_names_too():
    data = pytest.importorskip("pybullet_data").getDataPath()
    assert str(find_model_file("kuka_iiwa/model.urdf")) == f"{data}/kuka_iiwa/model.urdf"


def test_without_pybullet_data_the_error_says_how_to_install_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "pybullet_data", None)  # importing it raises ModuleNotFoundError
    assert find_model_file("kuka_iiwa.urdf").is_file()
    with pytest.raises(TaskError) as caught:
        find_model_file("kuka_iiwa/model.urdf")
    assert str(caught.value).startswith(
        "model file 'kuka_iiwa/model.urdf' not found, and rlctl's models are a1.urdf, cube_4cm.urdf, kuka_iiwa.urdf, "
        "plane.urdf. If it is one of PyBullet's: pip install "
    )
    assert str(caught.value).endswith("; for a file next to your module: Path(__file__).with_name('model.urdf')")


def test_a_file_that_is_missing_in_a_folder_names_the_closest_ones(tmp_path):
    for name in ("so100.urdf", "so101_new_calib.urdf", "notes.txt"):
        (tmp_path / name).touch()
    with pytest.raises(TaskError) as caught:
        find_model_file(tmp_path / "so101.urdf")
    assert str(caught.value).endswith("so101.urdf' not found. That folder has: so100.urdf, so101_new_calib.urdf")
    with pytest.raises(TaskError, match=r"arm\.urdf' not found: there is no folder .*nowhere$"):
        find_model_file(tmp_path / "nowhere" / "arm.urdf")


@pytest.mark.slow_except(first=1)
@pytest.mark.pybullet
@pytest.mark.parametrize("model", THEIRS)
def test_numbers_are_those_of_the_model_in_pybullet_data(sim, model):
    ours, theirs = load_both(sim, model)
    assert (ours.base_name, ours.link_names) == (theirs.base_name, theirs.link_names)
    assert ours.all_joint_names == theirs.all_joint_names
    for part in list_parts(ours):
        infos = [pybullet.getDynamicsInfo(body.id, part, physicsClientId=sim.client) for body in (ours, theirs)]
        # Mass, lateral friction, principal inertias, inertial frame, restitution, other frictions, contact stiffness.
        for one, other in zip(*infos, strict=True):
            np.testing.assert_allclose(one, other, rtol=0, atol=1e-9)
        if part < 0:
            continue
        infos = [pybullet.getJointInfo(body.id, part, physicsClientId=sim.client) for body in (ours, theirs)]
        for one, other in zip(*infos, strict=True):  # type, damping, limits, effort, speed, axis, frame, parent
            if isinstance(one, bytes):
                assert one == other
            else:
                np.testing.assert_allclose(one, other, rtol=0, atol=1e-9)


@pytest.mark.pybullet
@pytest.mark.parametrize("model", ["plane.urdf", "a1.urdf"])
def test_collision_shapes_are_those_of_the_model_in_pybullet_data(sim, model):
    ours, theirs = load_both(sim, model)
    for part, name in zip(list_parts(ours), [ours.base_name, *ours.link_names], strict=True):
        shapes = [pybullet.getCollisionShapeData(body.id, part, physicsClientId=sim.client) for body in (ours, theirs)]
        if name == "imu_link":  # a box of 1 mm inside the trunk: it touches nothing
            assert shapes[0] == ()
            continue
        for one, other in zip(*shapes, strict=True):
            assert one[2] == other[2]  # the kind
            for field in (3, 5, 6):  # size, position, orientation
                np.testing.assert_allclose(one[field], other[field], rtol=0, atol=1e-9)


@pytest.mark.pybullet
def test_the_arm_has_the_outline_of_the_real_one(sim):
    ours, theirs = load_both(sim, "kuka_iiwa.urdf")
    rng = np.random.default_rng(0)
    for _ in range(20):
        pose = rng.uniform(ours.joint_low, ours.joint_high)
        ours.set_joints(pose)
        theirs.set_joints(pose)
        pybullet.performCollisionDetection(physicsClientId=sim.client)  # computes the boxes
        for part in list_parts(ours):
            boxes = [pybullet.getAABB(body.id, part, physicsClientId=sim.client) for body in (ours, theirs)]
            np.testing.assert_allclose(*boxes, rtol=0, atol=0.02)  # [m]


@pytest.mark.pybullet
@pytest.mark.parametrize("pose", [reach.HOME, np.zeros(7)], ids=["home", "stretched"])
def test_the_arm_does_not_touch_the_ground_that_it_stands_on(sim, pose):
    plane, arm = sim.load("plane", "plane.urdf", fixed=True), sim.load("arm", "kuka_iiwa.urdf", fixed=True)
    arm.set_joints(pose)
    arm.drive_to(pose)
    sim.step()
    assert not arm.links_touching(plane)


@pytest.mark.pybullet
def test_the_dog_stands_on_its_feet(sim):
    plane, dog = sim.load("plane", "plane.urdf", fixed=True), sim.load("dog", "a1.urdf", position=(0, 0, 0.27))
    joints = dog.find_joints(quadruped.JOINTS)
    pose = np.zeros(len(dog.joint_names))
    pose[joints] = quadruped.STANCE
    dog.set_joints(pose)
    for _ in range(60):
        dog.drive_to(pose)
        sim.step()
    assert set(dog.links_touching(plane)) == set(quadruped.FEET)
    assert dog.mass_state("trunk").position[2] == pytest.approx(0.27, abs=0.02)


@pytest.mark.pybullet
def test_something_falls_on_the_plane_as_on_that_of_pybullet_data(sim):
    heights = []
    for plane in ("plane.urdf", f"{pytest.importorskip('pybullet_data').getDataPath()}/plane.urdf"):
        sim.clear()
        sim.load("plane", plane, fixed=True)
        dog = sim.load("dog", "a1.urdf", position=(0, 0, 0.5))
        for _ in range(60):
            sim.step()
        heights.append(dog.mass_state("trunk"))
    assert heights[0] == heights[1]


@pytest.mark.parametrize(("model", "mass", "joints"), [("kuka_iiwa.urdf", 17.5, 7), ("a1.urdf", 7.744, 12)])
def test_models_load_in_mujoco(model, mass, joints):
    compiled = mujoco.MjSpec.from_file(str(MODELS / model)).compile()
    assert compiled.njnt == joints
    assert compiled.ngeom > joints
    # Without the base, which MuJoCo fixes to the world. The A1: 4 * (0.696 + 0.001 + 1.013 + 0.166 + 0.06) kg.
    assert sum(compiled.body_mass) == pytest.approx(mass, abs=1e-9)


def test_the_plane_loads_in_mujoco():
    compiled = mujoco.MjSpec.from_file(str(MODELS / "plane.urdf")).compile()
    assert (compiled.geom_pos[0] + compiled.geom_size[0]).tolist() == [100, 100, 0]
