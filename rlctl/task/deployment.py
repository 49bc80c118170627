"""`Deployment`: how a policy that moves a robot's joints is deployed: joints, observations, gains, rate, commands.

It is what other projects write beside their policies, each in a form of its own; see `rlctl.importing.foreign`.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Annotated, Any, Literal, Self

import numpy as np
import pydantic
from numpy.typing import NDArray

from rlctl.task.layout import Layout
from rlctl.task.terms import Euler, Gravity, LastAction, PhaseClock, Scaled, Term

Kind = Literal[
    "gyroscope",
    "velocity",
    "gravity",
    "euler",
    "command",
    "joint_positions",
    "joint_velocities",
    "last_action",
    "phase",
    "motion",
    "anchor_orientation",
    "accelerometer",
    "contacts",
    "targets",
    "constant",
    "heights",
]
TASK = "rlctl_locomotion.deployed:Deployed"
"""The task that plays deployed policies which follow velocity commands."""
MOTION_TASK = "rlctl_locomotion.deployed_motion:DeployedMotion"
"""The task that plays those which follow a clip."""
TASKS = (TASK, MOTION_TASK)
NOT_TRAINED = (
    "an imported policy is not trained further: rlctl distill POLICY trains a student of it, "
    "rlctl tasks new NAME --model ROBOT makes a task of the robot to train"
)
"""What refusals of a training say."""
COMMANDS = ("lin_vel_x", "lin_vel_y", "ang_vel_z")
"""What the observation `command` consists of [m/s, m/s, rad/s], in this order."""
USUAL_TOLERANCE = 0.25
"""[m/s], largest mean error of the velocity in an episode that succeeds; less for robots whose commands are slow."""
ORIENTATION = "orientation"  # the quantity from which gravity and Euler angles are computed
MOTION = ("motion", "anchor_orientation")
"""What is observed of a clip: joint positions and velocities, and the orientation of the link `anchor`."""
RELATIVE = ("joint_positions", "targets")
"""Observations that may be from the default positions."""
_OF_JOINTS = ("joint_positions", "joint_velocities", "last_action", "targets")
_MEASURED = (
    "gyroscope",
    "velocity",
    "accelerometer",
    "joint_positions",
    "joint_velocities",
    "targets",
    "contacts",
    "heights",
)
"""What is observed as it is measured, shifted and clipped."""
_Number = Annotated[float, pydantic.AllowInfNan(False)]
_Numbers = tuple[_Number, ...]
_Factor = _Number | _Numbers
_LONGEST = 1000  # values of a history


class ObservedPart(pydantic.BaseModel, extra="forbid", frozen=True):
    """A part of what a policy observes: `scale` times a quantity within `clip`, in the robot's own frame."""

    kind: Kind
    scale: _Factor = 1.0  # one factor, or one per element; 0 for elements that the policy gets as 0
    shift: _Factor = 0.0  # is added to the quantity, before `clip` and `scale`, in SI units
    clip: tuple[_Number, _Number] | None = None  # of the value before `scale`, in SI units
    history: int = pydantic.Field(1, ge=1, le=_LONGEST)  # number of last values
    frame: Literal["body", "world"] = "body"  # of the vectors gyroscope and velocity
    relative: bool = True  # joint positions and targets are from the default positions
    period_s: float | None = pydantic.Field(None, gt=0)  # of `phase`
    offsets: _Numbers = (0.0,)  # of `phase`, in parts of the period: one per leg, for example
    cosines_first: bool = False  # `phase` is the cosines of all offsets, then the sines
    links: tuple[str, ...] = ()  # of `contacts`: 1 for each that touches something, else 0
    sensor: str = "accelerometer"  # of `accelerometer`: its name in the MJCF file
    values: _Numbers = ()  # of `constant`: what the policy always gets, such as a command that nobody gives


class HeightScan(pydantic.BaseModel, extra="forbid", frozen=True):
    """A grid of points around the robot, whose x axis points forwards; without roll and pitch."""

    x: _Numbers = pydantic.Field(min_length=1)  # [m], forwards
    y: _Numbers = pydantic.Field(min_length=1)  # [m], to the left
    x_first: bool = True  # x changes from one point to the next, as in Isaac Lab; otherwise y, as in legged_gym

    @property
    def points(self) -> NDArray[np.float64]:
        """The points in the policy's order [m], shape (points, 2)."""
        along, across = np.meshgrid(self.x, self.y, indexing="xy" if self.x_first else "ij")
        return np.column_stack([along.ravel(), across.ravel()])


