"""Points of an environment by name: links and bodies of its engine, and what its attributes hold as a place."""

import dataclasses
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from rlctl.checking import bullet_worlds
from rlctl.checking.instance import Instance
from rlctl.checking.mujoco_worlds import MujocoStateReader
from rlctl.checking.values import read_attributes
from rlctl.checking.worlds import FRAME, World
from rlctl.environments.simulations import find_mujoco

MOST_NUMBERS = 12  # of an attribute: a place, or a state that begins with one
Numbers = NDArray[np.float64]


@dataclasses.dataclass
class PointReader:
    """Reads the points of an instance in the episode that has begun."""

    instance: Instance
    axes: Sequence[int]  # of the world, that a point has

    def __post_init__(self) -> None:
        self._worlds: list[World] = [bullet_worlds.read_world(client) for client in self.instance.find_clients()]
        simulation = find_mujoco(self.instance.env)
        self._mujoco = None if simulation is None else MujocoStateReader(*simulation)

    def read(self) -> dict[str, Numbers]:
        """Return the points by name. Shape (len(axes),) each."""
        points: dict[str, Numbers] = {}
        for world in self._worlds:
            rows = bullet_worlds.read_points(world)[:, FRAME]
            points |= dict(zip(bullet_worlds.name_points(world), rows[:, self.axes], strict=True))
        if self._mujoco is not None:
            self._mujoco.update()
            rows = self._mujoco.read_points()[:, FRAME]
            points |= dict(zip(self._mujoco.name_points(), rows[:, self.axes], strict=True))
        return points | self._read_attributes()

    def _read_attributes(self) -> dict[str, Numbers]:
        points: dict[str, Numbers] = {}
        size = len(self.axes)
        for name, attribute in read_attributes(self.instance.env).items():
            numbers = attribute.numbers
            if np.asarray(attribute.value).dtype.kind == "f" and size <= numbers.size <= MOST_NUMBERS:
                for first in range(numbers.size - size + 1):
                    part = name if numbers.size == size else f"{name}[{first}:{first + size}]"
                    points[part] = numbers[first : first + size].copy()
        return points
