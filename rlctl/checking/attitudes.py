"""What environments compute from the quaternion of a body: angles, axes, vectors seen from it."""

import itertools

import numpy as np

from rlctl.checking.worlds import Array

AXES = "xyz"
NAMES = (
    *("roll", "pitch", "yaw"),
    *("roll of intrinsic angles", "pitch of intrinsic angles", "yaw of intrinsic angles"),
    *(f"the {function} of {angle}" for function in ("sine", "cosine") for angle in ("roll", "pitch", "yaw")),
    "the tilt",
    *(f"{axis}, in the world, of its {of} axis" for axis, of in itertools.product(AXES, AXES)),
)
"""Of the columns of `compute_attitudes`. The last three are the
vertical in the body's frame."""
ANGLES = ((0, 1, 2), (3, 4, 5))
"""Columns with the angles of one convention."""
OF_VECTOR = (
    *(f"{axis} in its frame of" for axis in AXES),
    *(f"{axis} in the world of" for axis in AXES),
    *(f"{axis} by its yaw of" for axis in "xy"),
)
"""Of the columns of `rotate`, to be followed by the vector."""


def find_vector(column: int) -> int:
    """Return a number that the columns of `rotate` have in common which are components of one vector; several blocks of
    such columns may follow each other."""
    block, place = divmod(column, len(OF_VECTOR))
    return 3 * block + place // 3


def compute_matrices(quaternions: Array) -> Array:
    """Return the rotation matrices, shape (n, 3, 3), of quaternions x, y, z, w, shape (n, 4)."""
    x, y, z, w = quaternions.T
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    return np.array(rows).transpose(2, 0, 1)


def compute_attitudes(quaternions: Array) -> Array:
    """Return angles about fixed and about turning axes, their functions, and the elements of the rotation matrix, of
    quaternions x, y, z, w, shape (n, 4). Shape (n, len(NAMES))."""
    m = compute_matrices(quaternions)
    fixed = np.arctan2(m[:, 2, 1], m[:, 2, 2]), np.arcsin(_clip(-m[:, 2, 0])), np.arctan2(m[:, 1, 0], m[:, 0, 0])
    turning = np.arctan2(-m[:, 1, 2], m[:, 2, 2]), np.arcsin(_clip(m[:, 0, 2])), np.arctan2(-m[:, 0, 1], m[:, 0, 0])
    functions = [function(angle) for function in (np.sin, np.cos) for angle in fixed]
    return np.column_stack([*fixed, *turning, *functions, np.arccos(_clip(m[:, 2, 2])), m.reshape(-1, 9)])


def _clip(values: Array) -> Array:
    return np.clip(values, -1.0, 1.0)


def rotate(quaternions: Array, vectors: Array) -> Array:
    """Return vectors of the world, shape (n, 3), in the frame of a body; vectors of the body's frame in the world; and
    the level part of vectors of the world, turned back by the body's yaw. Shape (n, 8)."""
    matrices = compute_matrices(quaternions)
    yaw = np.arctan2(matrices[:, 1, 0], matrices[:, 0, 0])
    cosine, sine, (x, y, _) = np.cos(yaw), np.sin(yaw), vectors.T
    level = np.column_stack([cosine * x + sine * y, cosine * y - sine * x])
    inside, outside = (np.einsum(form, matrices, vectors) for form in ("nij,ni->nj", "nij,nj->ni"))
    return np.hstack([inside, outside, level])
