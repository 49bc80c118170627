"""Whether the simulation, step by step from the logged states, moves as a log says: exchanged joints show there.

A driver that exchanges two joints does so in their angles, speeds and commands. Each joint still follows its command,
so a log differs from a sound one only in what depends on where joints are mounted: how the trunk turns, and where feet
touch the ground. `Physics` sets the simulation to each logged state, applies the logged action, and compares the next
row. What the log does not hold, the trunk's height and velocity, is that of the simulation, where contacts correct it.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from rlctl import output
from rlctl.environments.info import EnvInfo
from rlctl.environments.spec import EnvSpec
from rlctl.task.body import Body
from rlctl.task.events import EventSettings
from rlctl.task.rotations import multiply, rotate, rotate_inverse
from rlctl.task.worlds import TaskWorlds
from rlctl_robot.diagnose.candidates import TermStatistics, find_stance, is_of_joints
from rlctl_robot.diagnose.relations import compute_losses
from rlctl_robot.diagnose.signals import ACTIONS, Array, LoggedSignals

_WORLDS = 64  # that are simulated together
_SETTLING = 12  # rows until the trunk's height and velocity are about right
_DOWN = (0.0, 0.0, -1.0)
_SMALLEST_ERROR = 0.02  # of an element's standard deviation
_WIDER = 1.5  # errors are counted in units of so many usual errors
_FARTHEST = 40.0  # standard deviations from the usual value, to which a logged state is clipped
_MOST_ERROR = 0.5  # usual error of a task that can be simulated from what is logged, in standard deviations
_BLOCK = 10  # rows after which errors are nearly independent
_SOUND_ROWS = 40  # of each sound episode whose errors are the usual ones


@dataclasses.dataclass(frozen=True)
class _StateTerms:
    """The observations that hold the state of a robot with a free base."""

    positions: str  # angles of the joints, or their differences from `pose`
    velocities: str
    gravity: str  # its direction, in the frame of the trunk
    gyroscope: str  # in the frame of the trunk
    pose: Array


class Physics:
    """Simulates logs of one task from row to row, many at a time."""

    def __init__(self, spec: EnvSpec, terms: _StateTerms, sizes: Mapping[str, int]) -> None:
        worlds = spec.make_worlds(_WORLDS)
        assert isinstance(worlds, TaskWorlds)
        self._worlds, self._terms = worlds, terms
        self._body = _find_body(worlds)
        box: Any = worlds.action_space
        self._low, self._high = box.low, box.high
        worlds.set_events(EventSettings(False, {}))
        self._slices = LoggedSignals(np.zeros((0, 0)), np.zeros((0, 0)), (), dict(sizes)).slices
        names = (terms.positions, terms.velocities, terms.gravity, terms.gyroscope)
        self._compared = np.concatenate([np.r_[self._slices[name]] for name in names])
        self._scale = np.ones(len(self._compared))
        self._lowest: Array | float = -np.inf
        self._highest: Array | float = np.inf
        self.usual_loss = 0.0
        """The largest mean loss of an episode of a sound robot in simulation."""

    def close(self) -> None:
        """Close the worlds."""
        self._worlds.close()

    def calibrate(self, sound: LoggedSignals, std: Array) -> bool:
        """Learn the usual errors from a sound robot's log; return whether the simulation follows it at all."""
        starts = [start for start, length in zip(sound.starts, sound.lengths, strict=True) if length >= _SOUND_ROWS]
        if not starts:
            return False
        errors = self._simulate([(sound, start) for start in starts], _SOUND_ROWS)
        usual = np.sqrt(np.square(errors).mean(axis=(0, 1)))
        # In a wrong unit a state could be one that no simulation survives.
        middle, reach = sound.observations.mean(axis=0), _FARTHEST * std
        self._lowest, self._highest = middle - reach, middle + reach
        deviations = std[self._compared]
        self._scale = _WIDER * np.maximum(usual, _SMALLEST_ERROR * deviations)
        self.usual_loss = float(compute_losses(errors / self._scale).mean(axis=(1, 2)).max())
        return bool(np.median(usual / deviations) < _MOST_ERROR)

    def compute_losses(self, logs: Sequence[LoggedSignals], starts: Sequence[int], rows: int) -> Array:
        """Return the losses of logs in parts of so many rows, shape (logs, blocks of rows); lower is more plausible.

        Each part begins at a row of `starts`; its first rows are not judged.
        """
        errors = self._simulate([(log, start) for log in logs for start in starts], rows)
        losses = compute_losses(errors / self._scale).mean(axis=2)
        count = losses.shape[1] // _BLOCK
        blocks = losses[:, : count * _BLOCK].reshape(len(logs), len(starts), count, _BLOCK).mean(axis=3)
        return np.reshape(blocks, (len(logs), -1))

    def choose_starts(self, log: LoggedSignals, rows: int, most: int) -> list[int]:
        """Return first rows of parts of so many rows, spread over the log."""
        found = [
            first
            for start, length in zip(log.starts, log.lengths, strict=True)
            for first in range(start, start + length - rows + 1, rows - _SETTLING)
        ]
        if len(found) <= most:
            return found
        chosen = np.linspace(0, len(found) - 1, most).astype(int)
        return [found[index] for index in chosen]

    def _simulate(self, parts: Sequence[tuple[LoggedSignals, int]], rows: int) -> Array:
        """Return the errors of the predictions, shape (parts, rows - settling - 1, compared elements)."""
        found = []
        with output.show_progress("simulating parts of the log", len(parts), "parts") as show:
            for begin in range(0, len(parts), _WORLDS):
                show(begin)
                some = [*parts[begin : begin + _WORLDS]]
                count = len(some)
                some += [some[-1]] * (_WORLDS - count)
                observations = np.stack([log.observations[start : start + rows] for log, start in some], axis=1)
                actions = np.stack([log.actions[start : start + rows] for log, start in some], axis=1)
                found.append(self._follow(observations, np.clip(actions, self._low, self._high))[:count])
        return np.concatenate(found)

    def _follow(self, observations: Array, actions: Array) -> Array:
        """Return the errors for logs of shape (rows, worlds, elements)."""
        self._worlds.reset(np.arange(_WORLDS), [0] * _WORLDS)
        errors = []
        for row in range(len(observations) - 1):
            self._set_state(observations[row])
            seen: Any = self._worlds.step(actions[row].astype(np.float32)).observation  # no log is of a Dict
            if row >= _SETTLING:
                errors.append(seen[:, self._compared] - observations[row + 1][:, self._compared])
        return np.nan_to_num(np.stack(errors, axis=1), nan=1e3, posinf=1e3, neginf=-1e3)

    def _set_state(self, observed: Array) -> None:
        """Set the measured part of the state; height, heading and velocity of the trunk stay."""
        terms, body = self._terms, self._body
        observed = np.clip(observed, self._lowest, self._highest)
        place, velocity = np.array(body.base_position), np.array(body.base_velocity)
        orientation = _tilt(np.array(body.base_orientation), observed[:, self._slices[terms.gravity]])
        turning = rotate(orientation, observed[:, self._slices[terms.gyroscope]])
        body.set_base(place, orientation, velocity=velocity, angular_velocity=turning)
        angles = observed[:, self._slices[terms.positions]] + terms.pose
        body.set_joints(angles, observed[:, self._slices[terms.velocities]])


