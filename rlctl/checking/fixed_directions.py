"""Which elements are a direction that is fixed in the world, as that to the sun, turned the wrong way.

R.T @ s is how a body sees a direction s. R @ s moves as what is fixed to the body does, seen from the world; but an
axis of the body is the same one in each episode.
"""

import itertools
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rlctl.checking.experiments.attributes import AttributeLog
from rlctl.checking.shared_frames import MOST_TURNS, Turn, list_attribute_turns
from rlctl.checking.worlds import Array

PARTS, SHORTEST = 3, 9  # into which an episode is divided, against noise; steps of an episode
SAME_LENGTH = 0.05  # standard deviation of the length of a direction, relative
DRAWN = 0.5  # root mean square by which directions of episodes differ from their mean, relative to their length
FIXED, CLEARLY = 0.03, 4.0
"""How far a direction may be from its episode's mean, relative to its length; how many times further in others."""
MOST_BLOCKS = 60
SAME_RATE = 0.98  # correlation of a turn and of an angular velocity
LEAST_ANGLE = 1e-4  # root mean square of the turns in a step [rad]


class TurnedDirection(NamedTuple):
    """A direction that was turned the wrong way."""

    column: int  # of its first element
    turn: Turn


def find_turned_directions(
    observed: Array, episodes: NDArray[np.int_], turns: Sequence[Turn]
) -> Iterator[TurnedDirection]:
    """Yield three elements that are R @ s, where s is fixed in an episode and drawn for each, and R is the rotation
    from a body to the world. Shapes (looks, elements) and (looks,)."""
    for column in _list_directions(observed, episodes):
        block = observed[:, column : column + 3]
        length = float(np.linalg.norm(block, axis=1).mean())
        raw = _measure_spread(block, episodes)
        for turn in turns[:MOST_TURNS]:
            right = _measure_spread(np.einsum("nij,nj->ni", turn.matrices, block), episodes)
            turned = np.einsum("nji,nj->ni", turn.matrices, block)
            wrong = _measure_spread(turned, episodes)
            is_fixed = wrong < FIXED * length and CLEARLY * wrong < min(raw, right)
            if is_fixed and _is_drawn(turned, episodes, length):
                yield TurnedDirection(column, turn)
                break


def _list_directions(observed: Array, episodes: NDArray[np.int_]) -> Iterator[int]:
    """Yield the first of three elements whose vector has always the same length."""
    counts = np.unique(episodes, return_counts=True)[1]
    if (counts >= SHORTEST).sum() < 3:
        return
    for column in range(min(MOST_BLOCKS, observed.shape[1] - 2)):
        block = observed[:, column : column + 3]
        lengths = np.linalg.norm(block, axis=1)
        if lengths.mean() > 0 and lengths.std() < SAME_LENGTH * lengths.mean() and (block.std(axis=0) > 0).all():
            yield column


def _means(vectors: Array, episodes: NDArray[np.int_]) -> list[Array]:
    """Return the means of the parts of each long episode. Shape (PARTS, 3) each."""
    rows = [vectors[episodes == number] for number in np.unique(episodes)]
    return [
        np.array([part.mean(axis=0) for part in np.array_split(row, PARTS)]) for row in rows if len(row) >= SHORTEST
    ]


def _measure_spread(vectors: Array, episodes: NDArray[np.int_]) -> float:
    parts = [means - means.mean(axis=0) for means in _means(vectors, episodes)]
    return float(np.sqrt(np.square(np.concatenate(parts)).sum(axis=1).mean()))


def _is_drawn(vectors: Array, episodes: NDArray[np.int_], length: float) -> bool:
    """Say whether each episode has another direction: an axis of the body, seen from the world, has not."""
    means = np.array([part.mean(axis=0) for part in _means(vectors, episodes)])
    return float(np.sqrt(np.square(means - means.mean(axis=0)).sum(axis=1).mean())) > DRAWN * length


def list_body_turns(log: AttributeLog) -> list[Turn]:
    """Return the orientations of attributes that turn by an angular velocity of attributes, as rotations from the body
    to the world: the sign of that velocity tells which way they are."""
    found = []
    steps = np.flatnonzero(log.is_step)
    middle = (log.values[steps] + log.values[steps - 1]) / 2
    rates = [middle[:, i : i + 3] for i in range(log.values.shape[1] - 2) if middle[:, i : i + 3].any()]
    for turn in list_attribute_turns(log):
        before, after = turn.matrices[steps - 1], turn.matrices[steps]
        inside = _find_vectors(np.einsum("nji,njk->nik", before, after))
        outside = np.einsum("nij,nj->ni", before, inside)
        if np.sqrt(np.square(inside).mean()) < LEAST_ANGLE:
            continue
        pairs = [_correlate(angles, rate) for angles, rate in itertools.product((inside, outside), rates)]
        best = max(pairs, key=abs, default=0.0)
        if abs(best) > SAME_RATE:
            found.append(turn if best > 0 else Turn(turn.name, turn.matrices.transpose(0, 2, 1)))
    return found


def _find_vectors(matrices: Array) -> Array:
    """Return the rotation vectors of small rotations [rad], shape (n, 3)."""
    m = matrices
    return np.array([m[:, 2, 1] - m[:, 1, 2], m[:, 0, 2] - m[:, 2, 0], m[:, 1, 0] - m[:, 0, 1]]).T / 2


def _correlate(one: Array, two: Array) -> float:
    size = float(np.linalg.norm(one) * np.linalg.norm(two))
    return float((one * two).sum()) / size if size > 0 else 0.0
