"""The values of a robot that a log shall tell, as a vector."""

import dataclasses
from collections.abc import Collection, Sequence

import numpy as np

from rlctl_robot.identify.log import Array
from rlctl_robot.identify.robot_model import (
    ARMATURE,
    BACKLASH,
    BIAS,
    COULOMB,
    DELAY,
    MASS,
    STIFFNESS,
    TORQUE,
    VISCOUS,
    RobotModel,
    Values,
    stack_values,
)

QUANTITIES = {
    "stiffness": STIFFNESS,
    "armature": ARMATURE,
    "viscous": VISCOUS,
    "coulomb": COULOMB,
    "bias": BIAS,
    "delay": DELAY,
    "torque": TORQUE,
    "backlash": BACKLASH,
    "mass": MASS,
}
"""What `--fit` can name."""
DEFAULT = ("stiffness", "armature", "viscous", "coulomb", "bias", "delay")
_LOWEST = {
    STIFFNESS: 1e-3,
    ARMATURE: 1e-6,
    VISCOUS: 0.0,
    COULOMB: 1e-6,
    BIAS: -np.pi,
    TORQUE: 1e-3,
    BACKLASH: 1e-4,
    DELAY: 0.0,
    MASS: 0.05,
}
_STEP, _PLAY_STEP = 2e-3, 0.05  # of a typical value, for derivatives; the ends of a play are not smooth
_SURE = 5.0  # a first guess may be wrong by so many times a typical value
_SIZES = {BIAS: 0.05, BACKLASH: 0.02, DELAY: 0.02, MASS: 1.0}
_SMALLEST = {ARMATURE: 2e-4, VISCOUS: 5e-3, COULOMB: 2e-3}
"""Relative to the stiffness [s^2, s, rad]: smaller values than these hardly change how a servo moves."""


@dataclasses.dataclass(frozen=True)
class Unknown:
    """A value to estimate."""

    quantity: str  # one of `QUANTITIES`
    index: int  # of the joint, or the number of the body; 0 for the delay
    part: str  # name of the joint or link; empty for the delay
    size: float  # a typical value
    first: float  # where the search begins
    group: int
    """Values of one group change joints of different trees, so that one world shows the effect of all of them."""

    @property
    def name(self) -> str:
        """The name in reports: JOINT QUANTITY."""
        return f"{self.part} {self.quantity}".strip()

    @property
    def lowest(self) -> float:
        """The smallest possible value."""
        return _LOWEST[self.quantity]

    @property
    def step(self) -> float:
        """The change with which derivatives are computed."""
        share = _PLAY_STEP if self.quantity == BACKLASH else _STEP
        return share * self.size

    @property
    def doubt(self) -> float:
        """Standard deviation of the value before the log is seen."""
        return _SURE * self.size


@dataclasses.dataclass(frozen=True, eq=False)
class UnknownValues:
    """The vector of unknown values, and how it becomes values of a robot."""

    items: tuple[Unknown, ...]
    fixed: Values
    """Values by quantity, of which the unknown ones are replaced."""
    affected: Array  # whether an unknown moves a joint, shape (joints, unknowns)

    @property
    def groups(self) -> int:
        """Number of groups."""
        return 1 + max((item.group for item in self.items), default=-1)

    def column(self, name: str) -> Array:
        """Return a field of all unknowns, shape (unknowns,)."""
        return np.array([getattr(item, name) for item in self.items], np.float64)

    def values(self, vectors: Array) -> Values:
        """Return the values of a robot for vectors of shape (n, unknowns), stacked."""
        stacked = stack_values(self.fixed, len(vectors))
        for column, item in enumerate(self.items):
            if item.quantity == DELAY:
                stacked[DELAY][:] = vectors[:, column]
            else:
                stacked[item.quantity][:, item.index] = vectors[:, column]
        return stacked


def list_unknowns(robot: RobotModel, start: Values, chosen: Collection[str], moving: Sequence[int]) -> UnknownValues:
    """Return what to estimate: the chosen quantities of the joints that move, from a first guess."""
    order = {joint: int(np.sum(robot.trees[:joint] == robot.trees[joint])) for joint in range(len(robot.joints))}
    keys: dict[tuple[str, int], int] = {}
    items: list[Unknown] = []

    def add(quantity: str, index: int, part: str, place: int) -> None:
        first = float(np.ravel(start[quantity])[index])
        size = _SIZES.get(quantity) or abs(first)
        if quantity in _SMALLEST:
            size = max(size, _SMALLEST[quantity] * start[STIFFNESS][index])
            first = max(first, _SMALLEST[quantity] * start[STIFFNESS][index])
        group = keys.setdefault((quantity, place), len(keys))
        items.append(Unknown(quantity, index, part, size, first, group))

    for short in (name for name in QUANTITIES if name in chosen):
        quantity = QUANTITIES[short]
        if quantity == DELAY:
            add(quantity, 0, "", 0)
        elif quantity == MASS:
            for number, link in zip(robot.link_numbers, robot.links, strict=True):
                add(quantity, number, link, number)  # a link's tree may have other links of the same place
        else:
            for joint in moving:
                add(quantity, joint, robot.joints[joint], order[joint])
    affected = np.stack([_find_affected(robot, item) for item in items], axis=1)
    return UnknownValues(tuple(items), start, affected)


def _find_affected(robot: RobotModel, item: Unknown) -> Array:
    if item.quantity == DELAY:
        return np.ones(len(robot.joints), bool)
    # A mass has the number of its body, everything else that of its joint.
    tree = robot.model.body_treeid[item.index] if item.quantity == MASS else robot.trees[item.index]
    result: Array = robot.trees == tree
    return result
