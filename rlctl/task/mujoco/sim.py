"""The world of a task in MuJoCo: one world, or n worlds of one model for tasks in batches.

Contacts are soft: `solref` [s] is their time constant, at least two physics steps. Only the links of different bodies
collide, and those of one body that is loaded with `self_collision`; the friction of a contact is the product of the
frictions of its links, as in PyBullet, and at least 0.001.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from rlctl.errors import TaskError
from rlctl.task.attachments import Attachment, Joined
from rlctl.task.camera import Distractor, Pictures
from rlctl.task.motors import Motor
from rlctl.task.mujoco.body import MujocoBody
from rlctl.task.mujoco.cameras import MOST_DISTRACTORS, CameraPictures, as_row, make_looks
from rlctl.task.mujoco.drawn_world import DrawnWorld
from rlctl.task.mujoco.ideal_motors import make_ideal_motors
from rlctl.task.mujoco.parts import WORLD, Parts
from rlctl.task.mujoco.pictures import Marker, draw
from rlctl.task.mujoco.scene import MujocoScene
from rlctl.task.mujoco.world import Array, Fields, MujocoWorld
from rlctl.task.sim import Sim
from rlctl.task.world_index import WorldIndex

_LEAST_FRICTION = 1e-3
"""Of a contact: MuJoCo divides by it, and with less a falling robot's numbers become infinite."""


