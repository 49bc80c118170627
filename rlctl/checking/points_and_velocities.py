"""The places and velocities of things, for rules about what an observation computes from both."""

from collections.abc import Sequence
from typing import NamedTuple

from rlctl.checking.experiments.attributes import AttributeLog
from rlctl.checking.step_times import find_rates
from rlctl.checking.worlds import Array

MOST_TURNS, MOST_PLACES = 8, 8


class LoggedPlace(NamedTuple):
    """The position of something in all looks."""

    name: str
    points: Array  # Shape (looks, 2 or 3)
    matrices: Array | None  # From its frame to the world's, shape (looks, 3, 3), where it has one


class LoggedVelocity(NamedTuple):
    """The velocity of something in all looks."""

    name: str
    vectors: Array  # In the world. Shape (looks, 2 or 3)


def list_places_of(
    log: AttributeLog, size: int, matrices: Sequence[Array]
) -> tuple[list[LoggedPlace], list[LoggedVelocity]]:
    """Return the places and velocities that attributes of a robot without an engine are: consecutive numbers that
    change by other consecutive ones; each place alone and with each of the given orientations. `size` is 2 or 3."""
    rates = {place: rate for place, rate, _ in find_rates(log, log.values)}
    places, velocities = [], []
    for first in list(rates)[: MOST_PLACES * size]:
        columns = [rates.get(first + i, -1) for i in range(size)]
        if columns != list(range(columns[0], columns[0] + size)) or columns[0] < 0:
            continue
        name, rate = (log.names[i].rpartition("[")[0] or log.names[i] for i in (first, columns[0]))
        points = log.values[:, first : first + size]
        places += [LoggedPlace(name, points, turn) for turn in [None, *matrices[:MOST_TURNS]]]
        velocities.append(LoggedVelocity(rate, log.values[:, columns]))
    return places, velocities
