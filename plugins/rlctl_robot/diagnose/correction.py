"""`Correction`: one difference between what was logged and what the policy was trained with, and how to undo it."""

import dataclasses
from collections.abc import Iterable
from typing import Literal

import numpy as np

from rlctl_robot.diagnose.signals import ACTIONS, Array, LoggedSignals, quaternion_matrices, rotation_matrices, shift

Kind = Literal["order", "sign", "scale", "unit", "offset", "delay", "frame", "normalised"]
EVERYTHING = "observation"  # all observations together
JOINTS = "joints"  # positions, velocities and commands of the joints together


@dataclasses.dataclass(frozen=True)
class Correction:
    """corrected = factor * logged[order] + offset, `delay` rows later, turned into another `frame`.

    For the actions of a robot this is what the robot executed: factor * action[order] + offset, `delay` rows ago.
    """

    term: str  # an observation's name, `actions`, `observation` for all, or `joints` for `parts`
    kind: Kind
    text: str  # what is wrong, for people
    order: tuple[int, ...] = ()
    factor: tuple[float, ...] = ()
    offset: tuple[float, ...] = ()
    delay: int = 0  # [control steps] by which the logged values are late
    frame: Literal["", "to body", "to world"] = ""
    attitude: str = ""  # for `frame`: the observation that holds roll, pitch and yaw or a quaternion (x, y, z, w)
    parts: tuple["Correction", ...] = ()
    """Of a mistake of the joints' driver: the corrections of each quantity of the joints, all of them together."""

    def describe(self) -> str:
        """Return a line such as `joint_velocities: elements 3 and 4 are swapped`."""
        return f"{self.term}: {self.text}"

    def change(self, values: Array) -> Array:
        """Return factor * values[order] + offset for values of shape (..., elements)."""
        if self.order:
            values = values[..., list(self.order)]
        if self.factor:
            values = values * np.array(self.factor)
        return values + np.array(self.offset) if self.offset else values

    def undo(self, values: Array) -> Array:
        """Return the values of which `change` makes `values`."""
        if self.offset:
            values = values - np.array(self.offset)
        if self.factor:
            values = values / np.array(self.factor)
        return values[..., np.argsort(self.order)] if self.order else values


def list_parts(corrections: Iterable[Correction]) -> list[Correction]:
    """Return the corrections of single terms that corrections consist of, in their order."""
    return [part for one in corrections for part in (one.parts or (one,))]


def correct(signals: LoggedSignals, corrections: Iterable[Correction], *, on_robot: bool = False) -> LoggedSignals:
    """Return the signals with corrections applied one after the other.

    `on_robot`: corrections of `actions` give what the robot executed, so a delay takes older rows.
    """
    observations, actions = signals.observations, signals.actions
    for one in list_parts(corrections):
        if one.term == ACTIONS:
            actions = one.change(shift(actions, -one.delay if on_robot else one.delay, signals.lengths))
            continue
        columns = slice(None) if one.term == EVERYTHING else signals.slices[one.term]
        values = one.change(shift(observations[:, columns], one.delay, signals.lengths))
        if one.frame:
            attitude = observations[:, signals.slices[one.attitude]]
            values = turn(values, attitude, one.frame)
        observations = observations.copy()
        observations[:, columns] = values
    return dataclasses.replace(signals, observations=observations, actions=actions)


def turn(values: Array, attitude: Array, frame: str) -> Array:
    """Return vectors, shape (T, 3), in the body's or the world's frame."""
    matrices = rotation_matrices(attitude) if attitude.shape[1] == 3 else quaternion_matrices(attitude)
    subscripts = "tji,tj->ti" if frame == "to body" else "tij,tj->ti"
    turned: Array = np.einsum(subscripts, matrices, values)
    return turned
