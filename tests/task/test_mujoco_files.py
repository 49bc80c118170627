"""Model files in MuJoCo: shapes that are only seen, MJCF files with actuators and sensors, refused files."""

from pathlib import Path

import numpy as np
import pytest

from rlctl.errors import TaskError, UsageError
from rlctl.task.model_files import find_model_file
from rlctl.task.mujoco.sim import MujocoSim
from rlctl.task.pybullet.sim import PybulletSim
from tests.task import mesh_files, models

pytest.importorskip("mujoco")

# As those of the MuJoCo menagerie: an include, a folder of meshes, classes, a keyframe, options and a floor.
ROBOT = """<mujoco model="robot"><compiler angle="radian" meshdir="assets" autolimits="true"/>
<option cone="elliptic" impratio="100" timestep="0.004"/>
<default><default class="leg"><joint armature="0.01" damping="0.1"/>
<position kp="20" ctrlrange="-1 1" forcerange="-5 5"/></default>
<default class="visual"><geom group="2" type="mesh" contype="0" conaffinity="0" density="0"/></default></default>
<asset><mesh file="a.stl" scale="0.1 0.1 0.1"/><material name="grey" rgba=".5 .5 .5 1"/></asset>
<worldbody><body name="trunk" pos="0 0 0.5"><freejoint/>
<inertial pos="0 0 0" mass="1" diaginertia="0.01 0.01 0.01"/>
<geom class="visual" mesh="a" material="grey"/><geom type="box" size=".1 .05 .03"/><site name="imu"/>
<body name="leg" childclass="leg" pos="0 0 -.05"><joint name="hip" axis="0 1 0" range="-1 1"/>
<geom name="shin" type="capsule" size=".02" fromto="0 0 0 0 0 -.2"/></body></body></worldbody>
<actuator><position class="leg" name="servo" joint="hip"/></actuator>
<sensor><gyro name="gyro" site="imu"/><accelerometer name="acceleration" site="imu"/></sensor>
<keyframe><key name="home" qpos="0 0 .3 1 0 0 0 .2" ctrl=".2"/></keyframe></mujoco>"""
SCENE = """<mujoco model="scene"><include file="robot.xml"/><statistic extent="0.8"/>
<worldbody><light pos="0 0 1.5"/><geom name="floor" size="0 0 0.05" type="plane"/></worldbody></mujoco>"""


def make_sim(**kwargs):
    return MujocoSim(control_dt=0.02, substeps=4, **kwargs)


@pytest.fixture
def scene(tmp_path):
    (tmp_path / "assets").mkdir()
    mesh_files.write_stl(tmp_path / "assets" / "a.stl")
    (tmp_path / "robot.xml").write_text(ROBOT)
    (tmp_path / "scene.xml").write_text(SCENE)
    return tmp_path / "scene.xml"


LEGS = """<mujoco model="legs"><worldbody><body name="trunk" pos="0 0 1"><freejoint/><geom size="0.1"/>
<body name="left"><joint name="l" axis="0 1 0"/><geom type="capsule" size="0.05" fromto="0 0 0 0 0 -.5" MASKS/></body>
<body name="right"><joint name="r" axis="0 1 0"/><geom type="capsule" size="0.05" fromto="0 0 0 0 0 -.5" MASKS/></body>
</body></worldbody></mujoco>"""


@pytest.mark.parametrize(
    ("masks", "contacts"), [("", 1), ('contype="1" conaffinity="0"', 0), ('contype="2" conaffinity="6"', 1)]
)
def test_parts_of_a_body_collide_as_the_masks_of_its_file_say(masks, contacts, tmp_path):
    (tmp_path / "legs.xml").write_text(LEGS.replace("MASKS", masks))
    sim = make_sim()
    sim.load("legs", tmp_path / "legs.xml", self_collision=True)
    sim.save()
    sim.step()
    assert sim.data.ncon == contacts


def test_a_model_of_menagerie_falls_onto_its_floor(scene, capfd):
    sim = make_sim()
    robot = sim.load("robot", scene)
    assert (robot.fixed, robot.joint_names, robot.link_names) == (False, ["hip"], ["leg"])
    assert robot.joint_max_force.tolist() == [5.0]  # of the actuator
    sim.save()
    for _ in range(60):
        sim.step()
    # The shin reaches 0.05 + 0.2 + 0.02 m below the trunk's origin.
    assert robot.base_position[2] == pytest.approx(0.27, abs=0.002)
    assert "warning" not in capfd.readouterr().err


