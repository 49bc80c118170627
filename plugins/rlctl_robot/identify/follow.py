"""The unknown values of a task's world; plays a log's actions with them and compares the joint states."""

import dataclasses
import math
from collections.abc import Collection, Mapping
from typing import Any

import numpy as np

from rlctl.environments.spec import EnvSpec
from rlctl.errors import TaskError, UsageError, check_name
from rlctl.task.env import TaskEnv
from rlctl.task.events import Event, EventSettings, delay, set_color, shift_gravity
from rlctl.task.events.event import Widening
from rlctl_robot.identify.log import Array, Expected, Log
from rlctl_robot.identify.targets import lead_targets, remembers_targets

WINDOW_S = 1.0
"""The joints return to the measured state after this time [s], so that small errors do not accumulate."""
_SMOOTHING_ROWS = 9  # rows of the smoothing filter for start states
_COMPARED_ROWS = 200  # rows at least, to compare smoothed with measured start states
_WIDER = 2.0  # factor by which the search range is wider than the event's range
_SMALLEST = 0.01  # of the upper end, where a range begins at 0


@dataclasses.dataclass(frozen=True)
class Parameter:
    """A value of an event, searched between `low` and `high`; on a logarithmic scale if both are above 0."""

    event: str
    key: str
    low: float
    high: float
    nominal: float | None = None  # value in the world as the task builds it, if known

    @property
    def name(self) -> str:
        """The name in reports: EVENT.KEY."""
        return f"{self.event}.{self.key}"

    @property
    def is_logarithmic(self) -> bool:
        """Whether the search scale is logarithmic."""
        return self.low > 0

    def value(self, position: float) -> float:
        """Return the value at a position in [0, 1] of the range."""
        change = position * self.relative_span
        return self.low * math.exp(change) if self.is_logarithmic else self.low + change

    @property
    def first(self) -> float:
        """The position to try first: that of the nominal value, or the middle."""
        if self.nominal is None or not self.low <= self.nominal <= self.high:
            return 0.5
        change = math.log(self.nominal / self.low) if self.is_logarithmic else self.nominal - self.low
        return change / self.relative_span

    @property
    def relative_span(self) -> float:
        """Width of the range: of the value's logarithm, or in its own unit."""
        return math.log(self.high / self.low) if self.is_logarithmic else self.high - self.low


@dataclasses.dataclass(frozen=True)
class Unknowns:
    """The values to estimate."""

    parameters: tuple[Parameter, ...]
    delay: str = ""  # the event that delays actions; empty if there is none, or it was not chosen
    longest_delay: int = 0  # [control steps]

    def settings(self, positions: Collection[float]) -> dict[str, dict[str, float]]:
        """Return positions in the ranges as a recipe's `events`."""
        settings: dict[str, dict[str, float]] = {}
        for parameter, position in zip(self.parameters, positions, strict=True):
            settings.setdefault(parameter.event, {})[parameter.key] = parameter.value(position)
        return settings


def find_unknowns(events: Mapping[str, Event], chosen: Collection[str], task: str) -> Unknowns:
    """Return what to estimate of all events, or the chosen ones; raises `UsageError` if that is nothing."""
    for name in chosen:
        check_name(name, events, f"--event: {task} has no event", UsageError)
    parameters: list[Parameter] = []
    delayed, longest = "", 0
    for name, event in events.items():
        ranges = {key: value.end for key, value in event.bind(name).values.items() if isinstance(value, Widening)}
        is_delay = event.when == "action" and event.function is delay
        possible = is_delay or (event.when == "reset" and event.function not in (set_color, shift_gravity) and ranges)
        if name in chosen and not possible:
            raise UsageError(
                f"--event: {name} has no physical value that holds for an episode; identify estimates events at "
                "'reset' and the delay of actions"
            )
        if not possible or (chosen and name not in chosen):
            continue
        if is_delay:
            delayed, longest = name, max(5, 2 * int(ranges["steps"][1]))
        else:
            parameters += [_make_parameter(name, key, *values, event.nominal(key)) for key, values in ranges.items()]
    if not parameters and not delayed:
        raise UsageError(f"{task} has no event with a physical value to estimate: see rlctl tasks show {task}")
    return Unknowns(tuple(parameters), delayed, longest)


def _make_parameter(event: str, key: str, low: float, high: float, nominal: float | None) -> Parameter:
    if low < 0:
        middle, half = (low + high) / 2, _WIDER * max((high - low) / 2, 1e-6)
        return Parameter(event, key, middle - half, middle + half, nominal)
    if low == 0 and nominal is None:  # such as damping, which is most likely 0
        nominal = _SMALLEST * max(high, 1e-6)
    low = low / _WIDER if low > 0 else _SMALLEST * max(high, 1e-6)
    return Parameter(event, key, low, _WIDER * max(high, low), nominal)


def open_world(spec: EnvSpec) -> TaskEnv:
    """Build a task's environment; raises `UsageError` for an environment that is not a task of rlctl."""
    env = spec.make().unwrapped
    if not isinstance(env, TaskEnv):
        env.close()
        raise UsageError(f"{spec.task} is a plain Gymnasium environment: only tasks of rlctl have events to identify")
    if not hasattr(env.action_space, "low"):
        env.close()
        raise UsageError(f"{spec.task}: identify is for actions in a Box, not {env.action_space}")
    return env


