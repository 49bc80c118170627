"""What a URDF says of masses, inertias and joints: used, and judged."""

import numpy as np
import pytest

from rlctl.task.model_faults import find_model_faults
from rlctl.task.pybullet.library import pybullet
from rlctl.task.pybullet.sim import PybulletSim
from tests.task import models

pytestmark = pytest.mark.pybullet

BOX = '<collision><geometry><box size="0.3 0.04 0.04"/></geometry></collision>'


@pytest.fixture
def sim():
    sim = PybulletSim(control_dt=1 / 60, substeps=4)
    yield sim
    sim.close()


def load(sim, folder, inertial, **kwargs):
    """A held base and one link of 0.3 m x 0.04 m x 0.04 m."""
    link = f'<link name="rod">{inertial}{BOX}</link>'
    file = models.urdf(folder, models.link("base", 1.0), link, models.joint("joint", "base", "rod"))
    return sim.load(f"body {len(sim.bodies)}", file, fixed=True, **kwargs)


def inertial(ixx, iyy, izz, mass=1.0):
    values = f'ixx="{ixx}" iyy="{iyy}" izz="{izz}" ixy="0" ixz="0" iyz="0"'
    return f'<inertial><mass value="{mass}"/><inertia {values}/></inertial>'


def diagonal(body):
    return pybullet.getDynamicsInfo(body.id, 0, physicsClientId=body.client)[2]


def test_the_inertia_of_the_file(sim, tmp_path):
    said = (0.0003, 0.0076, 0.0076)
    assert diagonal(load(sim, tmp_path, inertial(*said))) == pytest.approx(said)
    # of a box of 1 kg: (0.3^2 + 0.04^2) / 12 = 0.00763, 2 * 0.04^2 / 12 = 0.000267
    by_shape = diagonal(load(sim, tmp_path, inertial(1, 1, 1), inertia="shape"))
    assert by_shape == pytest.approx((0.000267, 0.00763, 0.00763), rel=0.01)


@pytest.mark.parametrize(
    ("inertial", "fault"),
    [
        ("", "no <inertial>, so it weighs 1 kg. Write its mass and inertia."),
        (
            inertial(0, 0.01, 0.01),
            "principal moments 0, 0.01, 0.01 kg m^2: not all above 0, as those of a link of 1 kg are. "
            "It has 1e-06, 0.01, 0.01 instead.",
        ),
        (
            inertial(0.001, 0.001, 0.01),
            "principal moments 0.001, 0.001, 0.01 kg m^2: the largest exceeds the sum of the others, "
            "which no solid body has. It has 0.005, 0.005, 0.01 instead.",
        ),
        (
            inertial(1, 1, 1),
            "a moment of 1 kg m^2 is more than 1 kg within 0.31 m can have (0.093). "
            "Correct the file, or load it with inertia='shape'.",
        ),
        (
            inertial("0,3", 0.0076, 0.0076),
            "inertia ixx='0,3' is not a number; PyBullet reads its first digits, or 0.",
        ),
        (inertial(1, 1, 1, mass="${m}"), "mass value='${m}' is not a number; PyBullet reads its first digits, or 0."),
        (inertial(1, 1, 1, mass=""), "mass value='' is not a number; PyBullet reads its first digits, or 0."),
        (inertial(0.0003, 0.0076, 0.0076), None),
        (inertial(0.0003, 0.0076, 0.0076, mass=-1), "a mass of -1 kg."),
    ],
)
def test_faults(sim, tmp_path, inertial, fault):
    found = find_model_faults(load(sim, tmp_path, inertial))
    assert found == ([f"model.urdf, link 'rod': {fault}"] if fault else [])


@pytest.mark.parametrize(
    ("of_joint", "fault"),
    [
        (
            '<limit lower="-3" upper="3"/><origin xyz="0,1 0 0"/>',
            "origin xyz='0,1 0 0' is not a number; PyBullet reads its first digits, or 0.",
        ),
        ('<limit lower="2" upper="-1"/>', "a lower limit of 2 rad, above the upper one of -1: so it has no limits."),
        ('<limit lower="-90" upper="90"/>', "limits of -90 and 90 rad. Are these degrees?"),
        ('<limit lower="-1.57" upper="1.57"/><origin xyz="0, 1, 0" rpy=" 0 0 1.5e-3"/>', None),
    ],
)
def test_joints(sim, tmp_path, of_joint, fault):
    joint = models.joint("joint", "base", "rod").replace(
        '<limit lower="-3" upper="3" effort="50" velocity="5"/>', of_joint
    )
    rod = f'<link name="rod">{inertial(0.0003, 0.0076, 0.0076)}{BOX}</link>'
    body = sim.load("body", models.urdf(tmp_path, models.link("base", 1.0), rod, joint), fixed=True)
    assert find_model_faults(body) == ([f"model.urdf, joint 'joint': {fault}"] if fault else [])


@pytest.mark.parametrize(("encoding", "faults"), [("ISO-8859-1", 1), ("UTF-8", 1), ("none", 0)])
def test_a_file_that_is_not_utf_8(sim, tmp_path, encoding, faults):
    rod = f'<!-- Stoß --><link name="rod">{BOX}</link>'
    file = models.urdf(tmp_path, models.link("base", 1.0), rod, models.joint("joint", "base", "rod"))
    file.write_bytes(f'<?xml version="1.0" encoding="{encoding}"?>\n{file.read_text()}'.encode("latin-1"))
    assert len(find_model_faults(sim.load("body", file, fixed=True))) == faults


def test_equal_faults_are_one(sim, tmp_path):
    rods = [f'<link name="rod {number}">{inertial(1, 1, 1)}{BOX}</link>' for number in range(6)]
    joints = [models.joint(f"joint {number}", "base", f"rod {number}") for number in range(6)]
    body = sim.load("body", models.urdf(tmp_path, models.link("base", 1.0), *rods, *joints), fixed=True)
    (fault,) = find_model_faults(body)
    assert fault.startswith("model.urdf, links 'rod 0', 'rod 1', 'rod 2', 'rod 3' and 2 more: a moment of 1 kg m^2 is")


def test_what_is_not_used_is_no_fault(sim, tmp_path):
    assert find_model_faults(load(sim, tmp_path, inertial(1, 1, 1), inertia="shape")) == []
    assert find_model_faults(sim.load("plane", "plane.urdf", fixed=True)) == []
    assert find_model_faults(sim.load("hopper", "mjcf/hopper.xml")) == []
    assert find_model_faults(sim.add_height_field("ground", np.zeros((3, 3)), cell=0.1)) == []