def test_actuators_of_the_file_act_after_set_controls_until_the_reset(scene):
    sim = make_sim()
    sim.set_gravity(0.0)
    robot = sim.load("robot", scene)
    sim.save()
    robot.set_joints(np.array([0.3]))
    for _ in range(10):
        sim.step()
    assert robot.joint_positions == pytest.approx([0.3], abs=1e-9)  # the servo would pull it to 0
    for _ in range(100):
        robot.set_controls(np.array([0.5]), ["servo"])
        sim.step()
    assert robot.joint_positions == pytest.approx([0.5], abs=0.01)
    sim.restore()
    robot.set_joints(np.array([0.3]))
    sim.step()
    assert robot.joint_positions == pytest.approx([0.3], abs=1e-9)


def test_sensors_of_the_file(scene):
    sim = make_sim()
    robot = sim.load("robot", scene)
    sim.save()
    for _ in range(60):
        sim.step()
    # It stands: the accelerometer measures what holds it up.
    assert robot.sensor("acceleration") == pytest.approx([0, 0, 9.81], abs=0.05)
    assert robot.sensor("gyro") == pytest.approx([0, 0, 0], abs=1e-3)
    sim.restore()
    assert robot.sensor("acceleration").tolist() == [0, 0, 0]


def test_controls_and_sensors_of_many_worlds(scene):
    sim = make_sim(worlds=3)
    sim.set_gravity(0.0)
    robot = sim.load("robot", scene)
    sim.save()
    for _ in range(100):
        robot.set_controls(np.array([[0.5], [0.0], [-0.5]]))
        sim.step()
    assert robot.joint_positions.ravel() == pytest.approx([0.5, 0.0, -0.5], abs=0.01)
    robot.set_controls(np.ones((3, 1)))
    sim.step()
    assert (robot.sensor("acceleration")[:, 0] != 0).all()
    sim.restore(np.array([1]))
    assert (robot.sensor("acceleration")[:, 0] != 0).tolist() == [True, False, True]


def test_names_that_the_file_has_not(scene):
    robot = make_sim().load("robot", scene)
    with pytest.raises(TaskError, match=r"scene\.xml has no actuator 'srvo'\. Did you mean 'servo'\?"):
        robot.set_controls(np.zeros(1), ["srvo"])
    with pytest.raises(TaskError, match=r"scene\.xml has no sensor 'gyr'\. Did you mean 'gyro'\?"):
        robot.sensor("gyr")
    with pytest.raises(TaskError, match=r"scene\.xml: controls of shape \(2,\) for actuators of shape \(1,\)"):
        robot.set_controls(np.zeros(2))


@pytest.mark.pybullet
def test_pybullet_has_no_controls():
    sim = PybulletSim(control_dt=0.02, substeps=4)
    robot = sim.load("robot", "mjcf/ant.xml")
    with pytest.raises(UsageError, match="set_controls: not in PyBullet"):
        robot.set_controls(np.zeros(8))
    sim.close()


@pytest.mark.parametrize("model", ["ant", "half_cheetah", "humanoid_symmetric", "hopper", "walker2d"])
def test_mjcf_files_of_pybullet_data(model):
    pytest.importorskip("pybullet_data")
    file = find_model_file(f"mjcf/{model}.xml")
    if model == "ant":
        assert len(make_sim().load("robot", file).joint_names) == 8
    else:  # PyBullet reads them, but they are not what MuJoCo 4 calls MJCF
        with pytest.raises(TaskError, match=rf"^MuJoCo cannot load .*{model}\.xml: .*[^\n]$"):
            make_sim().load("robot", file)


def shaped_link(visual, collision):
    shapes = f"<visual>{visual}</visual><collision>{collision}</collision>"
    return models.link("rod", 1.0).replace("</link>", f"{shapes}</link>")


def swing(folder, visual, **kwargs):
    """Positions of a rod that swings into the ground."""
    folder.mkdir()
    mesh_files.write_obj(folder / "a.obj")
    (folder / "flat.obj").write_text("v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nf 1 2 3\nf 1 3 4\n")
    (folder / "one.obj").write_text("v 0 0 0\nv 1 0 0\nv 1 1 0\nf 1 2 3\n")
    box = '<origin xyz="0.1 0 0"/><geometry><box size="0.3 0.04 0.04"/></geometry>'
    rod = (
        shaped_link(visual, box)
        if visual
        else models.link("rod", 1.0).replace("</link>", f"<collision>{box}</collision></link>")
    )
    file = models.urdf(folder, models.link("base", 1.0), rod, models.joint("turn", "base", "rod"))
    sim = make_sim()
    sim.load("ground", "plane.urdf", fixed=True)
    body = sim.load("body", file, position=(0, 0, 0.1), fixed=True, **kwargs)
    sim.save()
    body.disable_motors()
    rows = []
    for _ in range(50):
        sim.step()
        rows.append(body.joint_positions)
    return np.array(rows), sim.model


