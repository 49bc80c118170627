"""One episode of one world, as it was watched."""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from rlctl.check_env.studies.world_reading import (
    Pair,
    WorldModel,
    bullet,
    read_contacts,
    read_state,
    thickness,
)
from rlctl.check_env.world_results import Moment

DEEPEST_FINE = 0.02
"""Links of ordinary size may be so far inside each other [m]: Bullet pushes them apart over several steps, and 2 cm
are more than a stiff contact leaves even for a heavy robot that falls."""
LEAST_LIMIT = 0.005
"""The same for the smallest things [m]: collision margins alone are 1 to 4 mm."""
PART_OF_LINK = 0.25
"""Between those two it is this part of the thinner link."""
TOUCHING = 0.005
"""Links that are closer than this touch [m]; Bullet reports contacts a little ahead."""


@dataclasses.dataclass
class Life:
    """What was seen, per step; the first row is the reset."""

    world: WorldModel
    moments: list[Moment] = dataclasses.field(default_factory=list)
    rows: list[NDArray[np.float64]] = dataclasses.field(default_factory=list)
    deep: list[dict[Pair, tuple[float, float]]] = dataclasses.field(default_factory=list)
    """Depth and limit of what is too far inside each other [m]."""
    touching: list[set[int]] = dataclasses.field(default_factory=list)
    """The ids of bodies that touch another one."""

    @property
    def states(self) -> NDArray[np.float64]:
        """Shape (moments, columns)."""
        return np.array(self.rows).reshape(len(self.rows), len(self.world.columns))

    @property
    def moves(self) -> bool:
        """Whether anything ever had a speed."""
        speeds = [i for i, each in enumerate(self.world.columns) if each.kind.endswith("velocity")]
        return bool(self.states[:, speeds].any())

    def column(self, body: int, kind: str) -> list[int]:
        """Return where a body's numbers of one kind are."""
        return [i for i, each in enumerate(self.world.columns) if each.body == body and each.kind == kind]

    def link_name(self, link: tuple[int, int]) -> str:
        """Return how to write a (body id, link index)."""
        for body in self.world.bodies:
            if body.id == link[0] and len(body.links) == 1:
                return body.name
            if body.id == link[0]:
                return f"{body.links[link[1] + 1] or 'base'} of {body.name}"
        return f"link {link[1]} of body {link[0]}"


def look(life: Life, moment: Moment) -> bool:
    """Add what is to be seen now; False where the world has gone, or has other bodies."""
    client = life.world.client
    try:
        row = read_state(life.world)
        contacts = read_contacts(client)
        deep = {
            pair: (-distance, _limit(client, pair)) for pair, distance in contacts.items() if distance < -LEAST_LIMIT
        }
    except bullet().error:
        return False
    life.moments.append(moment)
    life.rows.append(row)
    life.deep.append({pair: each for pair, each in deep.items() if each[0] > each[1]})
    life.touching.append(
        {body for pair, d in contacts.items() if d < TOUCHING for body, _ in pair if pair[0][0] != pair[1][0]}
    )
    return True


def _limit(client: int, pair: Pair) -> float:
    thinner = min(thickness(client, link) for link in pair)
    return min(DEEPEST_FINE, max(LEAST_LIMIT, PART_OF_LINK * thinner))
