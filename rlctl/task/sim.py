"""`Sim`: the world of a task, the same in every physics engine."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import ClassVar, Literal, NoReturn

import numpy as np
from numpy.typing import NDArray

from rlctl.errors import TaskError, UsageError, check_name
from rlctl.task.attachments import Attachment, Joined
from rlctl.task.body import Array, Body
from rlctl.task.camera import Camera, Distractor, Pictures, locate


class Sim:
    """A world of its own: bodies by name, SI units, NumPy arrays, quaternions (x, y, z, w).

    Each engine has a subclass; a method that an engine cannot offer raises `UsageError`. Constraints (`connect_*`) are
    made in `build` and last as long as the world. Their `max_force` is the largest force [N], for gears the largest
    torque [N m]; a stronger load pulls the frames apart.
    """

    engine: ClassVar[str]
    """Name of the physics engine, for people."""
    bodies: Mapping[str, Body]
    cameras: Mapping[str, Camera]
    """The cameras that the task declares, by name."""

    def _refuse(self, what: str) -> NoReturn:
        raise UsageError(f"{what}: not in {self.engine}; use the other engine: --sim")

    def set_gravity(self, gravity: float) -> None:
        """Set the downward gravity of the built world [m/s^2], by default 9.81. Call it in `build`."""
        self._refuse("set_gravity")

    def set_contact_erp(self, erp: float) -> None:
        """Set the fraction of a contact's depth that one physics step removes, in (0, 1]: Bullet's contact ERP.

        The default is 0.2. Call it in `build`: resets keep the value.
        """
        self._refuse("set_contact_erp")

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
    ) -> Body:
        """Load the body of a URDF, MJCF (`.xml`) or SDF file: a path, or a name as of `find_model_file`.

        `position` [m] and `orientation` of the base's origin, and `fixed`, are for URDF files; other formats contain
        them. Meshes of a URDF are found as `rlctl.task.mesh_paths` says; frames and impossible inertias are changed
        as `rlctl.task.urdf` says, the same in each engine. `flags` are PyBullet's URDF_* flags. With `self_collision`
        links collide, except with their ancestors. Without `floor` the shapes of the world that an MJCF file has,
        such as a floor, are left out, which only MuJoCo can. `inertia="shape"` is for a URDF whose inertias are wrong
        (see `rlctl.task.model_faults`): the engine computes them from the collision shapes and the file's masses.
        Raises `TaskError` for a file that is missing, or that the engine refuses.
        """
        self._refuse("load")

    def add_height_field(
        self, name: str, heights: Array, *, cell: float, color: Sequence[float] = (0.55, 0.6, 0.5)
    ) -> Body:
        """Add rough ground, centred at 0, 0: `heights` [m] above z = 0, such as `rough_heights`, `cell` [m] apart."""
        self._refuse("add_height_field")

    def connect_gear(
        self, body: Body, driver: str, driven: str, *, ratio: float, max_force: float = 1e4, stiffness: float = 0.1
    ) -> None:
        """Gear two joints of a body: the position of `driven` is `ratio` times that of `driver`.

        `stiffness` is the fraction of the position error that one physics step removes, in (0, 1].
        """
        self._refuse("connect_gear")

    def connect_point(self, first: Attachment, second: Attachment, *, max_force: float = 1e4) -> Joined:
        """Join a point of a link to a point of another; both links can rotate. A URDF cannot describe such a loop."""
        self._refuse("connect_point")

    def connect_fixed(self, first: Attachment, second: Attachment, *, max_force: float = 1e4) -> Joined:
        """Join a frame of a link to a frame of another: both links move as one."""
        self._refuse("connect_fixed")

    def body(self, name: str) -> Body:
        """Return a loaded body by its name."""
        check_name(name, self.bodies, "no body", TaskError, listed="Loaded")
        return self.bodies[name]

    def _check_new(self, name: str) -> None:
        if name in self.bodies:
            raise TaskError(f"a body {name!r} is already loaded; give each body its own name")

    def step(self) -> None:
        """Simulate `control_dt` seconds."""
        raise NotImplementedError

    @property
    def deepest_contact(self) -> float:
        """The largest overlap of two bodies [m] at the end of the last step; 0 if none overlap."""
        raise NotImplementedError

    def save(self) -> None:
        """Save the current world for `restore`."""
        raise NotImplementedError

    def restore(self) -> None:
        """Restore the saved world."""
        raise NotImplementedError

    def clear(self) -> None:
        """Remove everything from the world."""
        raise NotImplementedError

    def shift_gravity(self, change: float) -> None:
        """Set the vertical gravity to the built world's value plus `change` [m/s^2], until the next reset."""
        self._refuse("shift_gravity")

    def push(self, body: str, force: Sequence[float], duration_s: float, link: str | None = None) -> None:
        """Push a link, or the base, at its centre of mass with `force` [N, world frame] for `duration_s` [s].

        The duration is rounded to control steps, at least one. The push begins with the next step; a reset ends it.
        """
        self._refuse("push")

    def add_marker(self, position: Sequence[float], radius: float, color: Sequence[float]) -> int:
        """Add a visible sphere without collisions; return its id, for `move_marker`."""
        self._refuse("add_marker")

    def move_marker(self, marker: int, position: Sequence[float] | Array) -> None:
        """Move a marker to a world position [m]."""
        self._refuse("move_marker")

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
        """Draw the world without a display and return an RGB image of shape (height, width, 3).

        The camera is at `eye` [m] and looks at `target` [m], with a vertical `field_of_view` [degrees].
        """
        self._refuse("render")

    def take_pictures(self, camera: str, worlds: NDArray[np.int64] | None = None) -> Pictures:
        """Return what a camera of the task sees in some worlds, by default all, shape (k, height, width, 3).

        Markers are not in the pictures of MuJoCo. Events may have changed colours, light and the camera's pose.
        """
        chosen = self.find_camera(camera)
        (width, height), (eye, axes) = chosen.size, locate(chosen, self.bodies)
        view = {"eye": eye.tolist(), "target": (eye + axes[2]).tolist(), "up": axes[1].tolist()}
        return self.render(width, height, field_of_view=chosen.field_of_view, **view)[None]

    def find_camera(self, name: str) -> Camera:
        """Return a camera of the task; raises `TaskError` for a name that it does not declare."""
        check_name(name, self.cameras, "no camera", TaskError, listed="Declared")
        return self.cameras[name]

    def set_light(self, brightness: float, direction: Sequence[float]) -> None:
        """Light the cameras' pictures from a direction, `brightness` times as bright as usual, until the next reset."""
        self._refuse("set_light")

    def move_camera(self, camera: str, shift: Sequence[float], turn: Sequence[float]) -> None:
        """Move a camera from its declared pose until the next reset: along its axes right, up and forward by `shift`
        [m], and about them by `turn` [rad]."""
        self._refuse("move_camera")

    def set_distractors(self, distractors: Sequence[Distractor]) -> None:
        """Show so many things, at most 8, in the cameras' pictures until the next reset; nothing touches them."""
        self._refuse("set_distractors")

    def close(self) -> None:
        """End the simulation; a second call does nothing."""
