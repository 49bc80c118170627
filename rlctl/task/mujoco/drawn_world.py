"""Pictures of a world that was built without its visual shapes: a second model has them."""

from __future__ import annotations

from typing import Any

import numpy as np

from rlctl.task.mujoco.scene import MujocoScene
from rlctl.task.mujoco.world import Array


class DrawnWorld:
    """A world with the bodies of another one, and with visual shapes; `scene` has the files of both."""

    def __init__(self, scene: MujocoScene) -> None:
        self._mujoco = scene.mujoco
        self.model = scene.spec.compile()
        self.data = scene.mujoco.MjData(self.model)
        self._colors = self.model.geom_rgba.copy()

    def follow(self, model: Any, data: Any, colors: Array) -> None:
        """Take the state of the other world; `colors` are those of its bodies, shape (bodies, 3), NaN: unchanged."""
        mine = self.model
        mine.body_pos[:], mine.body_quat[:], self.data.qpos[:] = model.body_pos, model.body_quat, data.qpos
        changed = colors[mine.geom_bodyid]
        mine.geom_rgba[:, :3] = np.where(np.isnan(changed), self._colors[:, :3], changed)
        self._mujoco.mj_fwdPosition(mine, self.data)
