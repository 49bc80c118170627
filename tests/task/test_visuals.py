"""Worlds without visual shapes, as workers build them: the same physics and pictures, in less memory."""

import ctypes.util

import numpy as np
import pytest

from rlctl.task.mujoco.sim import MujocoSim
from tests.task import mesh_files, models

pytest.importorskip("mujoco")

FACES = 40  # of a sphere's latitude and longitude


def write_ball(file):
    """A sphere of 5 cm as text of STL, with a point inside that its hull does not have."""
    turn, rise = np.linspace(0, 2 * np.pi, FACES), np.linspace(0, np.pi, FACES)
    grid = 0.05 * np.stack(
        [np.outer(np.sin(rise), np.cos(turn)), np.outer(np.sin(rise), np.sin(turn)), np.outer(np.cos(rise), turn**0)],
        -1,
    )
    corners = np.stack([grid[:-1, :-1], grid[1:, :-1], grid[1:, 1:]], 2).reshape(-1, 3)
    corners = np.concatenate([corners, [[0, 0, 0.01], [0, 0.01, 0], [0.01, 0, 0]]])
    lines = ["vertex " + " ".join(f"{value:.5f}" for value in corner) for corner in corners]
    file.write_text("solid ball\n" + "\n".join(lines) + "\nendsolid ball\n")


def write_robot(folder):
    """A ball on a slide, drawn as a tetrahedron of another file."""
    write_ball(folder / "ball.stl")
    mesh_files.write_stl(folder / "drawn.stl")
    ball = (
        '<link name="ball"><inertial><mass value="1"/><inertia ixx="1e-3" iyy="1e-3" izz="1e-3" ixy="0" ixz="0" '
        'iyz="0"/></inertial><visual><geometry><mesh filename="drawn.stl" scale="0.1 0.1 0.1"/></geometry></visual>'
        '<collision><geometry><mesh filename="ball.stl"/></geometry></collision></link>'
    )
    return models.urdf(folder, models.link("base", 1.0), ball, models.joint("drop", "base", "ball", kind="prismatic"))


def make_sim(file, *, visuals):
    sim = MujocoSim(control_dt=0.02, substeps=4, visuals=visuals)
    sim.load("ground", "plane.urdf", fixed=True)
    robot = sim.load("robot", file, position=(0, 0, 0.1), orientation=(0, 0.7071068, 0, 0.7071068), fixed=True)
    sim.save()
    return sim, robot


def fall(sim, robot):
    robot.set_color((1, 0, 0), ["ball"])
    robot.set_base((0.0, 0.1, 0.1), (0, 0.7071068, 0, 0.7071068))
    for _ in range(40):
        sim.step()
    return robot.joint_positions.tobytes()


def test_physics_has_the_same_bits_without_visual_shapes(tmp_path):
    file = write_robot(tmp_path)
    worlds = [make_sim(file, visuals=visuals) for visuals in (True, False)]
    assert [sim.model.nmesh for sim, _ in worlds] == [2, 1]
    assert fall(*worlds[0]) == fall(*worlds[1])


@pytest.mark.slow
@pytest.mark.skipif(ctypes.util.find_library("EGL") is None, reason="needs libEGL")
def test_pictures_are_the_same_without_visual_shapes(tmp_path):
    file = write_robot(tmp_path)
    worlds = [make_sim(file, visuals=visuals) for visuals in (True, False)]
    taken = []
    for change in (lambda sim, robot: fall(sim, robot), lambda sim, _: sim.restore()):  # a reset: the file's colours
        for world in worlds:
            change(*world)
        taken.append([sim.render(64, 48, eye=(0.5, 0.1, 0.3), target=(0, 0.1, 0)) for sim, _ in worlds])
        np.testing.assert_array_equal(*taken[-1])
    assert (taken[0][0] != taken[1][0]).any()


def test_a_detailed_mesh_collides_as_its_hull(tmp_path):
    sim, robot = make_sim(write_robot(tmp_path), visuals=False)
    mesh = sim.model.mesh_vert
    assert 1000 < len(mesh) < (FACES - 1) ** 2  # without the points inside and those that rows share
    assert np.linalg.norm(mesh, axis=1) == pytest.approx(0.05, abs=1e-3)
    assert robot.distance_to(sim.body("ground")) == pytest.approx(0.05, abs=1e-3)  # the ball is at 0.1 m


MJCF = """<mujoco><asset><mesh file="drawn.stl"/><mesh name="ball" file="drawn.stl"/></asset><worldbody>
<body name="trunk"><freejoint/><inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/><geom name="held" size="0.1"
contype="0" conaffinity="0"/><geom type="mesh" mesh="drawn" contype="0" conaffinity="0"/><geom size="0.1"/>
<body><joint/><geom type="mesh" mesh="ball" contype="0" conaffinity="0"/></body></body></worldbody></mujoco>"""


@pytest.mark.parametrize(("visuals", "meshes"), [(True, 2), (False, 1)])
def test_mjcf_keeps_what_has_mass_or_a_name(tmp_path, visuals, meshes):
    mesh_files.write_stl(tmp_path / "drawn.stl")
    (tmp_path / "robot.xml").write_text(MJCF)
    sim = MujocoSim(control_dt=0.02, substeps=4, visuals=visuals)
    sim.load("robot", tmp_path / "robot.xml")
    # The second body has its mass from its visual mesh: 1000 kg/m^3 of 1/6 m^3.
    assert sim.model.body_mass[2] == pytest.approx(1000 / 6, rel=1e-3)
    assert (sim.model.nmesh, sim.model.ngeom) == (meshes, meshes + 2)