@pytest.mark.parametrize("inertia", ["file", "shape"])
@pytest.mark.parametrize("mesh", ["a.obj", "flat.obj"])
def test_visual_shapes_change_no_bit_of_the_physics(tmp_path, mesh, inertia):
    visual = f'<geometry><mesh filename="{mesh}"/></geometry>'
    plain, before = swing(tmp_path / "one", "", inertia=inertia)
    drawn, model = swing(tmp_path / "two", visual, inertia=inertia)
    assert np.array_equal(plain, drawn)
    assert (before.nmesh, model.nmesh) == (0, 1)
    assert np.array_equal(before.body_inertia, model.body_inertia)
    # Visual shapes are shown, and collision shapes are not where there are visual ones.
    shown = model.geom_group < 3
    assert [model.geom_type[geom] == 7 for geom in np.flatnonzero(shown)] == [False, True]  # the ground, the mesh


@pytest.mark.parametrize("mesh", ["one.obj", "a.glb"])
def test_a_visual_mesh_that_mujoco_cannot_read_is_left_out(tmp_path, mesh):
    if mesh == "a.glb":
        (tmp_path / "a.glb").write_bytes(b"glTF")
    name = tmp_path / mesh if mesh == "a.glb" else mesh
    _, model = swing(tmp_path / "folder", f'<geometry><mesh filename="{name}"/></geometry>')
    assert model.nmesh == 0
    assert (model.geom_group < 3).all()


def test_many_worlds_have_no_visual_shapes(tmp_path):
    mesh_files.write_obj(tmp_path / "a.obj")
    visual, box = '<geometry><mesh filename="a.obj"/></geometry>', '<geometry><box size="1 1 1"/></geometry>'
    sim = make_sim(worlds=2)
    sim.load("body", models.urdf(tmp_path, shaped_link(visual, box)))
    assert (sim.model.nmesh, sim.model.ngeom) == (0, 1)


def test_inertia_of_shapes_keeps_the_mass_of_the_file(tmp_path):
    box = '<geometry><box size="0.3 0.04 0.04"/></geometry>'
    file = models.urdf(tmp_path, models.link("base", 1.0), shaped_link(box, box), models.joint("turn", "base", "rod"))
    model = (sim := make_sim()).load("body", file, inertia="shape") and sim.model
    rod = model.body("body/rod").id
    assert model.body_mass[rod] == 1.0
    # Of a box of 1 kg: (0.3^2 + 0.04^2) / 12 = 0.00763, 2 * 0.04^2 / 12 = 0.000267.
    assert sorted(model.body_inertia[rod]) == pytest.approx([0.000267, 0.00763, 0.00763], rel=0.01)


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("broken.urdf", "<robot name='r'>\n<link name='a'>\n</robot>", r"mismatched tag: line 3, column 2$"),
        (
            "text.urdf",
            '<?xml version="1.0"?>\n<!-- a\nb -->\n<robot name="r"><link name="a"/>\n<link name="b"><inertial>\n'
            '<mass value="${m}"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>\n'
            '<joint name="j" type="fixed"><parent link="a"/><child link="b"/></joint></robot>',
            r"bad format in attribute 'value' Element 'mass', line 6$",
        ),
        (
            "missing.urdf",
            '<robot name="r"><link name="a"><collision><geometry><mesh filename="no.stl"/></geometry></collision>'
            "</link></robot>",
            r"link 'a': mesh 'no\.stl' not found: neither below",
        ),
        ("broken.xml", "<mujoco>\n<worldbody></mujoco>", "XML_ERROR_MISMATCHED_ELEMENT .*Line number=2"),
        (
            "unknown.xml",
            "<mujoco>\n<worldbody>\n<bodi/></worldbody></mujoco>",
            r"unrecognized element Element 'bodi', line 3",
        ),
        (
            "missing.xml",
            '<mujoco><asset><mesh file="no.stl"/></asset><worldbody><body name="a"><geom type="mesh" mesh="no"/></body>'
            "</worldbody></mujoco>",
            r"Error opening file 'no\.stl'",
        ),
    ],
)
def test_refused_files_are_named_in_one_line(tmp_path, name, text, message):
    file = tmp_path / name
    file.write_text(text)
    with pytest.raises(TaskError, match=message) as caught:
        make_sim().load("robot", file)
    assert "\n" not in str(caught.value)
    assert Path(name).name in str(caught.value)


def test_an_actuator_of_a_joint_that_is_not_there_is_what_mujoco_says(tmp_path):
    (tmp_path / "robot.xml").write_text(
        """<mujoco><worldbody><body name="foot"><joint name="lift"/><geom size="0.1"/></body></worldbody>
        <actuator><motor name="servo" joint="lifd"/></actuator></mujoco>"""
    )
    with pytest.raises(TaskError, match=r"MuJoCo cannot load .*robot.xml: .*'lifd'"):
        make_sim().load("robot", tmp_path / "robot.xml")
