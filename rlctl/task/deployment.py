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
ORIENTATION = "orientation"  # the quantity from which gravity and Euler angles are computed
MOTION = ("motion", "anchor_orientation")
"""What is observed of a clip: joint positions and velocities, and the orientation of the link `anchor`."""
_Number = Annotated[float, pydantic.AllowInfNan(False)]
_Numbers = tuple[_Number, ...]
_Factor = _Number | _Numbers
_LONGEST = 1000  # values of a history


class ObservedPart(pydantic.BaseModel, extra="forbid", frozen=True):
    """A part of what a policy observes: `scale` times a quantity within `clip`, in the robot's own frame."""

    kind: Kind
    scale: _Factor = 1.0  # one factor, or one per element; 0 for elements that the policy gets as 0
    clip: tuple[_Number, _Number] | None = None  # of the value before `scale`, in SI units
    history: int = pydantic.Field(1, ge=1, le=_LONGEST)  # number of last values
    frame: Literal["body", "world"] = "body"  # of the vectors gyroscope and velocity
    relative: bool = True  # joint positions are from the default positions
    period_s: float | None = pydantic.Field(None, gt=0)  # of `phase`
    offsets: _Numbers = (0.0,)  # of `phase`, in parts of the period: one per leg, for example
    cosines_first: bool = False  # `phase` is the cosines of all offsets, then the sines


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
    anchor: str = ""  # link whose orientation a clip has; empty: the base

    @pydantic.model_validator(mode="after")
    def _check(self) -> Self:
        count = len(self.joints)
        for name in ("default_positions", "action_scale", "stiffness", "damping"):
            if len(getattr(self, name)) != count:
                raise ValueError(f"{name} has {len(getattr(self, name))} numbers for {count} joints")
        for name in ("max_torque", "armature"):
            if len(getattr(self, name)) not in (0, count):
                raise ValueError(f"{name} has {len(getattr(self, name))} numbers for {count} joints")
        for bound in self.action_clip:
            if isinstance(bound, tuple) and len(bound) != count:
                raise ValueError(f"action_clip has {len(bound)} numbers for {count} joints")
        for name in ("stiffness", "damping", "max_torque", "armature"):
            if min(getattr(self, name), default=0.0) < 0:
                raise ValueError(f"{name} has a negative number")
        if len(set(self.joints)) < count:
            raise ValueError("joints has a name twice")
        if unknown := sorted(set(self.wheels) - set(self.joints)):
            raise ValueError(f"wheels has {unknown[0]!r}, which is not in joints")
        if unknown := [name for name in self.commands if name not in COMMANDS]:
            raise ValueError(f"commands has {unknown[0]!r}; it may have {', '.join(COMMANDS)}")
        kinds = [part.kind for part in self.observations]
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
        if part.clip is not None and part.kind not in ("gyroscope", "velocity", "joint_positions", "joint_velocities"):
            raise ValueError(f"observation {part.kind!r} cannot be clipped")

    def find_size(self, part: ObservedPart) -> int:
        """Return the number of elements of one value of an observation."""
        if part.kind in ("joint_positions", "joint_velocities", "last_action"):
            return len(self.joints)
        if part.kind == "motion":
            return 2 * len(self.joints)
        if part.kind == "anchor_orientation":
            return 6
        if part.kind == "phase":
            return 2 * len(part.offsets)
        return 3

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
        return {part.kind: part.history for part in self.observations if part.history > 1}

    @property
    def layout(self) -> Layout:
        """Where rlctl observes the parts: all values of a part together, the oldest first."""
        sizes: dict[str, int] = {part.kind: self.find_size(part) * part.history for part in self.observations}
        return Layout(sizes, self.history)

    def find_columns(self) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Return of each element of the policy's input which element of `layout` it is, and times which factor."""
        places = {part.name: part for part in self.layout.parts}
        columns: dict[tuple[str, int], NDArray[np.int64]] = {}
        factors: dict[str, NDArray[np.float64]] = {}
        for part in self.observations:
            size, place = self.find_size(part), places[part.kind]
            order = np.arange(size)
            if part.cosines_first:
                order = np.roll(order, size // 2)
            for age in range(part.history):
                columns[part.kind, age] = place.start + (part.history - 1 - age) * size + order
            factors[part.kind] = np.broadcast_to(np.asarray(part.scale, float), size)
        blocks = self._list_blocks()
        return (
            np.concatenate([columns[block] for block in blocks]),
            np.concatenate([factors[kind] for kind, _ in blocks]),
        )

    def _list_blocks(self) -> list[tuple[str, int]]:
        """Return kind and age [steps] of the values in the policy's input, in its order."""

        def list_ages(count: int) -> Sequence[int]:
            return range(count) if self.newest_first else range(count)[::-1]

        parts = self.observations
        if self.history_order == "frames":
            return [(part.kind, age) for age in list_ages(parts[0].history) for part in parts]
        return [(part.kind, age) for part in parts for age in list_ages(part.history)]

    def make_terms(self) -> dict[str, Term]:
        """Return the formulas of the observations, in SI units: the policy's network contains the scales."""
        terms: dict[str, Term] = {}
        for part in self.observations:
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
        offset = self.default_positions if part.kind == "joint_positions" and part.relative else ()
        clip = part.clip or ()
        if not offset and not clip:
            return None
        return Scaled(part.kind, offset=offset, clip=clip)

    def dump(self) -> dict[str, Any]:
        """Return it as plain data, without what is the default."""
        content: dict[str, Any] = self.model_dump(mode="json", exclude_defaults=True)
        return content
