"""Worlds of `pick` and `place`, played by a script that moves the hands to points."""

import numpy as np

from rlctl.environments.spec import EnvSpec
from rlctl.task.rotations import rotate

WORLDS = 4
OPEN, CLOSED = 1.0, -1.0


def above(points, height):
    """Return points [m], shape (WORLDS, 3), moved up by `height` [m]."""
    return points + np.array([0.0, 0.0, height])


class Script:
    """Worlds of a task, whose arms are moved to points by inverse kinematics, with the hand down."""

    def __init__(self, task):
        self.worlds = EnvSpec(task, {"start_noise": 0.0}).make_worlds(WORLDS)
        self.worlds.reset(np.arange(WORLDS), list(range(WORLDS)))
        self.task = self.worlds.calls.task

    def find_joints(self, points):
        """Return joint positions of shape (WORLDS, 7) at which the grasp frame is at `points` [m]."""
        arm = self.task.arm
        before, velocities = arm.joint_positions, arm.joint_velocities

        def miss(joints):
            arm.set_joints(np.column_stack([joints, before[:, 7:]]))
            down = rotate(arm.link_orientation("grasp"), (0.0, 0.0, 1.0)) - (0.0, 0.0, -1.0)
            return np.column_stack([arm.link_position("grasp") - points, 0.3 * down])

        joints = before[:, :7]
        for _ in range(12):
            missed = miss(joints)
            slopes = np.stack([(miss(joints + 1e-5 * step) - missed) / 1e-5 for step in np.eye(7)], axis=-1)
            turned = slopes.swapaxes(-1, -2)
            step = turned @ np.linalg.solve(slopes @ turned + 1e-4 * np.eye(6), missed[..., None])
            joints = joints - step[..., 0]
        arm.set_joints(before, velocities)
        return joints

    def go(self, points, fingers, steps):
        """Move to `points` in `steps` control steps; return the last step."""
        joints = self.find_joints(points)
        for _ in range(steps):
            action = np.clip((joints - self.task.target[:, :7]) / 0.05, -1.0, 1.0)
            result = self.worlds.step(np.column_stack([action, np.full(WORLDS, fingers)]).astype(np.float32))
        return result

    def grasp(self):
        """Close the fingers about the block."""
        block = self.task.block.base_position
        self.go(above(block, 0.1), OPEN, 20)
        self.go(block, OPEN, 12)
        return self.go(block, CLOSED, 15)
