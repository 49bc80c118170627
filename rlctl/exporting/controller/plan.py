"""What a controller takes, computes and returns: quantities, terms, histories and joint targets of one environment."""

import dataclasses
import functools
import math
import re
from collections.abc import Iterable, Mapping
from typing import Any, Literal

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from rlctl.environments.dict_spaces import SINGLE, split, split_space
from rlctl.environments.info import AnyTerm, EnvInfo, space_to_json
from rlctl.errors import RecipeError, UsageError
from rlctl.limits.fitting import FittedLimits
from rlctl.policy.c_policy import observation_type
from rlctl.task.joints import CommandKind
from rlctl.task.layout import Layout, Part
from rlctl.task.terms import ClipOrientation, Gravity, Internal, Playback, Scaled

_UNITS = {
    "position": "rad or m",
    "step": "rad or m",
    "correction": "rad or m",
    "speed": "rad/s or m/s",
    "torque": "N m or N",
}
Clips = Literal["", "exact", "towards"]
_KEYWORDS = set(
    re.findall(
        r"\w+",
        "auto break case char const continue default do double else enum extern float for goto if inline int long "
        "register restrict return short signed sizeof static struct switch typedef union unsigned void volatile while "
        "bool catch class delete explicit export false friend mutable namespace new operator private protected public "
        "template this throw true try typename using virtual and or not xor",
    )
)


@dataclasses.dataclass(frozen=True)
class Quantity:
    """A named input: what the robot measures."""

    name: str
    size: int
    start: int  # of all inputs, one after the other
    unit: str  # empty if unknown
    identifier: str  # its name in C


@dataclasses.dataclass(frozen=True)
class Observed(Part):
    """A named part of the policy's observation."""

    key: str  # of the part of a Dict space
    term: AnyTerm | None


@dataclasses.dataclass(frozen=True, eq=False)
class JointTarget:
    """What an action commands: `base + factor * action`."""

    kind: CommandKind
    factor: NDArray[np.float64]
    default: NDArray[np.float64]  # of positions; zeros for the other kinds
    measured: int  # where the inputs have the joints' positions, for steps
    input: str  # name of that input
    clips: Clips
    """Whether a position is clipped to the joints' range; `towards`: a joint outside it is not sent back at once."""
    low: NDArray[np.float64]
    high: NDArray[np.float64]
    tracks: bool = False  # whether limits bound the targets themselves, from one to the next
    joint_unit: str = ""  # of the measured positions of all joints: `rad`, `m`, or another word where it is unknown
    playback: Playback | None = None  # the clip whose rows are corrected
    control_dt: float = 0.0  # [s]

    @property
    def unit(self) -> str:
        """Unit, for people; one where it is known whether all joints turn or all slide."""
        of_turning, of_sliding = _UNITS[self.kind].split(" or ")
        known = {"rad": of_turning, "m": of_sliding}
        return known.get(self.joint_unit, _UNITS[self.kind])

    @property
    def interface(self) -> str:
        """What it commands, as ros2_control calls it."""
        return {"speed": "velocity", "torque": "effort"}.get(self.kind, "position")

    def find_targets(
        self, inputs: Mapping[str, NDArray[Any]], action: NDArray[Any], step: int = 0
    ) -> NDArray[np.float64]:
        """Return the joints' targets for an action in a step of the episode, and what was measured before it."""
        base = self._find_base(inputs, step)
        targets = np.asarray(base + self.factor * action.ravel(), np.float64)
        if not self.clips:
            return targets
        low, high = self.low, self.high
        if self.clips == "towards":
            low, high = np.minimum(low, base), np.maximum(high, base)
        return np.clip(targets, low, high)

    def find_action(
        self, inputs: Mapping[str, NDArray[Any]], targets: NDArray[Any], step: int = 0
    ) -> NDArray[np.float64]:
        """Return the action with which joints that are where `inputs` has them go to targets; it has no bounds."""
        return np.asarray((targets.ravel() - self._find_base(inputs, step)) / self.factor, np.float64)

    def _find_base(self, inputs: Mapping[str, NDArray[Any]], step: int) -> NDArray[Any]:
        if self.playback is not None:
            time = inputs[self.playback.time] if self.playback.time else np.array([step * self.control_dt])
            return self.playback(time)
        if self.kind != "step":
            return self.default
        values = np.concatenate([np.ravel(value) for value in inputs.values()])
        return np.asarray(values[self.measured : self.measured + len(self.factor)])

    @property
    def formula(self) -> str:
        """How it follows from the action, for people."""
        bases = {"position": "default_positions + ", "step": f"{self.input} + ", "correction": f"{self.input} + "}
        base = bases.get(self.kind, "")
        clipped = "" if not self.clips else ", within target_low and target_high"
        clipped = ", which the limits bound from one target to the next" if self.tracks else clipped
        kind = "position" if self.kind in ("step", "correction") else self.kind
        return f"joint {kind} [{self.unit}] = {base}target_factor * action{clipped}"