def make_physics(
    spec: EnvSpec, info: EnvInfo, statistics: Mapping[str, TermStatistics], sound: LoggedSignals
) -> Physics | None:
    """Return the simulation of a task's logs; None for tasks whose state the observations do not hold.

    These are now the tasks in many worlds (`BatchTask`) of robots with a free base that observe `gravity` and
    `gyroscope` in the frame of the trunk: one after the other, hundreds of explanations would take minutes.
    """
    terms = _find_state(info, statistics)
    if terms is None or not spec.is_batch or spec.has_wrappers:
        return None
    physics = Physics(spec, terms, sound.sizes)
    std = np.concatenate([statistics[name].std for name in sound.sizes])
    is_reliable = False
    try:
        is_reliable = physics.calibrate(sound, std)
    finally:
        if not is_reliable:
            physics.close()
    return physics if is_reliable else None


def _find_state(info: EnvInfo, statistics: Mapping[str, TermStatistics]) -> _StateTerms | None:
    joints = info.joints
    if joints is None or len(joints.names) != len(statistics[ACTIONS].mean):
        return None
    of_joints = [name for name in statistics if is_of_joints(name, statistics[name], info)]
    positions = [name for name in of_joints if name == joints.measured]
    velocities = [name for name in of_joints if info.observation_units.get(name) in ("rad/s", "m/s")]
    vectors = [name for name, values in statistics.items() if len(values.mean) == 3]
    if not positions or not velocities or "gravity" not in vectors or "gyroscope" not in vectors:
        return None
    stance = find_stance(positions[0], statistics[positions[0]], info)
    pose = np.zeros(len(joints.names)) if stance is None else stance[0]
    return _StateTerms(positions[0], velocities[0], "gravity", "gyroscope", pose)


def _find_body(worlds: TaskWorlds) -> Body:
    """Return the body that has most joints: the robot."""
    bodies: Mapping[str, Body] = worlds.sim.bodies
    return max(bodies.values(), key=lambda body: np.shape(body.joint_positions)[-1])


def _tilt(orientation: Array, gravity: Array) -> Array:
    """Return orientations with the same heading in which gravity has a direction, shapes (n, 4) and (n, 3)."""
    given = rotate_inverse(orientation, _DOWN)
    length = np.maximum(np.linalg.norm(gravity, axis=1, keepdims=True), 1e-6)
    wanted = gravity / length
    # The shortest rotation from `wanted` to `given`, in the frame of the trunk.
    cosine = (wanted * given).sum(axis=1, keepdims=True)
    turn = np.concatenate([np.cross(wanted, given), np.maximum(1.0 + cosine, 1e-6)], axis=1)
    tilted = multiply(orientation, turn / np.linalg.norm(turn, axis=1, keepdims=True))
    return np.asarray(tilted / np.linalg.norm(tilted, axis=1, keepdims=True))
