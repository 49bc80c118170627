"""One PyBullet client: bodies by name, SI units, numpy out.

Quaternions are (x, y, z, w), as PyBullet has them. Every call passes the client id, and the state of a body is
read at most once per control step.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rlctl.errors import TaskError, did_you_mean
from rlctl.task.body import Array, Body
from rlctl.task.bullet import pybullet, pybullet_data


class Sim:
    """A PyBullet world of its own.

    `control_dt` [s] is simulated by one call with `substeps` physics steps: forces then act on every one of them.
    """

    def __init__(self, *, control_dt: float, substeps: int, solver_iterations: int = 50, gui: bool = False) -> None:
        self.client: int = pybullet.connect(pybullet.GUI if gui else pybullet.DIRECT)
        if self.client < 0:
            raise TaskError("PyBullet could not open a window: is there a display? Leave out --gui to do without.")
        self.bodies: dict[str, Body] = {}
        self._settings = {
            "fixedTimeStep": control_dt,
            "numSubSteps": substeps,
            "numSolverIterations": solver_iterations,
            # Without it, contacts after a restored state come in another order: see tests/task/test_reset.py.
            "deterministicOverlappingPairs": 1,
        }
        self._saved: int | None = None
        self._prepare()

    def _prepare(self) -> None:
        pybullet.setAdditionalSearchPath(pybullet_data.getDataPath(), physicsClientId=self.client)
        pybullet.setPhysicsEngineParameter(**self._settings, physicsClientId=self.client)
        pybullet.setGravity(0.0, 0.0, -9.81, physicsClientId=self.client)

    def load(
        self,
        name: str,
        file: str | Path,
        *,
        position: Sequence[float] = (0.0, 0.0, 0.0),
        orientation: Sequence[float] = (0.0, 0.0, 0.0, 1.0),
        fixed: bool = False,
        flags: int = 0,
    ) -> Body:
        """Load a URDF file: a path, or a name in `pybullet_data`. `flags` are PyBullet's URDF_* flags."""
        path = Path(file)
        if not path.is_absolute() and not path.exists():
            path = Path(pybullet_data.getDataPath()) / file
        if not path.exists():
            raise TaskError(f"model file {str(file)!r} not found: neither under {Path.cwd()} nor in pybullet_data")
        try:
            body_id = pybullet.loadURDF(
                str(path), position, orientation, useFixedBase=fixed, flags=flags, physicsClientId=self.client
            )
        except pybullet.error as error:
            raise TaskError(f"PyBullet cannot load {path}: {error}") from None
        self.bodies[name] = Body(self.client, int(self._settings["numSubSteps"]), name, body_id, path, fixed)
        return self.bodies[name]

    def body(self, name: str) -> Body:
        """Return a loaded body by its name."""
        if name not in self.bodies:
            raise TaskError(
                f"no body {name!r}.{did_you_mean(name, self.bodies)} Loaded: {', '.join(self.bodies) or 'none'}."
            )
        return self.bodies[name]

    def step(self) -> None:
        """Simulate `control_dt` seconds."""
        pybullet.stepSimulation(physicsClientId=self.client)
        for body in self.bodies.values():
            body._cache.clear()

    def save(self) -> None:
        """Remember the world as it is now, for `restore`."""
        self._saved = pybullet.saveState(physicsClientId=self.client)
        for body in self.bodies.values():
            body._save_nominal()

    def restore(self) -> None:
        """Put the world back as `save` found it."""
        pybullet.restoreState(self._saved, physicsClientId=self.client)
        for body in self.bodies.values():
            body._cache.clear()
            body._restore_nominal()

    def clear(self) -> None:
        """Empty the world, as if it had just been made."""
        pybullet.resetSimulation(physicsClientId=self.client)
        self.bodies.clear()
        self._saved = None
        self._prepare()

    def add_marker(self, position: Sequence[float], radius: float, color: Sequence[float]) -> int:
        """Add a sphere that is seen but touches nothing; returns its id, for `move_marker`."""
        shape = pybullet.createVisualShape(
            pybullet.GEOM_SPHERE, radius=radius, rgbaColor=color, physicsClientId=self.client
        )
        marker: int = pybullet.createMultiBody(
            baseVisualShapeIndex=shape, basePosition=position, physicsClientId=self.client
        )
        return marker

    def move_marker(self, marker: int, position: Sequence[float] | Array) -> None:
        """Move a marker to a world position [m]."""
        pybullet.resetBasePositionAndOrientation(marker, position, (0, 0, 0, 1), physicsClientId=self.client)

    def render(self, width: int = 320, height: int = 240) -> NDArray[np.uint8]:
        """Draw the world on the CPU: an RGB image of shape (height, width, 3). Takes 20-40 ms."""
        view = pybullet.computeViewMatrix((1.5, 1.1, 1.1), (0.2, 0.0, 0.4), (0, 0, 1))
        projection = pybullet.computeProjectionMatrixFOV(45.0, width / height, 0.05, 10.0)
        image = pybullet.getCameraImage(
            width,
            height,
            view,
            projection,
            shadow=0,
            renderer=pybullet.ER_TINY_RENDERER,
            physicsClientId=self.client,
        )
        # Without numpy support PyBullet gives a flat tuple.
        return np.asarray(image[2], dtype=np.uint8).reshape(height, width, 4)[:, :, :3]

    def close(self) -> None:
        """End the client; a second call does nothing."""
        if self.client >= 0 and pybullet.isConnected(physicsClientId=self.client):
            pybullet.disconnect(physicsClientId=self.client)
        self.client = -1