class ControllerPlan:
    """What a controller takes, computes and returns; `frames` are the stacked observations of its policy.

    Raises `UsageError` for an environment that cannot have one.
    """

    def __init__(self, env: EnvInfo, frames: int = 1) -> None:
        self.env = env
        space, action_space = env.spaces()
        self.parts = split_space(space)
        if not isinstance(action_space, spaces.Box) or action_space.dtype.kind != "f" or len(action_space.shape) != 1:
            raise UsageError(f"--controller: actions must be a vector of real numbers, not {action_space}")
        if any(not isinstance(part, spaces.Box) or len(part.shape) != 1 for part in self.parts.values()):
            raise UsageError("--controller: observations must be vectors; images and choices are not supported")
        self.action_space, self.dtype = action_space, observation_type(env)
        self.action_size = math.prod(action_space.shape)
        self.repeats_first = env.history_start == "first"
        self.frames = frames
        layout = Layout(env.find_sizes(frames), env.observation_history)
        self.newest_size, self.size = layout.newest_size, layout.size * frames
        self.observed = [self._describe(part) for part in layout.parts]
        self.quantities = self._list_quantities()
        self.input_size = sum(quantity.size for quantity in self.quantities)
        if not self.quantities:
            raise UsageError("--controller: the policy observes nothing that a robot measures")

    def _describe(self, part: Part) -> Observed:
        key = part.name if part.name in self.parts else SINGLE
        return Observed(**vars(part), key=key, term=self.env.observation_terms.get(part.name))

    def _list_quantities(self) -> list[Quantity]:
        env, sizes = self.env, dict[str, int]()
        for part in self.observed:
            measured = {part.name: part.size}
            if part.term is not None:
                measured = {name: env.quantity_sizes[name] for name in part.term.inputs}
            for name, size in measured.items():
                if sizes.setdefault(name, size) != size:
                    raise UsageError(f"--controller: two quantities are named {name!r}, of different sizes")
        quaternions = {part.term.orientation for part in self.observed if isinstance(part.term, Gravity)}
        quantities: list[Quantity] = []
        for name, size in sizes.items():
            identifier = _make_identifier(name, {quantity.identifier for quantity in quantities})
            start = sum(quantity.size for quantity in quantities)
            unit = env.observation_units.get(name) or ("quaternion x, y, z, w" if name in quaternions else "")
            quantities.append(Quantity(name, size, start, unit, identifier))
        return quantities

    @property
    def stacks(self) -> list[Part]:
        """The histories and the other parts of the observation, in its order; empty if it has no history."""
        if self.frames > 1:
            return [Part("", self.newest_size, self.frames, start=0, newest=0)]
        if all(part.frames == 1 for part in self.observed):
            return []
        return [*self.observed]

    @property
    def internal(self) -> set[Internal]:
        """What terms need of the controller's own state."""
        return {part.term.internal for part in self.observed if part.term is not None} - {""}

    @property
    def inputs_info(self) -> EnvInfo:
        """The environment as limits see it: its observation are the quantities."""
        box = spaces.Box(-np.inf, np.inf, (self.input_size,), self.dtype.type)
        sizes = {quantity.name: quantity.size for quantity in self.quantities}
        units = {quantity.name: quantity.unit for quantity in self.quantities}
        no_terms: dict[str, Any] = {"observation_history": {}, "observation_terms": {}, "quantity_sizes": {}}
        changes = {"observation_space": space_to_json(box), "observation_sizes": sizes, "observation_units": units}
        return self.env.model_copy(update=changes | no_terms)

    def measure(self, observation: Any, terms: Mapping[str, Any]) -> dict[str, NDArray[Any]]:
        """Return the quantities behind an observation, in the order of the inputs.

        `terms` is what the terms were computed from: `TaskEnv.measured`.
        """
        flat = split(observation)
        values: dict[str, NDArray[Any]] = {}
        for part in self.observed:
            if part.term is None:
                source = np.ravel(flat[part.key])
                start = part.start if part.key == SINGLE else 0
                if self.frames > 1:
                    start = len(source) - self.newest_size + part.newest
                newest = start + part.size * (part.frames - 1)
                values[part.name] = source[newest : newest + part.size]
                continue
            measured = terms[part.name]
            quantities = measured if isinstance(measured, tuple) else (measured,)
            values |= {name: np.ravel(value) for name, value in zip(part.term.inputs, quantities, strict=False)}
        return {quantity.name: np.array(values[quantity.name]) for quantity in self.quantities}

    def find_quantity(self, name: str) -> Quantity:
        """Return an input by its name; raises `UsageError` if there is none."""
        for quantity in self.quantities:
            if quantity.name == name:
                return quantity
        raise UsageError(f"--controller: no input has the joints' positions: {name!r} is computed inside")

    @functools.cached_property
    def target(self) -> JointTarget | None:
        """What an action commands, without limits, if the task describes it."""
        return self.find_target(None)

    def find_target(self, fitted: FittedLimits | None) -> JointTarget | None:
        """Return what an action commands within limits, if the task describes it; without any it is `target`.

        Raises `RecipeError` for limits with other units than the task has.
        """
        joints = self.env.joints
        if joints is None or not joints.command[0]:
            return None
        kind, per_action = joints.command
        count, factor = len(per_action), np.array(per_action)
        default = np.array(
            joints.default_positions if kind == "position" and joints.default_positions else [0.0] * count
        )
        steps = None if fitted is None else fitted.steps
        if fitted is not None and (bounds := fitted.bounds) is not None and fitted.limits.command == kind:
            scale = (steps or bounds).factor / (bounds.dt if kind == "speed" else 1.0)
            if not (np.allclose(scale, factor) and np.allclose(bounds.offset, default)):
                raise RecipeError(f"limits: scale and offset differ from the task's {factor.tolist()}; leave them out")
        source = self.find_quantity(joints.measured) if kind == "step" else None
        measured, name = (0, "") if source is None else (source.start, source.identifier)
        playback = None
        if kind == "correction":
            playback, name = self._find_playback(joints.reference), joints.reference
        clips: Clips = ""
        if joints.clips_target:
            clips = "towards" if fitted is not None and kind == "step" else "exact"
        low, high = (np.array(ends or [0.0] * count) for ends in (joints.low, joints.high))
        unit = self.env.observation_units.get(joints.measured, "")
        return JointTarget(
            kind,
            factor,
            default,
            measured,
            name,
            clips,
            low,
            high,
            tracks=steps is not None,
            joint_unit=unit,
            playback=playback,
            control_dt=self.env.control_dt or 0.0,
        )

    def _find_playback(self, name: str) -> Playback:
        term = self.env.observation_terms.get(name)
        if not isinstance(term, Playback) or term.quantity:
            raise UsageError(f"--controller: reference: {name!r} is no Playback without a quantity")
        return term

    def describe_internal(self) -> list[str]:
        """Return what the controller computes from the inputs, for people."""
        computed = [f"{part.name} ({_describe_term(part.term)})" for part in self.observed if part.term]
        histories = [f"the last {part.frames} of {part.name}" for part in self.observed if part.frames > 1]
        stacked = [f"a stack of {self.frames} observations"] if self.frames > 1 else []
        return [*computed, *histories, *stacked]


def _describe_term(term: AnyTerm) -> str:
    if isinstance(term, Playback):
        rows = f"{len(term.table)} rows of a clip, at {term.time or 'the time of the episode'}"
        if isinstance(term, ClipOrientation):
            return f"rotation from {term.quantity} to {rows}"
        return f"{term.quantity} - {rows}" if term.quantity else rows
    if not isinstance(term, Scaled):
        return " ".join([term.kind.replace("_", " "), *(["of"] if term.inputs else []), ", ".join(term.inputs)]).strip()
    offset, scale = (", ".join(f"{number:.6g}" for number in numbers) for numbers in (term.offset, term.scale))
    shifted = f"{term.quantity} - [{offset}]" if offset else term.quantity
    return f"({shifted}) * [{scale}]" if scale else shifted


def _make_identifier(name: str, taken: Iterable[str]) -> str:
    plain = re.sub(r"\W", "_", name, flags=re.ASCII)
    if not re.match(r"[A-Za-z]", plain) or plain in _KEYWORDS:
        plain = f"input_{plain}"
    while plain in taken:
        plain += "_"
    return plain