class Deployment(pydantic.BaseModel, extra="forbid", frozen=True):
    """A deployed policy of a robot that follows velocity commands or a clip; values are in the order of `joints`."""

    joints: tuple[str, ...] = pydantic.Field(min_length=1)  # in the order of the action and of observations
    default_positions: _Numbers  # [rad]; the targets of action 0, and what relative positions are from
    action_scale: _Numbers  # [rad], or [rad/s] of wheels, per 1 of the action
    action_clip: tuple[_Factor, _Factor] = (-100.0, 100.0)  # lowest and highest action, one number or one per joint
    stiffness: _Numbers  # [N m/rad]
    damping: _Numbers  # [N m s/rad]
    max_torque: _Numbers = ()  # [N m]; empty: the model file's
    armature: _Numbers = ()  # [kg m^2]; empty: the model file's
    wheels: tuple[str, ...] = ()  # joints whose action is a speed
    target_speed: _Numbers = ()  # [rad/s], largest speed of the joints' targets; empty: no limit
    control_dt: float = pydantic.Field(gt=0, le=1)  # [s]
    physics_dt: float = pydantic.Field(0.005, gt=0)  # [s]
    observations: tuple[ObservedPart, ...] = pydantic.Field(min_length=1)  # in the order of the policy's input
    history_order: Literal["terms", "frames"] = "terms"
    """Whether the input has all values of a part together, or all parts of a step."""
    newest_first: bool = False
    history_start: Literal["first", "zeros"] = "first"
    """What fills histories when an episode begins."""
    commands: Mapping[str, tuple[_Number, _Number]] = {}
    """Lowest and highest command by name, one of `COMMANDS` [m/s, m/s, rad/s]; one that is left out is 0."""
    start_height: float = pydantic.Field(gt=0)  # [m], of the trunk's centre of mass
    scan: HeightScan | None = None  # where `heights` are observed
    anchor: str = ""  # link whose orientation a clip has; empty: the base

    @pydantic.model_validator(mode="after")
    def _check(self) -> Self:
        count = len(self.joints)
        for name in ("default_positions", "action_scale", "stiffness", "damping"):
            if len(getattr(self, name)) != count:
                raise ValueError(f"{name} has {len(getattr(self, name))} numbers for {count} joints")
        for name in ("max_torque", "armature", "target_speed"):
            if len(getattr(self, name)) not in (0, count):
                raise ValueError(f"{name} has {len(getattr(self, name))} numbers for {count} joints")
        for bound in self.action_clip:
            if isinstance(bound, tuple) and len(bound) != count:
                raise ValueError(f"action_clip has {len(bound)} numbers for {count} joints")
        for name in ("stiffness", "damping", "max_torque", "armature", "target_speed"):
            if min(getattr(self, name), default=0.0) < 0:
                raise ValueError(f"{name} has a negative number")
        if len(set(self.joints)) < count:
            raise ValueError("joints has a name twice")
        if unknown := sorted(set(self.wheels) - set(self.joints)):
            raise ValueError(f"wheels has {unknown[0]!r}, which is not in joints")
        if unknown := [name for name in self.commands if name not in COMMANDS]:
            raise ValueError(f"commands has {unknown[0]!r}; it may have {', '.join(COMMANDS)}")
        kinds = [part.kind for part in self.measured_parts]
        if not kinds:
            raise ValueError("observations has nothing that is measured")
        twice = {kind for kind in kinds if kinds.count(kind) > 1}
        if twice:
            raise ValueError(f"observations has {sorted(twice)[0]!r} twice")
        for part in self.observations:
            self._check_part(part)
        if self.history_order == "frames" and len({part.history for part in self.observations}) > 1:
            raise ValueError("history_order is frames, but the histories are of different lengths")
        return self

    def _check_part(self, part: ObservedPart) -> None:
        size, scale = self.find_size(part), part.scale
        if isinstance(scale, tuple) and len(scale) != size:
            raise ValueError(f"observation {part.kind!r} has {len(scale)} scales for {size} elements")
        if part.kind == "phase" and part.period_s is None:
            raise ValueError("observation 'phase' has no period_s")
        if part.frame == "world" and part.kind not in ("gyroscope", "velocity"):
            raise ValueError(f"observation {part.kind!r} has no frame")
        if part.clip is not None and part.kind not in _MEASURED:
            raise ValueError(f"observation {part.kind!r} cannot be clipped")
        if part.shift != 0.0 and part.kind not in _MEASURED:
            raise ValueError(f"observation {part.kind!r} cannot be shifted")
        if isinstance(part.shift, tuple) and len(part.shift) != size:
            raise ValueError(f"observation {part.kind!r} has {len(part.shift)} shifts for {size} elements")
        if part.kind == "heights" and self.scan is None:
            raise ValueError("observation 'heights' needs scan, such as {x: [-0.1, 0, 0.1], y: [-0.1, 0, 0.1]} [m]")
        if part.kind == "contacts" and not part.links:
            raise ValueError("observation 'contacts' has no links")
        if part.kind == "constant" and not part.values:
            raise ValueError("observation 'constant' has no values")

    def find_size(self, part: ObservedPart) -> int:
        """Return the number of elements of one value of an observation."""
        if part.kind in _OF_JOINTS:
            return len(self.joints)
        if part.kind == "contacts":
            return len(part.links)
        if part.kind == "constant":
            return len(part.values)
        if part.kind == "heights":
            return 0 if self.scan is None else len(self.scan.points)
        if part.kind == "motion":
            return 2 * len(self.joints)
        if part.kind == "anchor_orientation":
            return 6
        if part.kind == "phase":
            return 2 * len(part.offsets)
        return 3

    @property
    def measured_parts(self) -> list[ObservedPart]:
        """The observations that are not constant."""
        return [part for part in self.observations if part.kind != "constant"]

    @property
    def fastest_command(self) -> float:
        """The largest linear velocity that is commanded [m/s]."""
        x, y = (np.abs(self.commands.get(name, 0.0)).max() for name in COMMANDS[:2])
        return float(np.hypot(x, y))

    @property
    def follows_motion(self) -> bool:
        """Whether the policy observes a clip."""
        return any(part.kind in MOTION for part in self.observations)

    @property
    def action_bounds(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """The lowest and the highest action, each of shape (joints,)."""
        count = len(self.joints)
        low, high = (np.broadcast_to(np.asarray(bound, np.float32), count).copy() for bound in self.action_clip)
        return low, high

    @property
    def observation_size(self) -> int:
        """The number of elements of the policy's input."""
        return sum(self.find_size(part) * part.history for part in self.observations)

    @property
    def substeps(self) -> int:
        """Physics steps per action."""
        return max(1, round(self.control_dt / self.physics_dt))

    @property
    def history(self) -> dict[str, int]:
        """Number of last values by observation, of those that have several."""
        return {part.kind: part.history for part in self.measured_parts if part.history > 1}

    @property
    def layout(self) -> Layout:
        """Where rlctl observes the parts: all values of a part together, the oldest first."""
        sizes: dict[str, int] = {part.kind: self.find_size(part) * part.history for part in self.measured_parts}
        return Layout(sizes, self.history)

    def find_columns(self) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Return of each element of the policy's input which element of `layout` it is, and times which factor.

        Elements that `find_constants` has are left out.
        """
        places = {part.name: part for part in self.layout.parts}
        columns: dict[tuple[str, int], NDArray[np.int64]] = {}
        factors: dict[str, NDArray[np.float64]] = {}
        for part in self.measured_parts:
            size, place = self.find_size(part), places[part.kind]
            order = np.arange(size)
            if part.cosines_first:
                order = np.roll(order, size // 2)
            for age in range(part.history):
                columns[part.kind, age] = place.start + (part.history - 1 - age) * size + order
            factors[part.kind] = np.broadcast_to(np.asarray(part.scale, float), size)
        blocks = [(part.kind, age) for part, age in self._list_blocks() if part.kind != "constant"]
        return (
            np.concatenate([columns[block] for block in blocks]),
            np.concatenate([factors[kind] for kind, _ in blocks]),
        )

    def find_constants(self) -> tuple[NDArray[np.bool_], NDArray[np.float64]]:
        """Return which elements of the policy's input are constant, and the values of these."""
        is_constant: list[bool] = []
        values: list[float] = []
        for part, _ in self._list_blocks():
            is_constant += [part.kind == "constant"] * self.find_size(part)
            if part.kind == "constant":
                values += np.multiply(part.values, part.scale).tolist()
        return np.array(is_constant), np.array(values)

    def _list_blocks(self) -> list[tuple[ObservedPart, int]]:
        """Return observation and age [steps] of the values in the policy's input, in its order."""

        def list_ages(count: int) -> Sequence[int]:
            return range(count) if self.newest_first else range(count)[::-1]

        parts = self.observations
        if self.history_order == "frames":
            return [(part, age) for age in list_ages(parts[0].history) for part in parts]
        return [(part, age) for part in parts for age in list_ages(part.history)]

    def make_terms(self) -> dict[str, Term]:
        """Return the formulas of the observations, in SI units: the policy's network contains the scales."""
        terms: dict[str, Term] = {}
        for part in self.measured_parts:
            term = self._make_term(part)
            if term is not None:
                terms[part.kind] = term
        return terms

    def _make_term(self, part: ObservedPart) -> Term | None:
        if part.kind == "gravity":
            return Gravity(ORIENTATION)
        if part.kind == "euler":
            return Euler(ORIENTATION)
        if part.kind == "last_action":
            return LastAction()
        if part.kind == "phase":
            return PhaseClock(part.period_s or math.nan, part.offsets)
        offset: _Numbers = ()
        if part.kind in RELATIVE and part.relative:
            offset = self.default_positions
        if part.shift != 0.0:
            shifted = np.subtract(offset or 0.0, part.shift)
            offset = tuple(np.atleast_1d(shifted).tolist())
        clip = part.clip or ()
        if not offset and not clip:
            return None
        return Scaled(part.kind, offset=offset, clip=clip)

    def dump(self) -> dict[str, Any]:
        """Return it as plain data, without what is the default."""
        content: dict[str, Any] = self.model_dump(mode="json", exclude_defaults=True)
        return content
