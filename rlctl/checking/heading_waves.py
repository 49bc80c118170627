"""How elements of the observation follow the heading of a robot that moves forwards.

An element in the frame of the robot is the same at all headings. One axis of a velocity in the frame of the world
follows the cosine of the heading, and a velocity that is turned by the heading in the wrong direction the cosine of
twice the heading. At rest both are nearly 0; what shows the heading, or a way to a goal, differs then too.
"""

import dataclasses

import numpy as np
from numpy.typing import NDArray

from rlctl.checking.experiments.turned import TurnedRobot

HEADINGS = (0.0, 1.3, 2.6, 3.9, 5.2)  # [rad]
SPEED, LIFT, SPIN = 0.5, 0.1, 0.5  # [m/s], [m], [rad/s]
SAME = 0.02  # part of an element's size, or of 1: friction differs a little with the direction
LEAST_PART = 0.15  # of the speed: what a place changes in a step is no velocity
WAVE_ERROR, RESTING = 0.1, 0.3  # parts of the amplitude
OWN = 0.5  # part of the speed that a velocity in the frame of the robot changes by
Numbers = NDArray[np.float64]


@dataclasses.dataclass(frozen=True, eq=False)
class HeadingWaves:
    """The observation of a robot at some headings: at rest, as it moves forwards, and as it rolls. Shape (headings,
    elements) each."""

    resting: Numbers
    moving: Numbers
    rolling: Numbers

    def list_changing(self) -> set[int]:
        """Return the elements that depend on the heading."""
        return _list(_change(self.resting) | _change(self.moving) | _change(self.rolling))

    def list_velocities(self, times: int) -> set[int]:
        """Return the elements that only a movement changes, by the cosine of so many times the heading."""
        is_wave, is_changed = np.True_, np.False_
        for rows in (self.moving, self.rolling):
            added = rows - self.resting  # a reset may draw small velocities, which turn too
            changes = (np.abs(added - added[0]) > self._allowed()).any(axis=0)
            is_wave, is_changed = is_wave & (self._is_wave(added, times) | ~changes), is_changed | changes
        return _list(np.asarray(is_wave & is_changed))

    def _allowed(self) -> Numbers:
        return SAME * np.maximum(1.0, np.abs(self.resting[0]))

    def _is_wave(self, added: Numbers, times: int) -> NDArray[np.bool_]:
        angles = times * np.array(HEADINGS)
        waves = np.column_stack([np.ones_like(angles), np.cos(angles), np.sin(angles)])
        factors = np.linalg.lstsq(waves, added, rcond=None)[0]
        size = np.hypot(*factors[1:])
        error = np.abs(added - waves @ factors).max(axis=0)
        at_rest = np.maximum(np.abs(factors[0]), np.ptp(self.resting, axis=0) / 2)
        return np.asarray((error < WAVE_ERROR * size) & (at_rest < RESTING * size) & (size > LEAST_PART * SPEED))

    def has_own_velocity(self) -> bool:
        """Say whether the speed is observed in the frame of the robot."""
        change = self.moving - self.resting
        return bool((~_change(self.moving) & (np.abs(change) > OWN * SPEED).all(axis=0)).any())


def _change(rows: Numbers) -> NDArray[np.bool_]:
    allowed = SAME * np.maximum(1.0, np.abs(rows[0]))
    return np.asarray((np.abs(rows - rows[0]) > allowed).any(axis=0))


def _list(flags: NDArray[np.bool_]) -> set[int]:
    return set(np.flatnonzero(flags).tolist())


def observe_headings(robot: TurnedRobot, number: int) -> HeadingWaves | None:
    """Play the start of a number at all headings; None where time is over, or an observation has another size."""
    rows = list[Numbers]()
    for speed, spin in ((0.0, 0.0), (SPEED, 0.0), (0.0, SPIN)):
        for heading in HEADINGS:
            step = robot.play(number, heading, speed, LIFT, spin)
            if step is None or (rows and step.observed.shape != rows[0].shape):
                return None
            rows.append(step.observed)
    return HeadingWaves(*np.array(rows).reshape(3, len(HEADINGS), -1))