class MujocoSim(Sim):
    """A world in MuJoCo; with `worlds` all arrays of its bodies have a leading axis of so many rows.

    The model is compiled again after every change of its structure, so all of that belongs into `build`.
    """

    engine = "MuJoCo"
    bodies: dict[str, MujocoBody]

    def __init__(
        self,
        *,
        control_dt: float,
        substeps: int,
        solref: float = 0.02,
        iterations: int = 50,
        worlds: int | None = None,
        visuals: bool = True,
    ) -> None:
        self.world = MujocoWorld(substeps, worlds)
        self.mujoco = self.world.mujoco
        self._control_dt, self._solref, self._iterations = control_dt, solref, iterations
        self._visuals = visuals and worlds in (None, 1)  # nobody sees one world of many
        self.fields = Fields(self.world)
        self.cameras = {}
        self._views: dict[int, OneWorldSim] = {}
        self._camera_pictures: list[CameraPictures] = []  # one, after the first picture of a camera
        self.clear()

    def clear(self) -> None:
        self.bodies = {}
        self._pushes: list[_MujocoPush] = []
        self._markers: list[Marker] = []
        self._added: list[Callable[[MujocoScene], object]] = []  # what has added each body and each real motor
        self._drawn: list[DrawnWorld] = []  # one, after the first picture of a world without visual shapes
        self._close_cameras()
        self._scene = self._make_scene(visuals=self._visuals)
        model = self._scene.spec.compile()
        self.world.extra.clear()
        self.world.set_model(model, self.mujoco.MjData(model))
        self._look_up()

    def _make_scene(self, *, visuals: bool) -> MujocoScene:
        return MujocoScene(
            self.mujoco,
            timestep=self._control_dt / self.world.substeps,
            iterations=self._iterations,
            solref=self._solref,
            single=self.world.count is None,
            visuals=visuals,
        )

    @property
    def model(self) -> Any:
        """MuJoCo's `MjModel`, as it was built."""
        return self.world.mj_model

    @property
    def data(self) -> Any:
        """MuJoCo's `MjData` of a single world."""
        return self.world.mj_data

    def one(self, world: int) -> OneWorldSim:
        """Return one of the `worlds`, whose arrays have no leading axis; events act on it."""
        if world not in self._views:
            self._views[world] = OneWorldSim(self, world)
        return self._views[world]

    def set_gravity(self, gravity: float) -> None:
        self._scene.spec.option.gravity = self.model.opt.gravity[:] = [0.0, 0.0, -gravity]

    def set_contact_erp(self, erp: float) -> None:
        # The part of the depth that a physics step removes: a time constant of dt / erp, of at least two steps.
        self._solref = self._scene.solref = self._scene.spec.option.timestep * max(2.0, 1.0 / erp)

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
    ) -> MujocoBody:
        self._check_new(name)
        return self._add_body(
            lambda scene: scene.add_file(
                name,
                file,
                position=position,
                orientation=orientation,
                fixed=fixed,
                self_collision=self_collision,
                inertia=inertia,
                floor=floor,
            )
        )

    def _add_body(self, add: Callable[[MujocoScene], Parts]) -> MujocoBody:
        parts = add(self._scene)
        self._added.append(add)
        body = self.bodies[parts.name] = MujocoBody(self, parts)
        self._compile()
        return body

    def _look_up(self) -> None:
        """Look the arrays up again, which a compilation and `save` replace."""
        self.fields.forget()
        for body in self.bodies.values():
            body.bind()
        for view in self._views.values():
            view.look_up()

    def add_height_field(
        self, name: str, heights: Array, *, cell: float, color: Sequence[float] = (0.55, 0.6, 0.5)
    ) -> MujocoBody:
        self._check_new(name)
        return self._add_body(lambda scene: scene.add_height_field(name, heights, cell, color))

    def connect_gear(
        self, body: Any, driver: str, driven: str, *, ratio: float, max_force: float = 0, stiffness: float = 0
    ) -> None:
        body.find_joints([driver, driven])
        names = {"name1": f"{body.name}/{driven}", "name2": f"{body.name}/{driver}"}
        self._scene.add_equality(self.mujoco.mjtEq.mjEQ_JOINT, data=[0.0, ratio, *[0.0] * 10], **names)
        self._compile()

    def connect_point(self, first: Attachment, second: Attachment, *, max_force: float = 0) -> Joined:
        return self._connect(self.mujoco.mjtEq.mjEQ_CONNECT, first, second)

    def connect_fixed(self, first: Attachment, second: Attachment, *, max_force: float = 0) -> Joined:
        return self._connect(self.mujoco.mjtEq.mjEQ_WELD, first, second)

    def _connect(self, kind: Any, first: Attachment, second: Attachment) -> Joined:
        self._scene.connect(kind, first, second)
        self._compile()
        return Joined(first, second)

    def add_force_sensor(self, joint: str, link: str) -> None:
        """Measure force and torque of a joint at the centre of mass of `link`; both names are "BODY/NAME"."""
        self._scene.add_force_sensor(joint, link)
        self._compile()

    def add_contact_sensor(self, link: str) -> None:
        """Count the contacts of a link, which is named "BODY/NAME", with anything else."""
        self._scene.add_contact_sensor(link)
        self._compile()

    def add_motors(self, body: str, motors: Mapping[str, Motor]) -> None:
        """Make motors of a body real ones, by joint."""
        self._scene.add_motors(body, motors)
        self._added.append(lambda scene: scene.add_motors(body, motors))
        self._compile()

    def _compile(self) -> None:
        before = self.world.mj_model
        model, data = self._scene.compile(before, self.world.mj_data)
        self.world.set_model(model, data)
        self._set_extra(model, before)
        self._look_up()
        self.spread_friction()

    def _set_extra(self, model: Any, before: Any) -> None:
        friction, spin, roll = np.zeros(model.nbody), np.zeros(model.nbody), np.zeros(model.nbody)
        for parts in self._scene.parts.values():
            for link, value in parts.file.friction.items():
                number = 0 if link == WORLD else parts.links.get(link)
                if number is not None:
                    friction[number] = parts.built_friction.get(link, value)
                    spin[number] = parts.file.spin[link]
                    roll[number] = parts.file.roll.get(link, 0.0)
        self.world.extra |= {"friction": friction, "spin": spin, "roll": roll}
        self.world.extra["ideal motors"] = make_ideal_motors(model.nu)
        self.world.extra = make_looks(self.cameras) | self.world.extra  # what `build` has set so far stays
        strength, encoder_bias = np.ones(model.nu), np.zeros(model.nu)
        color = np.full((model.nbody, 3), np.nan)  # of links, where it was changed
        if "color" in self.world.extra:  # what a task has changed in `build` so far
            for motor in range(before.nu):
                number = model.actuator(before.actuator(motor).name).id
                strength[number] = self.world.extra["strength"][motor]
                encoder_bias[number] = self.world.extra["encoder bias"][motor]
            for body in range(before.nbody):
                color[model.body(before.body(body).name).id] = self.world.extra["color"][body]
        self.world.extra |= {"strength": strength, "color": color, "encoder bias": encoder_bias}
        self.world.extra["awaits command"] = np.ones(model.nu)
        # Of the compiled model, which sorts pairs.
        self._pair_links = model.geom_bodyid[np.column_stack([model.pair_geom1, model.pair_geom2])]

    def spread_friction(self) -> None:
        """Give contacts the product of the frictions of their links, as PyBullet computes it."""
        if not len(self._pair_links):
            return
        friction, spin, (one, two) = self.fields.model("friction"), self.fields.model("spin"), self._pair_links.T
        product = friction[..., one] * friction[..., two]
        turning = spin[..., one] * friction[..., two] + spin[..., two] * friction[..., one]
        pairs = self.fields.model("pair_friction")
        pairs[..., :2] = np.maximum(product, _LEAST_FRICTION)[..., None]
        pairs[..., 2] = np.maximum(turning, self.mujoco.mjMINMU)
        roll = self.fields.model("roll")
        rolling = roll[..., one] * friction[..., two] + roll[..., two] * friction[..., one]
        if rolling.any():
            pairs[..., 3:] = np.maximum(rolling, self.mujoco.mjMINMU)[..., None]
        self.fields.touch()

    def step(self, worlds: WorldIndex | None = None) -> None:
        if self._pushes:
            self._apply_pushes(None if worlds is None else set(worlds.tolist()))
        self.world.step(worlds)
        for body in self.bodies.values():
            body.limit_speeds()

    def _apply_pushes(self, worlds: set[int] | None) -> None:
        forces = self.world.data("xfrc_applied")
        moving = [push for push in self._pushes if worlds is None or push.world in worlds]
        for push in moving:
            forces[(push.world, push.link) if self.world.count is not None else push.link] = 0.0
        self._pushes[:] = [push for push in self._pushes if push.steps > 0 or push not in moving]
        for push in [push for push in moving if push.steps > 0]:
            row = (push.world, push.link) if self.world.count is not None else push.link
            forces[row][:3] += push.force
            push.steps -= 1

    @property
    def deepest_contact(self) -> float:
        distances = self.world.read_contact_distances(self.fields.index or 0)
        return max(0.0, -float(distances.min(initial=0.0)))

    def save(self) -> None:
        for body in self.bodies.values():
            body.measure_inertia()
        self.world.save()
        self._look_up()

    def restore(self, worlds: WorldIndex | None = None) -> None:
        rows = None if worlds is None else set(worlds.tolist())
        self._pushes[:] = [push for push in self._pushes if rows is not None and push.world not in rows]
        self.world.restore(worlds)
        for body in self.bodies.values():
            body.forget_motors(worlds)

    @contextlib.contextmanager
    def keep(self, worlds: NDArray[np.int64]) -> Iterator[None]:
        """Take back what the block of a `with` changes in some worlds of a batch."""
        modes = {name: dict(body.parts.active) for name, body in self.bodies.items()}
        try:
            with self.world.keep(worlds):
                yield
        finally:
            for name, body in self.bodies.items():
                if body.parts.active != modes[name]:
                    body.forget_motors(worlds)  # the next command writes its kind into all worlds again

    def shift_gravity(self, change: float) -> None:
        self.fields.model("opt.gravity")[..., 2] = self.world.built("opt.gravity")[2] + change
        self.fields.touch()

    def push(self, body: str, force: Sequence[float], duration_s: float, link: str | None = None) -> None:
        pushed = self.body(body)
        steps = max(1, round(duration_s / self._control_dt))
        number = pushed.find_link(link or pushed.base_name)  # type: ignore[attr-defined]
        self._pushes.append(_MujocoPush(self.fields.index or 0, number, np.array(force, float), steps))

    def add_marker(self, position: Sequence[float], radius: float, color: Sequence[float]) -> int:
        self._markers.append(Marker(position, radius, color))
        return len(self._markers) - 1

    def move_marker(self, marker: int, position: Sequence[float] | Array) -> None:
        self._markers[marker].position = position

    def render(
        self,
        width: int = 320,
        height: int = 240,
        *,
        eye: Sequence[float] = (1.5, 1.1, 1.1),
        target: Sequence[float] = (0.2, 0.0, 0.4),
        up: Sequence[float] = (0.0, 0.0, 1.0),
        field_of_view: float = 45.0,
        sun: bool = False,
        floor: float | None = None,
    ) -> NDArray[np.uint8]:
        """Draw the world as `Sim.render` does; films have a `sun` and a `floor`, which policies' pictures do not."""
        if self.world.batch is not None:
            self._refuse("pictures of many worlds")
        self.world.refresh()
        model, data = self._see()
        size = width, height
        return draw(
            model,
            data,
            size,
            self._markers,
            eye=eye,
            target=target,
            field_of_view=field_of_view,
            sun=sun,
            floor=floor,
        )

    def _see(self) -> tuple[Any, Any]:
        """Return the model and the data that pictures show."""
        if self._visuals:
            return self.model, self.data
        if not self._drawn:
            self._drawn.append(DrawnWorld(self._make_drawn_scene()))
        self._drawn[0].follow(self.world, 0)
        return self._drawn[0].model, self._drawn[0].data

    def _make_drawn_scene(self) -> MujocoScene:
        scene = self._make_scene(visuals=True)
        for add in self._added:
            add(scene)
        return scene

    def take_pictures(self, camera: str, worlds: WorldIndex | None = None) -> Pictures:
        self.find_camera(camera)
        if not self._camera_pictures:
            self._camera_pictures.append(CameraPictures(self._make_drawn_scene(), self.cameras))
        rows = worlds
        if rows is None:
            own = self.fields.index
            rows = np.arange(self.world.count or 1) if own is None else np.array([own])
        return self._camera_pictures[0].take(camera, self.world, rows)

    def set_light(self, brightness: float, direction: Sequence[float]) -> None:
        self.fields.model("light")[..., :] = [brightness, *direction]

    def move_camera(self, camera: str, shift: Sequence[float], turn: Sequence[float]) -> None:
        self.find_camera(camera)
        self.fields.model("camera_pose")[..., list(self.cameras).index(camera), :] = [*shift, *turn]

    def set_distractors(self, distractors: Sequence[Distractor]) -> None:
        if len(distractors) > MOST_DISTRACTORS:
            raise TaskError(f"set_distractors: {len(distractors)} things; at most {MOST_DISTRACTORS} fit")
        rows = self.fields.model("distractors")
        rows[...] = np.nan
        for number, distractor in enumerate(distractors):
            rows[..., number, :] = as_row(distractor)

    def _close_cameras(self) -> None:
        for pictures in self._camera_pictures:
            pictures.close()
        self._camera_pictures.clear()

    def close(self) -> None:
        self._close_cameras()
        with contextlib.suppress(AttributeError):
            self.world.batch = None