def find_joints(env: TaskEnv) -> dict[str, tuple[Any, int]]:
    """Return the joints of the world by name: the body and the index in its joint arrays."""
    joints: dict[str, tuple[Any, int]] = {}
    for body in env.sim.bodies.values():
        for index, joint in enumerate(body.joint_names):
            joints.setdefault(joint, (body, index))
    return joints


def describe_expected(env: TaskEnv, task: str) -> Expected:
    """Return what a log of this task must contain; raises `UsageError` if no fixed body has joints."""
    joints = find_joints(env)
    described = env.task.describe_joints()
    driven = tuple(described.names) if described else ()
    if not any(body.fixed for body, _ in joints.values()):
        raise UsageError(
            f"{task}: no body with a fixed base has joints, and a log of joints does not contain the position of a "
            "free base; hang the robot in a frame to record the log, and give a task that loads it with fixed=True"
        )
    limits = {name: (float(body.joint_low[i]), float(body.joint_high[i])) for name, (body, i) in joints.items()}
    actions = int(np.prod(env.action_space.shape or ()))
    return Expected(limits, driven, actions, env.task.control_dt, remembers_targets(env))


class Follower:
    """Simulates a log; `compare` returns the errors for given values of the unknowns."""

    def __init__(self, env: TaskEnv, log: Log, unknowns: Unknowns) -> None:
        from scipy.signal import savgol_filter

        self.unknowns = unknowns
        self._env = env
        self._joints = [find_joints(env)[name] for name in log.joints]
        self._bodies = {body.name: body for body, _ in self._joints}
        steps = max(10, round(WINDOW_S / env.task.control_dt))
        self.starts = list(range(0, len(log.actions) - 2, steps))  # first row of each window
        self.steps = steps
        self.control_dt = env.task.control_dt
        self._measured = np.concatenate([log.positions, log.velocities], axis=1)
        shape = env.action_space.shape or ()
        self._actions = log.actions.reshape(-1, *shape)
        low, high = env.action_space.low, env.action_space.high  # type: ignore[attr-defined]
        self._resting = np.clip(np.zeros(shape), low, high)
        self._dtype = env.action_space.dtype
        self._targets = log.targets
        rows = min(_SMOOTHING_ROWS, len(log.actions) // 2 * 2 - 1)
        self._begin = self._choose_begin(savgol_filter(self._measured, rows, 2, axis=0))

    @property
    def spread(self) -> Array:
        """Standard deviation of each measured position and velocity, shape (2 * joints,)."""
        return np.maximum(self._measured.std(axis=0), 1e-9)

    @property
    def motion(self) -> Array:
        """Measured positions and velocities minus those at their window's start, shape as of `compare`."""
        begins = self._measured[np.repeat(self.starts, self.steps)[: len(self._measured) - 1]]
        return np.asarray(self._measured[1:] - begins)

    def compare(self, positions: Array | None, delay: int) -> Array:
        """Return simulated minus measured positions and velocities of all rows but the first, (rows - 1, 2 * joints).

        `positions` are the unknowns' positions in their ranges, in [0, 1]; None is the world as the task builds it.
        """
        changes = {} if positions is None else self.unknowns.settings(positions.tolist())
        self._env.set_events(EventSettings(False, changes))
        return self._play(self.starts, delay) - self._measured[1:]

    def _choose_begin(self, smoothed: Array) -> Array:
        """Return the start states: each column smoothed, or measured where that predicts the next row better."""
        # Smoothing removes noise, but also the peaks of a joint under a quickly changing torque.
        self._env.set_events(EventSettings(False, {}))
        starts = range(0, len(self._actions) - 1, max(1, len(self._actions) // _COMPARED_ROWS))
        errors = []
        for begin in (self._measured, smoothed):
            self._begin = begin
            after = self._play(starts, 0)[starts] - self._measured[1:][starts]
            errors.append(np.square(after).sum(axis=0))
        return np.where(errors[0] < errors[1], self._measured, smoothed)

    def _play(self, starts: Collection[int], delay: int) -> Array:
        """Return the simulated states of all rows but the first; the joints return to the measured ones at `starts`."""
        # One episode for all windows: only the actions since its start tell where targets, filters and clocks are.
        env = self._env
        env.reset(seed=0)
        played = np.empty((len(self._actions) - 1, self._measured.shape[1]))
        for row in range(len(played)):
            if row in starts:
                self._set_joints(row)
                if self._targets is not None and row < len(self._targets):
                    lead_targets(env, self._targets[row])
            action = self._actions[row - delay] if row >= delay else self._resting
            env.act(action.astype(self._dtype))
            env.sim.step()
            played[row] = self._read()
        if not np.isfinite(played).all():
            raise TaskError("the simulation of the log is not finite")
        return played

    def _set_joints(self, row: int) -> None:
        for body in self._bodies.values():
            angles, speeds = body.joint_positions.copy(), body.joint_velocities.copy()
            for column, (owner, index) in enumerate(self._joints):
                if owner is body:
                    angles[index], speeds[index] = self._begin[row, column :: len(self._joints)]
            body.set_joints(angles, speeds)

    def _read(self) -> list[float]:
        states = {name: (body.joint_positions, body.joint_velocities) for name, body in self._bodies.items()}
        return [float(states[body.name][kind][index]) for kind in (0, 1) for body, index in self._joints]
