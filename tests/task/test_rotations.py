"""Rotations as quaternions: as SciPy's."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rlctl.task import rotations


@pytest.fixture
def quaternions():
    return Rotation.random(8, rng=np.random.default_rng(0)).as_quat().reshape(2, 4, 4)


def test_they_are_those_of_scipy(quaternions):
    first, second = quaternions
    vectors = np.random.default_rng(1).normal(size=(4, 3))
    turns, others = Rotation.from_quat(first), Rotation.from_quat(second)
    np.testing.assert_allclose(rotations.rotate(first, vectors), turns.apply(vectors), atol=1e-12)
    np.testing.assert_allclose(rotations.rotate(first, vectors[0]), turns.apply(vectors[0]), atol=1e-12)
    product = Rotation.from_quat(rotations.multiply(first, second))
    assert (product * (turns * others).inv()).magnitude().max() < 1e-7
    assert (Rotation.from_quat(rotations.invert(first)) * turns).magnitude().max() < 1e-7
    np.testing.assert_allclose(rotations.normalize(3.0 * first), first, atol=1e-12)


def test_a_rotation_about_an_axis():
    quarter = rotations.from_axis((0.0, 0.0, 2.0), np.pi / 2)
    np.testing.assert_allclose(rotations.rotate(quarter, (1.0, 0.0, 0.0)), (0.0, 1.0, 0.0), atol=1e-12)
    assert rotations.from_axis((1.0, 0.0, 0.0), np.zeros(5)).tolist() == [[0.0, 0.0, 0.0, 1.0]] * 5


def test_angles_are_those_of_pybullet():
    pybullet = pytest.importorskip("pybullet")
    for quaternion in rotations.normalize(np.random.default_rng(0).normal(size=(50, 4))).tolist():
        assert rotations.roll_pitch_yaw(quaternion) == pybullet.getEulerFromQuaternion(quaternion)


def test_gravity_in_the_frame_of_a_robot_that_pitches():
    down = rotations.rotate_inverse(rotations.from_axis((0, 1, 0), [np.pi / 6]), (0, 0, -1))
    # Nose down by 30 degrees: gravity points forward by sin 30 degrees.
    np.testing.assert_allclose(down, [[0.5, 0.0, -np.sqrt(0.75)]], atol=1e-12)
