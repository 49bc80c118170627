"""Pictures of a world that was built without its visual shapes: a second model has them."""

from __future__ import annotations

import numpy as np

from rlctl.task.mujoco.scene import MujocoScene
from rlctl.task.mujoco.world import MujocoWorld


class DrawnWorld:
    """A world with the bodies of another one, and with visual shapes; `scene` has the files of both."""

    def __init__(self, scene: MujocoScene) -> None:
        self._mujoco = scene.mujoco
        self.model = scene.spec.compile()
        self.data = scene.mujoco.MjData(self.model)
        self._colors = self.model.geom_rgba.copy()

    def follow(self, world: MujocoWorld, row: int) -> None:
        """Take the state of another world, of a batch that of one row, and the colours of its bodies."""
        mine, data = self.model, self.data
        mine.body_pos[:], mine.body_quat[:] = world.model_row("body_pos", row), world.model_row("body_quat", row)
        data.qpos[:] = world.data_row("qpos", row)
        changed = world.model_row("color", row)[mine.geom_bodyid]  # NaN: unchanged
        mine.geom_rgba[:, :3] = np.where(np.isnan(changed), self._colors[:, :3], changed)
        for compute in (self._mujoco.mj_kinematics, self._mujoco.mj_comPos, self._mujoco.mj_camlight):
            compute(mine, data)
        if mine.ntendon:
            self._mujoco.mj_tendon(mine, data)
