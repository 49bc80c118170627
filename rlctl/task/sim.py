"""One PyBullet client: bodies by name, SI units, numpy out.

Quaternions are (x, y, z, w), as PyBullet has them. Every call passes the client id, and the state of a body is
read at most once per control step.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlctl.errors import TaskError, did_you_mean
from rlctl.task.bullet import pybullet, pybullet_data

Array = NDArray[np.float64]


class Body:
    """A body of the world. Joint arrays have one element per movable joint, in `joint_names` order."""

    def __init__(self, sim: Sim, name: str, body_id: int, file: Path, fixed: bool) -> None:
        self.sim = sim
        self.name = name
        self.id = body_id
        self.file = file
        self.fixed = fixed
        self._client = sim.client
        self._cache: dict[Any, Any] = {}
        self._changed = False
        infos = [
            pybullet.getJointInfo(body_id, index, physicsClientId=sim.client)
            for index in range(pybullet.getNumJoints(body_id, physicsClientId=sim.client))
        ]
        self.all_joint_names = [info[1].decode() for info in infos]
        self._links = {info[12].decode(): index for index, info in enumerate(infos)}
        movable = [info for info in infos if info[2] in (pybullet.JOINT_REVOLUTE, pybullet.JOINT_PRISMATIC)]
        self.joint_names = [info[1].decode() for info in movable]
        self.joint_indices = [int(info[0]) for info in movable]
        self.joint_low: Array = np.array([info[8] for info in movable])
        """Lower joint limits [rad or m], shape (joints,)."""
        self.joint_high: Array = np.array([info[9] for info in movable])
        self.joint_max_force: Array = np.array([info[10] for info in movable])
        """Torque or force limit in the model file [N m or N], shape (joints,)."""

    @property
    def link_names(self) -> list[str]:
        return list(self._links)

    def _link_index(self, link: str) -> int:
        if link not in self._links:
            raise TaskError(
                f"{self.file.name} has no link {link!r}.{did_you_mean(link, self._links)} "
                f"It has: {', '.join(self._links)}."
            )
        return self._links[link]

    def _joint_states(self) -> tuple[Array, Array]:
        state = self._cache.get("joints")
        if state is None:
            # None where a body has no joints.
            raw = pybullet.getJointStates(self.id, self.joint_indices, physicsClientId=self._client) or ()
            state = (np.array([joint[0] for joint in raw]), np.array([joint[1] for joint in raw]))
            self._cache["joints"] = state
        return state

    @property
    def joint_positions(self) -> Array:
        """Joint angles [rad] or displacements [m], shape (joints,)."""
        return self._joint_states()[0]

    @property
    def joint_velocities(self) -> Array:
        """Joint velocities [rad/s] or [m/s], shape (joints,)."""
        return self._joint_states()[1]

    def _link_state(self, link: str) -> tuple[Array, Array]:
        state = self._cache.get(("link", link))  # a link may be called "base" or "joints"
        if state is None:
            raw = pybullet.getLinkState(
                self.id, self._link_index(link), computeForwardKinematics=1, physicsClientId=self._client
            )
            # Items 4 and 5 are the link frame; 0 and 1 are the centre of mass.
            state = (np.array(raw[4]), np.array(raw[5]))
            self._cache["link", link] = state
        return state

    def link_position(self, link: str) -> Array:
        """Position of the link frame [m], world frame, shape (3,)."""
        return self._link_state(link)[0]

    def link_orientation(self, link: str) -> Array:
        """Orientation of the link frame, quaternion (x, y, z, w), world frame, shape (4,)."""
        return self._link_state(link)[1]

    def _base_state(self) -> tuple[Array, Array]:
        state = self._cache.get("base")
        if state is None:
            position, orientation = pybullet.getBasePositionAndOrientation(self.id, physicsClientId=self._client)
            state = (np.array(position), np.array(orientation))
            self._cache["base"] = state
        return state

    @property
    def base_position(self) -> Array:
        """Position of the base's centre of mass [m], world frame, shape (3,)."""
        return self._base_state()[0]

    @property
    def base_orientation(self) -> Array:
        """Orientation of the base's inertial frame, quaternion (x, y, z, w), shape (4,)."""
        return self._base_state()[1]

    def set_base(self, position: Sequence[float], orientation: Sequence[float] = (0, 0, 0, 1)) -> None:
        """Place the base at rest."""
        pybullet.resetBasePositionAndOrientation(self.id, position, orientation, physicsClientId=self._client)
        self._cache.clear()

    def set_joints(self, positions: Array, velocities: Array | None = None) -> None:
        """Place the joints: `positions` and `velocities` of shape (joints,), at rest without the latter."""
        pybullet.resetJointStatesMultiDof(
            self.id,
            self.joint_indices,
            positions[:, None].tolist(),
            (np.zeros_like(positions) if velocities is None else velocities)[:, None].tolist(),
            physicsClientId=self._client,
        )
        self._cache.clear()

    def drive_to(
        self, positions: Array, *, max_speed: Sequence[float], max_force: Sequence[float], gain: float = 0.1
    ) -> None:
        """Set position targets [rad or m] of every joint; speed [rad/s or m/s] and force are limited.

        `gain` is the part of the position error that a physics step takes away, in (0, 1].
        """
        # The array call of PyBullet has no speed limit, hence a call per joint.
        for index, target, speed, force in zip(
            self.joint_indices, positions.tolist(), max_speed, max_force, strict=True
        ):
            pybullet.setJointMotorControl2(
                self.id,
                index,
                pybullet.POSITION_CONTROL,
                targetPosition=target,
                force=force,
                maxVelocity=speed,
                positionGain=gain,
                physicsClientId=self._client,
            )

    @cached_property
    def _nominal(self) -> list[tuple[int, float, float, tuple[float, float, float]]]:
        links = range(-1, len(self._links))
        infos = [pybullet.getDynamicsInfo(self.id, link, physicsClientId=self._client) for link in links]
        return [(link, info[0], info[1], info[2]) for link, info in zip(links, infos, strict=True)]

    def _save_nominal(self) -> None:
        self._changed = False
        self.__dict__.pop("_nominal", None)  # read again when needed: `build` may have set other values

    def _restore_nominal(self) -> None:
        # PyBullet's saved states have positions and velocities, but neither masses nor friction.
        if not self._changed:
            return
        self._changed = False
        for link, mass, friction, inertia in self._nominal:
            pybullet.changeDynamics(
                self.id,
                link,
                mass=mass,
                lateralFriction=friction,
                localInertiaDiagonal=inertia,
                physicsClientId=self._client,
            )

    def scale_mass(self, factor: float) -> None:
        """Set mass and inertia of every link to `factor` times the built world's value, until the next reset."""
        nominal = self._nominal
        self._changed = True
        for link, mass, _, inertia in nominal:
            pybullet.changeDynamics(
                self.id,
                link,
                mass=mass * factor,
                localInertiaDiagonal=[element * factor for element in inertia],
                physicsClientId=self._client,
            )

    def set_friction(self, friction: float) -> None:
        """Set the lateral friction of every link, until the next reset."""
        nominal = self._nominal
        self._changed = True
        for link, *_ in nominal:
            pybullet.changeDynamics(self.id, link, lateralFriction=friction, physicsClientId=self._client)


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
        self.bodies[name] = Body(self, name, body_id, path, fixed)
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
