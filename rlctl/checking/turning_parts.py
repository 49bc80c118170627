"""Numbers of attributes that turn with the world of a robot about the vertical: vectors, angles and orientations."""

import dataclasses
from collections.abc import Collection, Iterator, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from rlctl.checking.instance import Instance
from rlctl.checking.values import Attribute, read_attributes, shape_like

MOST_VECTORS = 40  # attributes that are tried
UNIT = 1e-4  # how far a quaternion may be from the length 1
PAIRED = (("x", "y"), ("px", "py"), ("vx", "vy"), ("x_pos", "y_pos"), ("x_dot", "y_dot"))
Numbers = NDArray[np.float64]


@dataclasses.dataclass(frozen=True)
class TurningPart:
    """Numbers of attributes that turn with the world."""

    name: str
    axes: tuple[tuple[str, int], ...]  # Attribute and place of each number: x and y in turn, or one angle [rad]
    is_heading: bool = False  # whether it is an orientation: an angle, a quaternion or a matrix
    speed: float = 1.0  # by how many times the angle it turns: half of it in a quaternion

    @property
    def is_angle(self) -> bool:
        """Whether it is an angle, and no vectors."""
        return len(self.axes) == 1

    def read_heading(self, attributes: Mapping[str, Attribute]) -> float:
        """Return the heading that it is [rad]; NaN where an attribute is gone."""
        if any(name not in attributes or place >= attributes[name].numbers.size for name, place in self.axes):
            return float("nan")
        numbers = [float(attributes[name].numbers[place]) for name, place in self.axes]
        if self.is_angle:
            return numbers[0]
        if self.speed == 1.0:  # the first column of a matrix
            return float(np.arctan2(numbers[1], numbers[0]))
        w, z, x, y = numbers
        return float(np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)))


def turn_parts(instance: Instance, parts: Collection[TurningPart], angle: float) -> list[Attribute]:
    """Turn parts by an angle [rad]; return the attributes that have another value now, with the one before."""
    if not angle or not parts:
        return []
    attributes = read_attributes(instance.env)
    numbers = {name: attributes[name].numbers.copy() for part in parts for name, _ in part.axes if name in attributes}
    for part in parts:
        turn = np.exp(1j * part.speed * angle)
        if any(name not in numbers or place >= numbers[name].size for name, place in part.axes):
            continue
        if part.is_angle:
            name, place = part.axes[0]
            numbers[name][place] += angle
            continue
        for (one, x), (two, y) in zip(part.axes[::2], part.axes[1::2], strict=True):
            vector = turn * complex(numbers[one][x], numbers[two][y])
            numbers[one][x], numbers[two][y] = vector.real, vector.imag
    for name, values in numbers.items():
        attributes[name].assign(shape_like(attributes[name].value, values))
    return [attributes[name] for name in numbers]


def find_vectors(attributes: Mapping[str, Attribute]) -> list[TurningPart]:
    """Return what may be vectors in the axes of the world: rows of two or three numbers, and x and y by their names."""
    found: list[TurningPart] = []
    for name, attribute in attributes.items():
        found += _list_parts(name, np.asarray(attribute.value, np.float64))
    for name in attributes:
        for one, two in PAIRED:
            other = name[: -len(one)] + two
            is_scalar = attributes[name].numbers.size == 1
            if name.endswith((f".{one}", f"_{one}")) and other in attributes and is_scalar:
                found.append(TurningPart(name, ((name, 0), (other, 0))))
    return found[:MOST_VECTORS]


def _list_parts(name: str, values: Numbers) -> Iterator[TurningPart]:
    """Yield what may turn of the values of an attribute: a matrix, a quaternion, rows of two or three numbers, or pairs
    of numbers."""
    shape = values.shape
    if shape == (3, 3) and np.allclose(values @ values.T, np.eye(3), atol=UNIT):
        yield TurningPart(name, tuple((name, column + 3 * axis) for column in range(3) for axis in (0, 1)), True)
    elif shape == (4,) and abs(np.linalg.norm(values) - 1) < UNIT:
        for w, x, y, z in ((0, 1, 2, 3), (3, 0, 1, 2)):
            yield TurningPart(name, ((name, w), (name, z), (name, x), (name, y)), True, 0.5)
    elif shape and shape[-1] in (2, 3):
        firsts = range(0, values.size, shape[-1])
        yield TurningPart(name, tuple((name, first + axis) for first in firsts for axis in (0, 1)))
    elif len(shape) == 1:
        for first in range(values.size - 1):
            yield TurningPart(f"{name}[{first}]", ((name, first), (name, first + 1)))


def overlaps(part: TurningPart, parts: Sequence[TurningPart]) -> bool:
    """Say whether a part has numbers of another one of some parts."""
    return any(set(part.axes) & set(other.axes) for other in parts if other is not part)
