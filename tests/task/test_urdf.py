"""URDF files as people have them: found meshes, repaired inertias and frames, the same in both engines."""

import re
import tempfile

import numpy as np
import pytest

from rlctl.errors import TaskError
from rlctl.task.model_faults import find_frames, find_model_faults
from rlctl.task.mujoco.sim import MujocoSim
from rlctl.task.pybullet.library import pybullet
from rlctl.task.pybullet.sim import PybulletSim
from rlctl.task.urdf import find_possible_moments, read_urdf
from tests.task import mesh_files, models

pytest.importorskip("mujoco")


@pytest.fixture(params=[pytest.param("pybullet", marks=pytest.mark.pybullet), "mujoco"])
def sim(request):
    simulations = {"pybullet": PybulletSim, "mujoco": MujocoSim}
    made = simulations[request.param](control_dt=1 / 60, substeps=4)
    yield made
    made.close()


@pytest.fixture
def package(tmp_path):
    """A ROS package with a mesh of each kind."""
    folder = tmp_path / "hand_description"
    for name in ("meshes", "urdf"):
        (folder / name).mkdir(parents=True)
    for name, write in mesh_files.WRITERS.items():
        write(folder / "meshes" / name)
    return folder


def write_hand(folder, mesh, *, inertia=(1e-4, 1e-4, 1e-4), mass=0.05, more=""):
    """A base and a finger with a mesh."""
    ixx, iyy, izz = inertia
    shape = f'<geometry><mesh filename="{mesh}" scale="0.1 0.1 0.1"/></geometry>'
    finger = (
        f'<link name="finger"><inertial><mass value="{mass}"/><inertia ixx="{ixx}" iyy="{iyy}" izz="{izz}" ixy="0" '
        f'ixz="0" iyz="0"/></inertial><visual>{shape}</visual><collision>{shape}</collision></link>'
    )
    return models.urdf(folder, models.link("base", 1.0), finger, models.joint("bend", "base", "finger"), more)


def read_dynamics(body, link):
    """Mass [kg] and sorted principal moments [kg m^2] of a link."""
    if body.engine == "MuJoCo":
        number, model = body.find_link(link), body._sim.model
        return model.body_mass[number], np.sort(model.body_inertia[number])
    info = pybullet.getDynamicsInfo(body.id, body._part_index(link), physicsClientId=body.client)
    return info[0], np.sort(info[2])


@pytest.mark.parametrize("mesh", mesh_files.WRITERS)
@pytest.mark.parametrize("prefix", ["package://hand_description/", "file://{}/", "../"])
def test_meshes_of_packages_are_found(sim, package, mesh, prefix):
    file = write_hand(package / "urdf", prefix.format(package) + f"meshes/{mesh}")
    hand = sim.load("hand", file, fixed=True)
    hand.set_joints(np.zeros(1))
    assert hand.file == file
    sim.save()
    for _ in range(60):
        hand.drive_to(np.ones(1))
        sim.step()
    assert hand.joint_positions == pytest.approx([1.0], abs=0.02)


@pytest.mark.parametrize("variable", ["ROS_PACKAGE_PATH", "AMENT_PREFIX_PATH"])
def test_packages_elsewhere_are_found_by_the_variables_of_ros(sim, package, tmp_path, monkeypatch, variable):
    root = tmp_path / "elsewhere"
    target = root / "share" if variable == "AMENT_PREFIX_PATH" else root
    target.mkdir(parents=True)
    package.rename(target / "other_package")
    file = write_hand(tmp_path, "package://other_package/meshes/a.stl")
    with pytest.raises(TaskError, match=r"link 'finger': mesh 'package://other_package/meshes/a\.stl' not found: nei"):
        sim.load("hand", file)
    monkeypatch.setenv(variable, f"/nowhere:{root}")
    assert sim.load("hand", file).link_names == ["finger"]


def test_an_impossible_inertia_is_replaced_in_both_engines(sim, package):
    file = write_hand(package / "urdf", "../meshes/a.stl", inertia=(1e-4, 1e-4, 1e-3))
    hand = sim.load("hand", file, fixed=True)
    mass, moments = read_dynamics(hand, "finger")
    assert mass == 0.05
    # The largest stays; the others are raised by (1e-3 - 2e-4) / 2 each.
    assert moments == pytest.approx([5e-4, 5e-4, 1e-3], rel=1e-6)
    (fault,) = find_model_faults(hand)
    assert fault == (
        "model.urdf, link 'finger': principal moments 0.0001, 0.0001, 0.001 kg m^2: the largest exceeds the sum of the "
        "others, which no solid body has. It has 0.0005, 0.0005, 0.001 instead."
    )


