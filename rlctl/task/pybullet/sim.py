"""A PyBullet world: bodies by name, SI units, numpy arrays.

Quaternions are (x, y, z, w), as in PyBullet. The state of a body is read at most once per control step.
"""

import dataclasses
import functools
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from rlctl.errors import TaskError
from rlctl.task.body import Array
from rlctl.task.model_files import find_model_file
from rlctl.task.pybullet.body import PybulletBody
from rlctl.task.pybullet.constraints import Constraints
from rlctl.task.pybullet.library import check_display, draw_world, pybullet, pybullet_data, read_complaint
from rlctl.task.pybullet.temporary_files import write_temporary
from rlctl.task.urdf import Urdf, read_urdf


@dataclasses.dataclass
class _Push:
    body: PybulletBody
    link: int
    force: Sequence[float]  # [N], world frame
    steps: int  # control steps that it still acts


class PybulletSim(Constraints):
    """A PyBullet world of its own.

    One call of PyBullet simulates `control_dt` [s] in `substeps` physics steps, so that a force acts in all of them.
    """

    engine = "PyBullet"
    bodies: dict[str, PybulletBody]

    def __init__(self, *, control_dt: float, substeps: int, solver_iterations: int = 50, gui: bool = False) -> None:
        if gui:
            check_display()
        self.client: int = pybullet.connect(pybullet.GUI if gui else pybullet.DIRECT)
        if self.client < 0:
            raise TaskError("PyBullet could not open a window; leave out --gui on a machine without a display")
        self.bodies, self.cameras = {}, {}
        self._times = control_dt, substeps
        self._settings = {
            "fixedTimeStep": control_dt,
            "numSubSteps": substeps,
            "numSolverIterations": solver_iterations,
            # Without it, contacts after a restored state come in another order: see tests/task/test_reset.py.
            "deterministicOverlappingPairs": 1,
        }
        self._saved: int | None = None
        self._built_gravity: tuple[float, ...] | None = None  # [m/s^2], set while events have changed the gravity
        self._pushes: list[_Push] = []
        self._driven: list[PybulletBody] = []
        self._prepare()

    def _prepare(self) -> None:
        pybullet.setAdditionalSearchPath(pybullet_data.getDataPath(), physicsClientId=self.client)
        pybullet.setPhysicsEngineParameter(**self._settings, physicsClientId=self.client)
        self.set_gravity(9.81)

    def set_gravity(self, gravity: float) -> None:
        pybullet.setGravity(0.0, 0.0, -gravity, physicsClientId=self.client)

    def set_contact_erp(self, erp: float) -> None:
        pybullet.setDefaultContactERP(erp, physicsClientId=self.client)

    def load(
        self,
        name: str,
        file: str | Path,
        *,
        position: Sequence[float] = (0.0, 0.0, 0.0),
        orientation: Sequence[float] = (0.0, 0.0, 0.0, 1.0),
        fixed: bool = False,
        flags: int = 0,
        self_collision: bool = False,
        inertia: Literal["file", "shape"] = "file",
        floor: bool = True,
    ) -> PybulletBody:
        self._check_new(name)
        if not floor:
            self._refuse("load(floor=False)")
        path = find_model_file(file)
        wheels: dict[str, float] = {}
        if path.suffix == ".urdf":
            flags |= pybullet.URDF_USE_INERTIA_FROM_FILE if inertia == "file" else 0
        if self_collision:
            flags |= pybullet.URDF_USE_SELF_COLLISION | pybullet.URDF_USE_SELF_COLLISION_EXCLUDE_ALL_PARENTS
        if path.suffix in (".xml", ".sdf"):
            if fixed or any(position) or tuple(orientation) != (0, 0, 0, 1):
                raise TaskError(
                    f"{path.name} contains the pose of its body: position, orientation and fixed are for URDF"
                )
            load = functools.partial(pybullet.loadMJCF, flags=flags) if path.suffix == ".xml" else pybullet.loadSDF
            ids = self._call_loader(path, load)
            if len(ids) != 1:
                raise TaskError(f"{path} contains {len(ids)} bodies; split it into files of one body each")
            body_id = int(ids[0])
            fixed = pybullet.getDynamicsInfo(body_id, -1, physicsClientId=self.client)[0] == 0  # a base without mass
        else:
            inertia_from_file = bool(flags & pybullet.URDF_USE_INERTIA_FROM_FILE)
            urdf = read_urdf(path, fixed=fixed, inertia_from_file=inertia_from_file)
            wheels = urdf.wheels
            if wheels:
                flags |= pybullet.URDF_USE_IMPLICIT_CYLINDER  # by default a cylinder is a prism of 32 sides
            body_id = self._load_urdf(urdf, position, orientation, fixed, flags)
        body = self.bodies[name] = PybulletBody(self.client, *self._times, name, body_id, path, fixed)
        body.inertia_from_file = bool(flags & pybullet.URDF_USE_INERTIA_FROM_FILE)
        if wheels:
            body.let_roll(wheels)
        speeds = body.joint_max_speed
        if path.suffix == ".urdf" and fixed and speeds.size and (speeds > 0).all():
            body.cap_joint_speed(float(speeds.max()))
        return body

    def _load_urdf(
        self, urdf: Urdf, position: Sequence[float], orientation: Sequence[float], fixed: bool, flags: int
    ) -> Any:
        path = urdf.path
        options: dict[str, Any] = {"useFixedBase": fixed, "flags": flags}
        if not urdf.changed:
            return self._call_loader(path, pybullet.loadURDF, position, orientation, **options)
        urdf.check_meshes()
        with write_temporary(urdf.text, path.name) as copy:
            return self._call_loader(path, pybullet.loadURDF, position, orientation, read_from=copy, **options)

    def _call_loader(
        self, path: Path, load: Callable[..., Any], *args: Any, read_from: Path | None = None, **kwargs: Any
    ) -> Any:
        file = str(read_from or path)
        call = functools.partial(load, file, *args, **kwargs, physicsClientId=self.client)
        try:
            return call()
        except pybullet.error as error:
            complaint = read_complaint(call).replace(file, str(path))
            raise TaskError(f"PyBullet cannot load {path}: {complaint or error}") from None

    def step(self) -> None:
        # With springs and dampers the physics steps are taken one by one: they need the state before each.
        for _ in range(self._times[1] if self._driven else 1):
            if self._pushes:
                self._apply_pushes()
            for body in self._driven:
                body.apply_drives()
            for body in self.bodies.values():
                body.apply_locks()
            pybullet.stepSimulation(physicsClientId=self.client)
        for body in self.bodies.values():
            body._cache.clear()
        if self._pushes:
            for push in self._pushes:
                push.steps -= 1
            self._pushes = [push for push in self._pushes if push.steps]

    @property
    def deepest_contact(self) -> float:
        points = pybullet.getContactPoints(physicsClientId=self.client)
        return max((-float(point[8]) for point in points if point[8] < 0.0), default=0.0)

    def save(self) -> None:
        self._driven = [body for body in self.bodies.values() if body.drives is not None]
        if self._driven:
            single = self._times[0] / self._times[1]
            pybullet.setPhysicsEngineParameter(fixedTimeStep=single, numSubSteps=0, physicsClientId=self.client)
            for body in self.bodies.values():
                body._substeps = 1  # of a call of stepSimulation
        self._saved = pybullet.saveState(physicsClientId=self.client)
        self._built_gravity = None
        for body in self.bodies.values():
            body._save_nominal()

    def restore(self) -> None:
        self._pushes.clear()
        if self._built_gravity is not None:
            pybullet.setGravity(*self._built_gravity, physicsClientId=self.client)
            self._built_gravity = None
        pybullet.restoreState(self._saved, physicsClientId=self.client)
        # Without it, contacts of the last episode would act in the first step.
        pybullet.performCollisionDetection(physicsClientId=self.client)
        for body in self.bodies.values():
            body._cache.clear()
            body._restore_nominal()

    def body(self, name: str) -> PybulletBody:
        super().body(name)  # raises for an unknown one
        return self.bodies[name]

    def shift_gravity(self, change: float) -> None:
        if self._built_gravity is None:
            engine = pybullet.getPhysicsEngineParameters(physicsClientId=self.client)
            self._built_gravity = tuple(engine[f"gravityAcceleration{axis}"] for axis in "XYZ")
        x, y, z = self._built_gravity
        pybullet.setGravity(x, y, z + change, physicsClientId=self.client)

    def push(self, body: str, force: Sequence[float], duration_s: float, link: str | None = None) -> None:
        pushed = self.body(body)
        index = -1 if link is None else pushed._part_index(link)
        self._pushes.append(_Push(pushed, index, force, max(1, round(duration_s / self._settings["fixedTimeStep"]))))

    def _apply_pushes(self) -> None:
        # PyBullet drops a force after a step, but not in restoreState: forces are applied directly before the step.
        for push in self._pushes:
            centre = push.body._mass_centre(push.link)
            pybullet.applyExternalForce(
                push.body.id, push.link, push.force, centre, pybullet.WORLD_FRAME, physicsClientId=self.client
            )

    def clear(self) -> None:
        pybullet.resetSimulation(physicsClientId=self.client)
        self.bodies.clear()
        self._pushes.clear()
        self._saved = self._built_gravity = None
        self._prepare()

    def add_height_field(
        self, name: str, heights: Array, *, cell: float, color: Sequence[float] = (0.55, 0.6, 0.5)
    ) -> PybulletBody:
        self._check_new(name)
        rows, columns = heights.shape
        shape = pybullet.createCollisionShape(
            pybullet.GEOM_HEIGHTFIELD,
            meshScale=(cell, cell, 1.0),
            heightfieldTextureScaling=rows / 2,
            heightfieldData=heights.T.ravel().tolist(),  # x goes fastest
            numHeightfieldRows=rows,
            numHeightfieldColumns=columns,
            physicsClientId=self.client,
        )
        # Bullet puts the middle between the lowest and the highest point at the origin.
        middle = (0.0, 0.0, float(heights.min() + heights.max()) / 2)
        body_id = pybullet.createMultiBody(0, shape, basePosition=middle, physicsClientId=self.client)
        pybullet.changeVisualShape(body_id, -1, rgbaColor=(*color, 1), physicsClientId=self.client)
        body = PybulletBody(self.client, *self._times, name, body_id, Path("height field"), True)
        x, y = ((np.arange(count) - (count - 1) / 2) * cell for count in heights.shape)
        body.terrain = np.stack([*np.meshgrid(x, y, indexing="ij"), heights], axis=-1)
        self.bodies[name] = body
        return body

    def add_marker(self, position: Sequence[float], radius: float, color: Sequence[float]) -> int:
        sphere, client = pybullet.GEOM_SPHERE, self.client
        shape = pybullet.createVisualShape(sphere, radius=radius, rgbaColor=color, physicsClientId=client)
        return int(pybullet.createMultiBody(baseVisualShapeIndex=shape, basePosition=position, physicsClientId=client))

    def move_marker(self, marker: int, position: Sequence[float] | Array) -> None:
        pybullet.resetBasePositionAndOrientation(marker, position, (0, 0, 0, 1), physicsClientId=self.client)

    def render(
        self,
        width: int = 320,
        height: int = 240,
        *,
        eye: Sequence[float] = (1.5, 1.1, 1.1),
        target: Sequence[float] = (0.2, 0.0, 0.4),
        up: Sequence[float] = (0.0, 0.0, 1.0),
        field_of_view: float = 45.0,
    ) -> NDArray[np.uint8]:
        """Draw the world on the CPU and return an RGB image of shape (height, width, 3).

        The camera is at `eye` [m] and looks at `target` [m], with a vertical `field_of_view` [degrees]. It takes 20 to
        40 ms at 320x240.
        """
        return draw_world(self.client, width, height, eye=eye, target=target, up=up, field_of_view=field_of_view)

    def close(self) -> None:
        if self.client >= 0 and pybullet.isConnected(physicsClientId=self.client):
            pybullet.disconnect(physicsClientId=self.client)
        self.client = -1
