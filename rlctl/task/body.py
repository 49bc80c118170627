"""`Body`: a body of the world, the same in every physics engine: joints and links by name, state, motors."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any, ClassVar, NamedTuple, NoReturn

import numpy as np
from numpy.typing import NDArray

from rlctl.errors import TaskError, UsageError, check_name
from rlctl.task.joints import Joints
from rlctl.task.motors import AnyMotors, Motor
from rlctl.task.named_motors import find_motor
from rlctl.task.rotations import roll_pitch_yaw

Array = NDArray[np.float64]
Vector = tuple[float, float, float]
Limit = float | Array | Sequence[float] | None
"""One number for all joints, one per joint, or None: the limit of the model file."""


class MassState(NamedTuple):
    """Pose and velocity of a link's centre of mass, world frame. Plain floats are faster here than arrays."""

    position: Vector  # [m]
    orientation: tuple[float, float, float, float]  # quaternion (x, y, z, w) of the inertial frame
    velocity: Vector  # [m/s]
    angular_velocity: Vector  # [rad/s]

    @property
    def roll_pitch_yaw(self) -> Vector:
        """The orientation as angles about x, y, z [rad]."""
        return roll_pitch_yaw(self.orientation)


class Contacts(NamedTuple):
    """Points where a body touches another: one element per point."""

    links: list[str]  # the body's own link, or its base
    forces: Array  # normal forces [N], shape (points,), 0 or more
    distances: Array  # [m], shape (points,), negative where the bodies overlap, as in `rewards.penetration`


class Drives(NamedTuple):
    """Spring and damper of the position controllers of joints; each of shape (joints,)."""

    stiffness: Array  # [N m/rad or N/m]
    damping: Array  # [N m s/rad or N s/m]


