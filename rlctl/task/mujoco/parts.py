"""What a body consists of in MuJoCo: names from its file, and their numbers in the compiled model."""

import math
from typing import Any, NamedTuple

import numpy as np

from rlctl.task.motors import Motor
from rlctl.task.mujoco.files import ModelFile, is_colliding
from rlctl.task.mujoco.real_motors import name_play
from rlctl.task.mujoco.world import Array

WORLD = "world"
"""MuJoCo's name of what all bodies are in; an MJCF file may give it shapes, such as a floor."""


class JointPlay(NamedTuple):
    """Numbers of the joint that is the play of another: the joint, and its elements of `qpos` and `qvel`."""

    joint: int
    position: int
    velocity: int


class Parts:
    """The names of a body's links and joints and their numbers in the compiled model, the same for all worlds."""

    def __init__(self, name: str, file: ModelFile, fixed: bool, child: Any) -> None:
        self.name, self.file, self.fixed = name, file, fixed
        self.base_name: str = child.worldbody.first_body().name
        self.terrain: Array | None = None
        self.own_actuators: list[str] = [actuator.name for actuator in child.actuators]
        """Names of the actuators that an MJCF file contains."""
        self.own_sensors: list[str] = [sensor.name for sensor in child.sensors if sensor.name]
        self.collision_geoms = [
            (number, geom.parent.name) for number, geom in enumerate(child.geoms) if is_colliding(geom)
        ]
        """Number and link of the geoms that collide."""
        self.masks = [(int(geom.contype), int(geom.conaffinity)) for geom in child.geoms]
        """MuJoCo's collision masks as the file has them, by number of the geom."""
        self.moving: set[str] = set()
        """Links that are not fixed to the world."""
        self.ancestors: dict[str, set[str]] = {WORLD: set()}
        for link in child.bodies[1:]:  # a parent comes before its children
            parent = link.parent.name
            self.ancestors[link.name] = {parent, *self.ancestors.get(parent, set())}
            if not fixed or link.joints or parent in self.moving:
                self.moving.add(link.name)
        hinges = [joint for joint in child.joints if int(joint.type) >= 2]  # sliding and rotating
        self.joint_names: list[str] = [joint.name for joint in hinges]
        self.built_friction: dict[str, float] = {}
        """Lateral friction of links that a task has set in `build`."""
        self.links: dict[str, int] = {}
        speeds = [file.max_speed.get(joint, 0.0) for joint in self.joint_names]
        self.speed_cap = max(speeds) if fixed and speeds and min(speeds) > 0 else math.inf
        self.drives: tuple[Array, Array, Array | None] | None = None
        self.real: dict[int, Motor] = {}
        """Motors of `set_motors`, by joint."""
        self.plays: dict[int, JointPlay] = {}
        """The joints in series that are the play of others, by joint."""
        self.has_bias = False
        """Whether an encoder has read something else than the joint's position."""
        self.inertia: Array | None = None
        self.active: dict[int, object] = {}
        """By joint, the kind of command that is written into the model."""

    @property
    def has_delay(self) -> bool:
        """Whether commands reach a motor late."""
        return any(motor.delay_s > 0 for motor in self.real.values())

    def may_collide(self, one: int, two: int) -> bool:
        """Return whether the file's masks let two of its own geoms collide, by MuJoCo's rule."""
        (type_one, affinity_one), (type_two, affinity_two) = self.masks[one], self.masks[two]
        return bool(type_one & affinity_two or type_two & affinity_one)

    def bind(self, model: Any) -> None:
        """Look up the numbers in a compiled model."""
        prefix = f"{self.name}/"
        bodies = {model.body(body).name: body for body in range(model.nbody)}
        self.links = {name.removeprefix(prefix): body for name, body in bodies.items() if name.startswith(prefix)}
        self.link_names = {body: name for name, body in self.links.items()}
        joints = [model.joint(f"{prefix}{joint}").id for joint in self.joint_names]
        self.positions, self.velocities = find_slice(model.jnt_qposadr[joints]), find_slice(model.jnt_dofadr[joints])
        self.motors = find_slice([model.actuator(f"{prefix}motor {joint}").id for joint in self.joint_names])
        self.own_motors = np.array([model.actuator(f"{prefix}{name}").id for name in self.own_actuators], int)
        self.own_gears = model.actuator_gear[self.own_motors]
        model.actuator_gear[self.own_motors] = 0.0  # until `set_controls`
        limited, limits = model.jnt_limited[joints][:, None], model.jnt_range[joints]
        self.low, self.high = np.where(limited, limits, (-np.inf, np.inf)).T
        self.joints = joints
        self.plays = {}
        for joint, name in enumerate(self.joint_names):
            if (number := _find_joint(model, name_play(self.name, name))) is not None:
                self.plays[joint] = JointPlay(number, int(model.jnt_qposadr[number]), int(model.jnt_dofadr[number]))
        self.geoms = [model.geom(f"{prefix}{number}").id for number, _ in self.collision_geoms]
        """Numbers of the geoms that collide."""
        self.free: tuple[int, int] | None = None  # where the state of a free base begins, in qpos and qvel
        for joint in range(model.njnt):
            if model.jnt_type[joint] == 0 and model.jnt_bodyid[joint] == self.links[self.base_name]:
                self.free = int(model.jnt_qposadr[joint]), int(model.jnt_dofadr[joint])


def _find_joint(model: Any, name: str) -> int | None:
    try:
        return int(model.joint(name).id)
    except KeyError:
        return None


def find_slice(numbers: Any) -> Any:
    """Return neighbouring numbers as a slice, which is faster than an array and gives views."""
    numbers = np.asarray(numbers, int)
    if len(numbers) and (np.diff(numbers) == 1).all():
        return slice(int(numbers[0]), int(numbers[-1]) + 1)
    return numbers