class OneWorldSim(MujocoSim):
    """One world of a `MujocoSim` with many: the same, but its arrays have no leading axis."""

    def __init__(self, batch: MujocoSim, index: int) -> None:
        self.batch = batch
        """The simulation of all worlds."""
        self.fields = Fields(batch.world, index)
        self.look_up()

    def __getattr__(self, name: str) -> Any:
        if name == "batch":
            raise AttributeError(name)
        return getattr(self.batch, name)

    def look_up(self) -> None:
        """Look the arrays up again."""
        self.fields.forget()
        self.bodies = {name: MujocoBody(self, parts) for name, parts in self.batch._scene.parts.items()}

    def load(self, *args: Any, **kwargs: Any) -> MujocoBody:
        self.batch.load(*args, **kwargs)
        return self.bodies[args[0]]

    def step(self, worlds: WorldIndex | None = None) -> None:
        self.batch.step(worlds)

    def save(self) -> None:
        self.batch.save()

    def restore(self, worlds: WorldIndex | None = None) -> None:
        self.batch.restore(worlds)

    def clear(self) -> None:
        self.batch.clear()
        self.look_up()

    def close(self) -> None:
        self.batch.close()


class _MujocoPush:
    def __init__(self, world: int, link: int, force: Array, steps: int) -> None:
        self.world, self.link = world, link
        self.force = force  # [N], world frame
        self.steps = steps  # control steps that it still acts