class Body:
    """A body of the world. Joint arrays have one element per movable joint, in `joint_names` order.

    In a world of a `BatchTask` all arrays that are returned or given have a leading axis: one row per world. Methods
    that change the state of bodies take `worlds`, the numbers of the worlds to change; the arrays have a row for each.
    `joints` and `links` are names, by default all; `links` may include `base_name`. Units: [rad], [rad/s] and [N m] for
    rotating joints, [m], [m/s] and [N] for sliding joints. A method that an engine lacks raises `UsageError`.
    """

    engine: ClassVar[str]
    name: str
    file: Path
    fixed: bool
    inertia_from_file: bool = False
    """Whether the moments of inertia are those of a URDF file."""
    base_name: str
    link_names: list[str]
    """Names of all links but the base."""
    joint_names: list[str]
    joint_low: Array
    """Joint limits [rad or m], infinite where the model file has none; shape (joints,), as `joint_high`."""
    joint_high: Array
    joint_max_force: Array
    """Torque or force limit in the model file, or of `set_motors` [N m or N], shape (joints,); 0: none is known."""
    joint_max_speed: Array
    """Velocity limit in the model file, or of `set_motors` [rad/s or m/s], shape (joints,); 0: none is known."""
    actuator_names: Sequence[str] = ()
    """Names of the actuators that an MJCF file has, for `set_controls`; PyBullet does not read them."""
    sensor_names: Sequence[str] = ()
    """Names of the sensors that an MJCF file has, for `sensor`; PyBullet does not read them."""
    terrain: Array | None
    """Points of rough ground [m], world frame, shape (along x, along y, 3); None for any other body."""
    drives: Drives | None
    """What `set_drives` set; None: `drive_to` uses its `gain`."""
    motors: Mapping[str, Motor] = MappingProxyType({})
    """What `set_motors` set, by joint."""
    _chosen: set[int]  # joints whose motors the task has set or disabled

    def _refuse(self, what: str) -> NoReturn:
        raise UsageError(f"{what}: not in {self.engine}; use the other engine: --sim")

    def find_joints(self, joints: Collection[str] = ()) -> list[int]:
        """Return the indices of joints, or of all, in joint arrays; raises `TaskError` for a name that is not there."""
        for joint in joints:
            if joint not in self.joint_names:  # checked first because tasks may name joints at every step
                check_name(joint, self.joint_names, f"{self.file.name} has no joint", TaskError)
        if not self.joint_names:
            raise TaskError(f"{self.file.name} has no joints")
        return [self.joint_names.index(joint) for joint in joints] or list(range(len(self.joint_names)))

    @property
    def joint_positions(self) -> Array:
        """Joint angles [rad] or displacements [m], shape (joints,)."""
        raise NotImplementedError

    @property
    def joint_velocities(self) -> Array:
        """Joint velocities [rad/s] or [m/s], shape (joints,)."""
        raise NotImplementedError

    @property
    def joint_torques(self) -> Array:
        """Torques [N m] or forces [N] that the motors gave in the last physics step, shape (joints,).

        They include those of `drive_to` and `drive_at`, limited by their maximum force, and those of `set_torques`.
        """
        raise NotImplementedError

    def add_force_sensor(self, joint: str) -> None:
        """Measure the load of a joint, which may be fixed; `joint_reaction` reads it. Call it in `build`."""
        self._refuse("add_force_sensor")

    def joint_reaction(self, joint: str) -> Array:
        """Return the force [N] and torque [N m] that a joint carried in the last physics step, shape (6,).

        Both act on the link that the joint moves, in the axes of that link's inertial frame; the torque is about its
        centre of mass, without that of the joint's own motor. If a load hangs from the joint, the force points up.
        """
        self._refuse("joint_reaction")

    def add_contact_sensor(self, link: str) -> None:
        """Measure whether a link touches anything; `touches` reads it. Call it in `build`."""
        self._refuse("add_contact_sensor")

    def touches(self, link: str) -> NDArray[np.bool_]:
        """Return whether a link touches another body, or another link of its own, shape ().

        It needs `add_contact_sensor`. PyBullet tells it of the last physics step.
        """
        self._refuse("touches")

    def solve_inverse_kinematics(
        self, link: str, position: Sequence[float] | Array, orientation: Sequence[float] | Array | None = None
    ) -> Array:
        """Return joint positions [rad or m], shape (joints,), that bring a link's frame to a world pose.

        `position` [m]; `orientation` is a quaternion (x, y, z, w), by default any will do. The search starts at the
        current joint positions and stops within 0.1 mm or after 100 iterations, even if the pose is out of reach.
        """
        self._refuse("solve_inverse_kinematics")

    def link_position(self, link: str) -> Array:
        """Position of the link frame [m], world frame, shape (3,)."""
        raise NotImplementedError

    def link_orientation(self, link: str) -> Array:
        """Orientation of the link frame, quaternion (x, y, z, w), world frame, shape (4,)."""
        raise NotImplementedError

    def mass_state(self, link: str) -> MassState:
        """Return where the centre of mass of a link, or of the base, is and how it moves.

        In PyBullet the position and orientation of a link are from the beginning of the last physics step (substep),
        because it computes them without `computeForwardKinematics`. All other values are from the end of that step.
        """
        self._refuse("mass_state")

    def mass_positions(self, links: Sequence[str]) -> list[Vector]:
        """Return the positions of the centres of mass of links [m], world frame, as in `mass_state`; not cached."""
        self._refuse("mass_positions")

    def links_touching(self, other: Any) -> set[str]:
        """Return the links, or the base, that touched `other` in the last step; `other` may be the body itself."""
        self._refuse("links_touching")

    def contacts_with(self, other: Any) -> Contacts:
        """Return the points where this body touches `other`, at the last physics step."""
        self._refuse("contacts_with")

    def surface_heights(self, places: Array) -> Array:
        """Return the heights of this body's top [m] at `places` [m], world frame, shape (..., 2) to (...).

        For ground: the body stands where it was built. Where it has no surface the height is 0.
        """
        self._refuse("surface_heights")

    def distance_to(self, other: Any, link: str | None = None) -> float:
        """Return the shortest distance [m] between the collision shapes of two bodies, negative where they overlap.

        If `link` is given, only that link of this body is measured.
        """
        self._refuse("distance_to")

    @property
    def base_position(self) -> Array:
        """Position of the base's centre of mass [m], world frame, shape (3,)."""
        raise NotImplementedError

    @property
    def base_orientation(self) -> Array:
        """Orientation of the base's inertial frame, quaternion (x, y, z, w), shape (4,)."""
        raise NotImplementedError

    @property
    def base_velocity(self) -> Array:
        """Velocity of the base's centre of mass [m/s], world frame, shape (3,)."""
        raise NotImplementedError

    @property
    def base_angular_velocity(self) -> Array:
        """Angular velocity of the base [rad/s], world frame, shape (3,)."""
        raise NotImplementedError

    def set_base(
        self,
        position: Any,
        orientation: Any = (0.0, 0.0, 0.0, 1.0),
        *,
        velocity: Any = None,
        angular_velocity: Any = None,
        worlds: NDArray[np.int64] | None = None,
    ) -> None:
        """Place the base, its centre of mass at `position` [m]; `Sim.load` places its origin.

        It is at rest unless `velocity` [m/s], of its centre of mass, or `angular_velocity` [rad/s] are given, in the
        world's frame; a fixed base has none.
        """
        raise NotImplementedError

    def add_velocity(
        self, velocity: Sequence[float] | Array, turning: Sequence[float] | Array = (0.0, 0.0, 0.0)
    ) -> None:
        """Add to the velocity of the base's centre of mass [m/s] and to its angular velocity [rad/s], world frame.

        All links move with it.
        """
        self._refuse("add_velocity")

    def set_joints(
        self, positions: Array, velocities: Array | None = None, *, worlds: NDArray[np.int64] | None = None
    ) -> None:
        """Place the joints: `positions` and `velocities` of shape (joints,); without velocities they are at rest."""
        raise NotImplementedError

    def set_drives(
        self,
        stiffness: float | Sequence[float] | Array,
        damping: float | Sequence[float] | Array,
        *,
        armature: float | Sequence[float] | Array | None = 0.0,
    ) -> None:
        """Make `drive_to` a spring and a damper, as the position controllers of real robots are. Call it in `build`.

        `stiffness` [N m/rad or N/m], `damping` [N m s/rad or N s/m] and `armature`, the inertia of motor and gears at
        the joint [kg m^2 or kg], are one number for all joints or one per joint; an armature of None is the model
        file's. The torque on a joint is `stiffness * (target - position) - damping * velocity`, within its force limit,
        computed in every physics step.
        PyBullet's joints have no armature: it is left out there. Raises `TaskError` for a damping that PyBullet's
        explicit steps cannot have.
        """
        self._refuse("set_drives")

    def set_motors(self, motors: AnyMotors, *, joints: Sequence[str] = (), **changes: Any) -> None:
        """Give joints real motors, with friction, voltage, backlash and delay. Call it in `build`; MuJoCo only.

        `motors` is a `Motor` or the name of one in `rlctl.task.named_motors`, for all joints or one per joint, or such
        motors by the names of joints, as `rlctl identify` writes them. `changes` replace values of all of them, each
        one number or one per joint: `backlash_rad=0.02`. From then on
        `drive_to` sets the targets of the motors' controllers, and what a motor's limits allow is what it gives.
        Afterwards `joint_positions` are what encoders read: those of the motors, without the play behind them, plus
        their bias. `set_joints` takes the same. A joint's other motors stay as `set_drives` has made them.
        """
        raise UsageError(
            "set_motors: real motors (friction, voltage, backlash, delay) are in MuJoCo only: use --sim mujoco, or "
            "set_drives, which both engines have"
        )

    def drive_to(
        self,
        positions: Array,
        *,
        max_speed: float | Sequence[float] | None = None,
        max_force: float | Sequence[float] | None = None,
        gain: float = 0.1,
        joints: Sequence[str] = (),
        velocities: Array | None = None,
    ) -> None:
        """Set position targets [rad or m]; the default limits of speed and force are those of the model file.

        With `set_drives` joints are springs and dampers, without a limit of speed unless `max_speed` is given.
        Their dampers resist the difference from `velocities` [rad/s or m/s], by default 0: with a stiffness of 0 a
        joint follows that speed, as a wheel does. PyBullet's springs have no such targets.
        Otherwise `gain` is the fraction of the position error that one physics step removes, in (0, 1].
        """
        raise NotImplementedError

    def drive_at(
        self, velocities: Array, *, max_force: float | Sequence[float] | None = None, joints: Sequence[str] = ()
    ) -> None:
        """Set velocity targets [rad/s or m/s]; the default limit of the force is that of the model file.

        A target of 0 brakes the joint with at most that force.
        """
        raise NotImplementedError

    def disable_motors(self, joints: Sequence[str] = ()) -> None:
        """Switch off the motors that hold joints, so that only `set_torques` moves them."""
        raise NotImplementedError

    def set_torques(self, torques: Array, joints: Sequence[str] = ()) -> None:
        """Apply `torques` [N m or N] to the joints in all substeps of the next step.

        Disable the motors of these joints first, with `disable_motors`. Raises `TaskError` for a joint whose default
        motor still holds it in place.
        """
        raise NotImplementedError

    def set_controls(self, values: Array, actuators: Sequence[str] = ()) -> None:
        """Set the controls of actuators that the MJCF file has, in their own units, shape (actuators,).

        By default all of `actuator_names`. They do nothing before the first call after a reset, so that `drive_to`,
        `drive_at` and `set_torques` move a joint alone. Afterwards all of them act, on top of these motors.
        """
        self._refuse("set_controls")

    def sensor(self, name: str) -> Array:
        """Return the values of a sensor that the MJCF file has, in MuJoCo's units, shape (size,).

        Sensors of positions and velocities are up to date; forces and accelerations are those of the last physics step,
        and 0 after a reset.
        """
        self._refuse("sensor")

    def scale_motor_strength(self, factor: float, joints: Sequence[str] = ()) -> None:
        """Scale the force of the joints' motors by `factor`, until the next reset."""
        raise NotImplementedError

    def set_joint_friction(self, friction: float | Array, joints: Sequence[str] = ()) -> None:
        """Set the dry friction of joints [N m or N], until the next reset: one number, or one per joint."""
        self._refuse("set_joint_friction")

    def set_backlash(self, backlash: float | Array, joints: Sequence[str] = ()) -> None:
        """Set the play of joints [rad or m], from end to end, until the next reset: one number, or one per joint.

        Raises `TaskError` for joints to which `set_motors` has given no play.
        """
        self._refuse("set_backlash")

    def set_voltage(self, voltage: float | Array, joints: Sequence[str] = ()) -> None:
        """Set the supply of motors [V], until the next reset: one number, or one per joint.

        A servo that regulates its voltage is also less stiff with less of it.
        """
        self._refuse("set_voltage")

    def scale_torque_constant(self, factor: float | Array, joints: Sequence[str] = ()) -> None:
        """Set the torque constant of motors to `factor` times that of the built world, until the next reset.

        Their controllers do not know of it: they are stiffer by the same factor.
        """
        self._refuse("scale_torque_constant")

    def set_encoder_bias(self, bias: float | Array, joints: Sequence[str] = ()) -> None:
        """Set what encoders read where their joints are at 0 [rad or m], until the next reset.

        `joint_positions`, `drive_to` and `set_joints` have the positions of the encoders.
        """
        self._refuse("set_encoder_bias")

    def set_motor_delay(self, delay_s: float, joints: Sequence[str] = ()) -> None:
        """Set the time from a command to its torque [s], until the next reset, rounded to physics steps.

        Raises `TaskError` for more than twice the one that `set_motors` has set.
        """
        self._refuse("set_motor_delay")

    def lock_joints(self, joints: Sequence[str] = ()) -> None:
        """Hold joints where they are, against motors and loads, until the next reset: as a jammed gear does.

        In PyBullet a joint that the task never drives is free after that reset.
        """
        self._refuse("lock_joints")

    def cap_joint_speed(self, speed: float) -> None:
        """Limit the speed of all joints to `speed` [rad/s or m/s], even under external forces.

        PyBullet has one such limit per body, which also applies to the base of a free body; MuJoCo has none, and speeds
        are cut at the end of a control step. `Sim.load` sets it for a fixed body to the highest speed limit of the
        joints in the URDF.
        """
        raise NotImplementedError

    def total_mass(self) -> float:
        """Return the mass of all links as the world was built [kg]."""
        raise NotImplementedError

    def find_trunk(self) -> str | None:
        """Return the link that moves through the world: a free base, or a link on a sliding joint longer than 100 m."""
        raise NotImplementedError

    def scale_mass(self, factor: float, links: Sequence[str] = ()) -> None:
        """Set mass and inertia to `factor` times the built world's values, until the next reset."""
        raise NotImplementedError

    def set_friction(self, friction: float, links: Sequence[str] = ()) -> None:
        """Set the lateral friction, until the next reset; that of a contact is the product of both links'."""
        raise NotImplementedError

    def set_contact_stiffness(self, stiffness: float, links: Sequence[str] = ()) -> None:
        """Set the stiffness of a contact point of the links [N/m], until the next reset.

        Contacts are rigid by default. In PyBullet they stay springs after the first call, very stiff ones after a
        reset.
        """
        self._refuse("set_contact_stiffness")

    def scale_joint_damping(self, factor: float, joints: Sequence[str] = ()) -> None:
        """Set the joints' damping to `factor` times the built world's values, until the next reset.

        Raises `TaskError` if all of these are 0, because no factor can change that.
        """
        raise NotImplementedError

    def set_joint_damping(self, damping: float, joints: Sequence[str] = ()) -> None:
        """Set the joints' damping [N m s/rad or N s/m], until the next reset."""
        raise NotImplementedError

    def set_color(self, rgb: Sequence[float], links: Sequence[str] = ()) -> None:
        """Paint the links, until the next reset: red, green, blue in [0, 1]; their opacity does not change."""
        self._refuse("set_color")

    def describe_joints(
        self, joints: Sequence[str], *, default_positions: Sequence[float] | float = (), **commanded: Any
    ) -> Joints:
        """Return joints with the limits of the model file, for `Task.describe_joints`.

        `commanded` are the fields of `Joints` that describe the action: `action_scale=0.25`, for example, or a number
        per joint; and `max_speed` and `max_torque`, where the task's motors have other limits than the model file.
        If a limit is missing, 0 or infinite for one of the joints, it is left out for all of them. Those of real motors
        are the speed without load and the torque at standstill.
        """
        chosen = self.find_joints(joints)
        low, high = self.joint_low[chosen], self.joint_high[chosen]
        speed, torque = (
            limits.tolist() if (limits > 0).all() and np.isfinite(limits).all() else ()
            for limits in (self.joint_max_speed[chosen], self.joint_max_force[chosen])
        )
        bounded = bool((low < high).all() and np.isfinite([low, high]).all())
        given: dict[str, Any] = {"max_speed": speed, "max_torque": torque, "default_positions": default_positions}
        return Joints(
            names=[self.joint_names[joint] for joint in chosen],
            low=low.tolist() if bounded else (),
            high=high.tolist() if bounded else (),
            **(self._describe_drives(chosen) | given | commanded),
        )

    def _describe_drives(self, joints: list[int]) -> dict[str, Any]:
        """Return what `Joints` has of springs, dampers and motors; what is not known of all joints is left out."""
        found: dict[str, list[float | None]] = {
            name: [] for name in ("stiffness", "damping", "drive_gain", "drive_voltage")
        }
        for joint in joints:
            motor = self.motors.get(self.joint_names[joint])
            values: tuple[float | None, ...] = (None,) * len(found)
            if motor is not None:
                values = motor.stiffness_nm_per_rad, motor.damping_nms_per_rad, motor.position_gain, motor.voltage_v
            elif self.drives is not None:
                values = float(self.drives.stiffness[joint]), float(self.drives.damping[joint]), None, None
            for name, value in zip(found, values, strict=True):
                found[name].append(value)
        if None in found["drive_gain"]:
            found["drive_voltage"] = [None]  # a voltage says something about a gain only
        known = {name: [value for value in values if value is not None] for name, values in found.items()}
        return {name: values for name, values in known.items() if len(values) == len(joints)}

    def _spread_motors(self, motors: AnyMotors, joints: Sequence[str], changes: Mapping[str, Any]) -> dict[int, Motor]:
        """Return motors by joint; raises `TaskError` where their number, names or values are wrong."""
        if isinstance(motors, Mapping):
            if joints:
                raise TaskError("set_motors: motors by joint and joints= exclude each other")
            joints, listed = list(motors), list(motors.values())
        chosen = self.find_joints(joints)
        if isinstance(motors, Motor | str):
            listed = [motors] * len(chosen)
        elif not isinstance(motors, Mapping):
            listed = list(motors)
        if len(listed) != len(chosen):
            raise TaskError(f"{self.file.name}: {len(listed)} motors for {len(chosen)} joints")
        values = {name: _list_values(name, value, len(chosen)) for name, value in changes.items()}
        result = {}
        for place, (joint, given) in enumerate(zip(chosen, listed, strict=True)):
            motor = Motor().with_values(given) if isinstance(given, Mapping) else find_motor(given)
            motor = motor.with_values({name: value[place] for name, value in values.items()})
            if motor.stiffness_nm_per_rad is None:
                named = f" {motor.name!r}" if motor.name else ""
                raise TaskError(f"motor{named}: its stiffness is unknown; pass stiffness_nm_per_rad=")
            result[joint] = motor
        return result

    def _find_force_limits(self, joints: list[int], max_force: Limit) -> Array:
        """Return the force limits of motors, shape (joints,); raises `TaskError` if task and file have none."""
        limits = self.joint_max_force[joints] if max_force is None else np.broadcast_to(max_force, len(joints))
        if max_force is None and not limits.all():
            names = [self.joint_names[joint] for joint, limit in zip(joints, limits, strict=True) if limit == 0]
            raise TaskError(
                f"{self.file.name} gives no effort limit for joint {names[0]!r}, so its motor would have no force: "
                "pass max_force= [N m], or write <limit effort=...> into the model"
            )
        return np.asarray(limits, float)

    def _check_free(self, joints: list[int]) -> None:
        """Raise `TaskError` if a motor holds one of the joints, against the torque of `set_torques`."""
        if not self._chosen.issuperset(joints):
            held = next(self.joint_names[joint] for joint in joints if joint not in self._chosen)
            raise TaskError(
                f"set_torques: the motor of {held!r} holds it in place; call disable_motors() in build first"
            )

    def _spread(self, name: str, value: Any) -> Array:
        """Return one number, or one per joint, as an array of shape (joints,)."""
        array, count = np.asarray(value, float), len(self.joint_names)
        if array.shape not in ((), (count,)) or not (array >= 0).all() or not math.isfinite(array.sum()):
            raise TaskError(f"{self.file.name}: {name} {value} is not one number, or one for each of {count} joints")
        return np.broadcast_to(array, count).copy()


def _list_values(name: str, value: Any, count: int) -> list[Any]:
    """Return one value, or one per joint, as a list of one per joint."""
    if isinstance(value, str) or np.ndim(value) == 0:
        return [value] * count
    values = np.asarray(value).tolist()
    if len(values) != count:
        raise TaskError(f"motors: {name} has {len(values)} values for {count} joints")
    listed: list[Any] = values
    return listed
