"""Goals that resets draw: where an environment keeps them, and where its observation shows them."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlctl.checking.rule import NotJudged
from rlctl.checking.values import Attribute, find_author, read_attributes, shape_like
from rlctl.checking.workspaces import Reach

SPACE = 3  # axes of the world
Numbers = NDArray[np.float64]
Source = tuple[int, ...]
"""The element of an observation from which on it has a place, and the sign with which the goal is in it; 0 for a place
by itself, and `TURNED` for the way to the goal in the frame of a robot that turns. A third number is the element from
which on the observation has another place in the same frame, such as that of an object: that is then the place."""
TURNED = 2


@dataclasses.dataclass(frozen=True)
class DrawnPlace:
    """Elements of an attribute: a whole place, or what a reset draws of it where the rest is constant."""

    name: str  # of the attribute
    elements: tuple[int, ...]
    later: tuple[tuple[int, ...], ...] = ()  # The elements of the goals after it, where there are several
    is_part: bool = False  # whether it is one of several drawn elements
    is_pose: bool = False  # whether the last number is an angle, and those before it are a place

    @property
    def size(self) -> int:
        """How many numbers the place has."""
        return len(self.elements)

    @property
    def is_place(self) -> bool:
        """Whether all of it is a place."""
        return not self.is_part and not self.is_pose

    @property
    def axes(self) -> list[int]:
        """The axes of the world that the elements are, where places of links are compared with them."""
        if self.is_pose:
            return list(range(self.size - 1))
        return list(self.elements if max(self.elements) < SPACE else range(self.size))

    def find(self, env: Any) -> Attribute:
        """Return the attribute, with a copy of its present value.

        Raises `NotJudged` where this episode does not have it, or has a shorter one.
        """
        attribute = read_attributes(env).get(self.name)
        if attribute is None or attribute.numbers.size <= max(self.elements):
            raise NotJudged(f"not every episode has the goal {self.name}")
        return attribute

    def find_again(self, attribute: Attribute, env: Any) -> Attribute:
        """Return an attribute of the present state: steps may have put another object where its owner was."""
        return attribute if attribute.owner is find_author(env) else self.find(env)

    def read(self, env: Any) -> Numbers:
        """Return the place. Shape (size,)."""
        return self.pick(self.find(env))

    def pick(self, attribute: Attribute) -> Numbers:
        """Return the place that an attribute has. Shape (size,)."""
        return attribute.numbers[list(self.elements)]

    def assign(self, attribute: Attribute, place: Numbers, together: bool = False) -> Numbers:
        """Replace the place in the environment, and `together` all later goals; the other elements become those of the
        copy. Return the place in the environment's own precision. Shape (size,)."""
        numbers = attribute.numbers.copy()
        for elements in [self.elements, *(self.later if together else ())]:
            if max(elements) < numbers.size:  # a reset may draw how many goals there are
                numbers[list(elements)] = place
        kept = shape_like(attribute.value, numbers)
        attribute.assign(kept)
        return np.ravel(np.asarray(kept, np.float64))[list(self.elements)]


@dataclasses.dataclass(frozen=True)
class SeenPose:
    """Where an observation has the way to a pose: that to its place, and the angle to it as cosine and sine."""

    place: int  # the first element of the way
    size: int  # of the way
    cosine: int
    sine: int

    def join(self, observed: Numbers) -> Numbers:
        """Return the way, and the angle [rad]. Shape (size + 1,)."""
        angle = np.arctan2(observed[self.sine], observed[self.cosine])
        return np.append(observed[self.place : self.place + self.size], angle)


@dataclasses.dataclass(frozen=True)
class DrawnGoal:
    """A place that each reset draws."""

    place: DrawnPlace
    copies: Sequence[Source]  # Where the observation has it, or its difference to something
    turned: Sequence[Source]  # Where the observation has its difference to something, turned
    goals: Mapping[int, Sequence[float]]  # by seed
    reaches: Mapping[Source, Reach]  # of links of a fixed robot, by where the observation has their places
    scales: Mapping[int, float] = dataclasses.field(default_factory=dict)
    """How many units of the observation a unit of the place is, by the elements of `turned`."""
    pose: SeenPose | None = None  # What `extend` appends to an observation

    def extend(self, observed: Numbers) -> Numbers:
        """Return an observation with the way to a pose appended, which it has in other numbers. Shape (elements,)."""
        return observed if self.pose is None else np.append(observed, self.pose.join(observed))

    def read_scale(self, element: int) -> float:
        """Return how many units of the observation a unit of the place is, where it has the way to it."""
        return self.scales.get(element, 1.0)

    @property
    def name(self) -> str:
        """The name of the attribute."""
        return self.place.name

    def name_axis(self, axis: int) -> str:
        """Name an element of the place: `self.goal[1]`."""
        is_number = self.place.elements == (0,) and not self.place.is_part
        return self.name if is_number else f"{self.name}[{self.place.elements[axis]}]"


def find_sources(copies: Sequence[Source], rows: Numbers, goals: Numbers) -> list[Source]:
    """Return where an observation may have the place of the robot: relative to the goal, and then by itself."""
    size = goals.shape[1]
    return [*copies, *((element, 0) for element in range(rows.shape[1] - size + 1))]


def read_place(source: Source, rows: Numbers, goals: Numbers) -> Numbers:
    """Return the place of the robot. Shapes of rows: (n, elements), of goals and the result: (n, size)."""
    sign, part = source[1], read_part(source, rows, goals.shape[1])
    return goals - sign * part if sign else part


def read_part(source: Source, rows: Numbers, size: int) -> Numbers:
    """Return what an observation has there: a place, or the way to the goal. Shapes (n, elements) and (n, size)."""
    element, _, *others = source
    part = rows[:, element : element + size]
    return part - rows[:, others[0] : others[0] + size] if others else part