@pytest.mark.parametrize(
    ("moments", "possible"),
    [
        ((0.1, 0.2, 0.3), None),  # a flat plate
        ((0.1, 0.1, 0.3), (0.15, 0.15, 0.3)),
        ((0.0, 0.2, 0.2), (2e-6, 0.2, 0.2)),  # a rod of 2 kg: 2 * 0.001^2
        ((0.0, 0.0, 0.0), (2e-6, 2e-6, 2e-6)),
        ((-1.0, 0.1, 0.4), (0.150001, 0.249999, 0.4)),  # 2e-6 and 0.1, raised by (0.4 - 0.100002) / 2 each
    ],
)
def test_possible_moments(moments, possible):
    found = find_possible_moments(np.array(moments), 2.0)
    assert (found is None) == (possible is None)
    assert possible is None or found == pytest.approx(possible, rel=1e-6)


def test_replaced_moments_keep_their_axes(tmp_path):
    turned = '<inertia ixx="0.2" iyy="0.2" izz="0.1" ixy="0.1" ixz="0" iyz="0"/>'  # 0.1 and 0.3 at 45 degrees, 0.1
    link = f'<link name="a"><inertial><mass value="1"/>{turned}</inertial></link>'
    urdf = read_urdf(models.urdf(tmp_path, link))
    inertia = urdf.root.find("link/inertial/inertia")
    values = [float(inertia.get(name)) for name in ("ixx", "iyy", "izz", "ixy", "ixz", "iyz")]
    # 0.15, 0.15 and 0.3: (0.15 + 0.3) / 2 on the diagonal, half of the difference beside it.
    assert values == pytest.approx([0.225, 0.225, 0.15, 0.075, 0.0, 0.0], abs=1e-8)


@pytest.mark.parametrize("mass", [1e-16, 1e-9, 1e-5])
def test_frames_of_generators_load_in_both_engines(sim, tmp_path, mass):
    # onshape-to-robot writes frames with hardly any mass and no inertia.
    zeros = " ".join(f'{name}="0"' for name in ("ixx", "iyy", "izz", "ixy", "ixz", "iyz"))
    frame = f'<link name="tip"><inertial><mass value="{mass}"/><inertia {zeros}/></inertial></link>'
    parts = models.link("base", 1.0), models.link("arm", 0.5), models.joint("turn", "base", "arm"), frame
    robot = sim.load(
        "robot", models.urdf(tmp_path, *parts, models.joint("end", "arm", "tip", kind="fixed")), fixed=True
    )
    # Mass times (1 mm)^2, and at least that of 1 mg.
    assert read_dynamics(robot, "tip")[1] == pytest.approx([max(mass, 1e-6) * 1e-6] * 3)
    assert find_model_faults(robot) == []
    sim.step()
    assert np.isfinite(robot.link_position("tip")).all()


@pytest.mark.parametrize("fixed", [True, False])
def test_frames_weigh_a_milligram_in_both_engines(sim, tmp_path, fixed):
    file = models.urdf(
        tmp_path,
        '<link name="footprint"/><link name="camera"/><link name="slide"/>',
        models.link("hull", 1.0),
        models.link("arm", 0.5),
        models.joint("root", "footprint", "hull", kind="fixed"),
        models.joint("mount", "hull", "camera", kind="fixed"),
        models.joint("lift", "hull", "slide", kind="prismatic"),
        models.joint("turn", "slide", "arm"),
    )
    robot = sim.load("robot", file, fixed=fixed)
    frames = ["camera", "slide"] if fixed else ["footprint", "camera", "slide"]
    for link in frames:
        mass, moments = read_dynamics(robot, link)
        assert mass == 1e-6
        assert moments == pytest.approx([1e-9] * 3)
    names = ", ".join(map(repr, frames))
    assert find_frames(robot) == f"model.urdf: links without <inertial> weigh 1 mg: {names}"
    assert find_model_faults(robot) == []
    sim.load("ground", "plane.urdf", fixed=True)
    for _ in range(60):
        sim.step()
    assert np.isfinite(robot.link_position("arm")).all()


def test_what_a_joint_moves_alone_weighs_a_kilogram(sim, tmp_path):
    wheel = '<link name="wheel"><collision><geometry><sphere radius="0.1"/></geometry></collision></link>'
    file = models.urdf(tmp_path, models.link("base", 1.0), wheel, models.joint("axle", "base", "wheel"))
    robot = sim.load("robot", file, fixed=True)
    assert read_dynamics(robot, "wheel")[0] == 1.0
    assert find_model_faults(robot) == [
        "model.urdf, link 'wheel': no <inertial>, so it weighs 1 kg. Write its mass and inertia."
    ]


def test_a_file_that_needs_no_change_is_loaded_itself(tmp_path):
    world = '<link name="world"/>'
    file = models.urdf(tmp_path, world, models.link("arm", 1.0), models.joint("turn", "world", "arm"))
    assert not read_urdf(file, fixed=True).changed
    assert read_urdf(file, fixed=False).guessed == ["world"]


@pytest.mark.pybullet
def test_a_changed_file_is_read_again_after_it_was_edited(tmp_path):
    # PyBullet keeps what it has read, by path.
    sim = PybulletSim(control_dt=1 / 60, substeps=4)
    for name, mass in (("one", 0.05), ("two", 0.07)):
        mesh_files.write_stl(tmp_path / "a.stl")
        hand = sim.load(name, write_hand(tmp_path, "a.stl", inertia=(1e-4, 1e-4, 1e-3), mass=mass))
        assert read_dynamics(hand, "finger")[0] == mass
    sim.close()


