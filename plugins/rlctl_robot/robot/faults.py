"""Faults of a simulated robot: late and lost messages, sensors that freeze or fail, a joint that does not move."""

import dataclasses
import math
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlctl.environments.info import EnvInfo
from rlctl.environments.spec import EnvSpec
from rlctl.errors import UsageError, check_name, did_you_mean
from rlctl.task.env import TaskEnv
from rlctl.task.events import Event, EventSettings, lock_joints

_NUMBERS = {"delay": "delay_s", "jitter": "jitter_s", "drop": "drop"}
_NAMES = ("frozen", "nan", "stuck")
_UNKNOWN_LENGTH = 100  # steps, of an episode without a time limit
_STREAM = 6  # spawn key of the faults' random numbers


@dataclasses.dataclass(frozen=True)
class Faults:
    """The faults that act together in each episode."""

    text: str = ""  # as the user wrote them; empty: none
    delay_s: float = 0.0  # of a measurement on its way to the program, and so of its command [s]
    jitter_s: float = 0.0  # largest further delay, drawn for each measurement [s]
    drop: float = 0.0  # probability that an observation is lost, and that a command is
    frozen: tuple[str, ...] = ()  # observations that no longer change, from a random step on
    nan: tuple[str, ...] = ()  # observations that are not a number, from a random step on
    stuck: tuple[str, ...] = ()  # joints that stay where an episode begins

    def check(self, names: Iterable[str], control_dt: float | None) -> None:
        """Raise `UsageError` for a sensor that the robot does not have, or a delay without a `control_dt`."""
        for name in (*self.frozen, *self.nan):
            check_name(name, names, f"--fault {self.text}: no observation", UsageError, listed="There is")
        if (self.delay_s or self.jitter_s) and control_dt is None:
            raise UsageError(f"--fault {self.text}: this task has no control_dt, so its steps take no known time")


def parse_faults(text: str) -> Faults:
    """Read `delay=0.02,frozen=joint_velocities`; raises `UsageError` for an unknown kind or a wrong value."""
    values: dict[str, Any] = {name: [] for name in _NAMES}
    for part in text.split(","):
        kind, _, value = part.strip().partition("=")
        if kind not in (*_NUMBERS, *_NAMES) or not value:
            known = ", ".join(f"{name}=" for name in (*_NUMBERS, *_NAMES))
            close = did_you_mean(kind, (*_NUMBERS, *_NAMES))
            raise UsageError(f"--fault {text}: {part.strip()!r} is not a fault.{close} Known: {known}")
        if kind in _NAMES:
            values[kind].append(value)
        else:
            values[_NUMBERS[kind]] = _read_number(text, kind, value)
    return Faults(text=text, **(values | {name: tuple(values[name]) for name in _NAMES}))


def _read_number(text: str, kind: str, value: str) -> float:
    try:
        number = float(value)
    except ValueError:
        number = math.nan
    highest = 1.0 if kind == "drop" else 60.0
    if not 0.0 <= number <= highest:
        what = "a share from 0 to 1" if kind == "drop" else "a time from 0 to 60 [s]"
        raise UsageError(f"--fault {text}: {kind} is {value!r}; give {what}")
    return number


def set_stuck_joints(env: Any, spec: EnvSpec, joints: tuple[str, ...]) -> None:
    """Let joints of a task's environment stay where each episode begins; the others move again.

    Raises `UsageError` for a joint that it does not have.
    """
    inner = env.unwrapped
    if not isinstance(inner, TaskEnv):
        if joints:
            raise UsageError(f"--fault stuck: {spec.task} is a plain Gymnasium environment; only tasks have joints")
        return
    bodies = {joint: name for name, body in inner.sim.bodies.items() for joint in body.joint_names}
    added = {}
    for joint in joints:
        check_name(joint, bodies, "--fault stuck: no joint", UsageError, listed="There is")
        added[f"stuck {joint}"] = Event("start", lock_joints, enabled=True, body=bodies[joint], joints=[joint])
    inner.set_events(EventSettings(spec.randomize, spec.events), added)


class EpisodeFaults:
    """The faults of one episode; what is random in them depends on its seed alone."""

    def __init__(self, faults: Faults, seed: int, info: EnvInfo) -> None:
        self._faults = faults
        self._rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(_STREAM,)))
        names = [*faults.frozen, *faults.nan]
        steps = info.max_steps or _UNKNOWN_LENGTH
        self._begin = {name: int(self._rng.integers(steps)) for name in names}
        self._last: dict[str, NDArray[Any]] = {}  # the values of frozen sensors

    def draw(self) -> tuple[bool, bool, float]:
        """Return whether a step's observation is lost, whether its command is, and how late it is [s]."""
        lost, command_lost, late = self._rng.random(3).tolist()
        faults = self._faults
        return lost < faults.drop, command_lost < faults.drop, faults.delay_s + late * faults.jitter_s

    def disturb(self, parts: Mapping[str, NDArray[Any]], step: int) -> dict[str, NDArray[Any]]:
        """Return what the sensors measure in a step."""
        measured = dict(parts)
        for name in self._faults.frozen:
            if step >= self._begin[name]:
                measured[name] = self._last.setdefault(name, parts[name].copy())
        for name in self._faults.nan:
            if step >= self._begin[name]:
                measured[name] = np.full(parts[name].shape, np.nan, np.result_type(parts[name], np.float32))
        return measured
