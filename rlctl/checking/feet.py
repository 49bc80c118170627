"""Which links of robots touch other bodies, at each look at a world."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from rlctl.checking.world_logs import LoggedWorld, WorldLog
from rlctl.checking.worlds import Link

OFTEN = 0.05  # part of the looks in which a link touches something, so that it may be a foot
BASE = -1  # The number of the link that is the base


def find_feet(world: LoggedWorld) -> list[Link]:
    """Return the links of robots that often touch other bodies, without bases."""
    robots = {body.id for body in world.world.bodies if body.joints}
    touched = [list_touched(log, look) for log in world.logs for look in range(len(log.touching))]
    links = sorted({link for links in touched for link in links if link[0] in robots and link[1] != BASE})
    return [link for link in links if np.mean([link in links for links in touched]) >= OFTEN]


def list_touched(log: WorldLog, look: int) -> set[Link]:
    """Return the links that touch another body."""
    return {link for pair in log.touching[look] if pair[0][0] != pair[1][0] for link in pair}


def read_touches(log: WorldLog, links: Sequence[Link]) -> NDArray[np.bool_]:
    """Return which of some links touch another body at each look. Shape (looks, links)."""
    looks = [list_touched(log, look) for look in range(len(log.touching))]
    return np.array([[link in touched for link in links] for touched in looks], np.bool_).reshape(
        len(looks), len(links)
    )