BOX = '<collision><geometry><box size="0.1 0.1 0.3"/></geometry></collision>'


def test_two_bases(sim, tmp_path):
    file = models.urdf(tmp_path, models.link("a", 1.0), models.link("b", 1.0))
    with pytest.raises(TaskError, match=r"model\.urdf: 2 links are no joint's child \('a', 'b'\); a URDF has one base"):
        sim.load("robot", file)


def test_two_joints_of_one_name(sim, tmp_path):
    joints = models.joint("elbow", "a", "b"), models.joint("elbow", "b", "c")
    file = models.urdf(tmp_path, *(models.link(name, 1.0) for name in "abc"), *joints)
    with pytest.raises(TaskError, match=r"model\.urdf: 2 joints are called 'elbow'; give each its own name"):
        sim.load("robot", file)


@pytest.mark.parametrize(
    ("before", "after", "message"),
    [
        ('joint name="elbow"', 'joint name=""', "the joint to link 'b' has no name; give it one"),  # crashes PyBullet
        ('joint name="elbow"', "joint", "the joint to link 'b' has no name; give it one"),
        ('link name="b"', "link", "link 2 has no name; give it one"),
        ('mass value="1.0"', 'mass value="inf"', "link 'a' has a mass of inf kg; write its mass"),
        ('mass value="1.0"', 'mass value="nan"', "link 'a' has a mass of nan kg; write its mass"),
    ],
)
def test_what_no_engine_loads(sim, tmp_path, before, after, message):
    file = models.urdf(tmp_path, models.link("a", 1.0), models.link("b", 1.0), models.joint("elbow", "a", "b"))
    assert before in file.read_text()
    file.write_text(file.read_text().replace(before, after))
    with pytest.raises(TaskError, match=re.escape(f"model.urdf: {message}")):
        sim.load("robot", file)


def test_a_file_in_latin_1_that_does_not_say_so(sim, tmp_path):
    file = models.urdf(tmp_path, models.link("a", 1.0), models.link("b", 1.0), models.joint("größe", "a", "b"))
    file.write_bytes(file.read_text(encoding="utf-8").encode("latin-1"))
    assert sim.load("robot", file, fixed=True).joint_names == ["größe"]


def test_a_missing_visual_mesh_is_a_fault_and_collision_shapes_are_drawn(sim, tmp_path):
    visual = '<visual><geometry><mesh filename="package://other/arm.dae"/></geometry></visual>'
    arm = models.link("arm", 1.0).replace("</link>", f"{visual}{BOX}</link>")
    file = models.urdf(tmp_path, models.link("base", 1.0), arm, models.joint("turn", "base", "arm"))
    body = sim.load("robot", file, fixed=True)
    fault = "model.urdf, link 'arm': its visual mesh 'package://other/arm.dae' is missing. Its other shapes are drawn."
    assert find_model_faults(body) == [fault]
    urdf = read_urdf(file)
    assert urdf.root is not None
    assert urdf.root.find("link[@name='arm']/visual/geometry/box") is not None


def test_of_several_materials_the_first_is_drawn(sim, tmp_path):
    colors = {"red": "1 0 0 1", "green": "0 1 0 1", "blue": "0 0 1 1"}
    materials = "".join(f'<material name="{name}"><color rgba="{rgba}"/></material>' for name, rgba in colors.items())
    visual = f'<visual><geometry><box size="0.1 0.1 0.1"/></geometry>{materials}</visual>'
    arm = models.link("arm", 1.0).replace("</link>", f"{visual}{BOX}</link>")
    file = models.urdf(tmp_path, models.link("base", 1.0), arm, models.joint("turn", "base", "arm"))
    body = sim.load("robot", file, fixed=True)
    assert find_model_faults(body) == ["model.urdf, link 'arm': a shape with 3 materials. The first is drawn."]
    urdf = read_urdf(file)
    assert urdf.root is not None
    assert [material.get("name") for material in urdf.root.iterfind("link/visual/material")] == ["red"]


@pytest.mark.pybullet
def test_a_changed_file_leaves_nothing_behind(tmp_path, monkeypatch):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "tmp"))
    (tmp_path / "tmp").mkdir()
    sim = PybulletSim(control_dt=1 / 60, substeps=4)
    mesh_files.write_stl(tmp_path / "a.stl")
    hand = sim.load("hand", write_hand(tmp_path, "a.stl", inertia=(1e-4, 1e-4, 1e-3)))
    assert hand.file == tmp_path / "model.urdf"
    with pytest.raises(TaskError, match=rf"^PyBullet cannot load {tmp_path}/model\.urdf: ") as caught:
        sim.load("broken", models.urdf(tmp_path, '<link name="a"><visual><geometry/></visual></link>'))
    assert "rlctl-" not in str(caught.value)
    assert list((tmp_path / "tmp").iterdir()) == []
    sim.close()
