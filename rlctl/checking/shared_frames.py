"""Whether a place and a velocity that are observed are in the same frame.

A place relative to something gets nearer by the part of the velocity along it, in whatever frame both are; so the
lengths of a place tell how a velocity has to be turned to belong to it.
"""

import dataclasses
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rlctl.checking import attitudes
from rlctl.checking.body_frames import list_turns_of, turn_plane
from rlctl.checking.experiments.attributes import AttributeLog
from rlctl.checking.experiments.worlds import ObservedWorld
from rlctl.checking.records import Built
from rlctl.checking.step_times import find_rates
from rlctl.checking.transitions import find_float_leaves
from rlctl.checking.values import is_task
from rlctl.checking.worlds import ORIENTATION, Array

MOST_ELEMENTS, MOST_TURNS = 40, 12
MOST_LOOKS, LONGEST = 1_000, 150  # that are compared, and of an episode
SIZES = (3, 2)  # of a place and of a velocity
WINDOW, FEWEST_WINDOWS = 12, 40  # steps over which a place gets nearer; and how many are compared
MOST_WINDOWS = 150
MOST_CHANGE = 0.1  # root mean square of the change of a rotation from look to look
SAME_TIME = 0.15  # relative error of the time of a step
MOST_MEAN = 0.7  # of a velocity, part of its root mean square
KEPT = 0.8  # part of the windows that has to fit: goals are drawn again
FITS, MISFITS, CLEARLY = 0.05, 0.01, 8.0
"""Part of what the lengths change that is left where velocities fit at most, and where they do not at least; how many
times more that is."""
LEAST_WAY = 1e-3  # root mean square of what the lengths change in a window
SAME_VELOCITY = 0.95  # correlation of what is observed with a velocity in the world, with noise
EQUAL = 1e-3  # elements of rotations that are one
LEAST_TURN = 0.15  # root mean square of a rotation minus its inverse: smaller ones have no wrong way


@dataclasses.dataclass(frozen=True, eq=False)
class Turn:
    """An orientation in each look."""

    name: str
    matrices: Array  # Shape (looks, 3, 3)
    columns: tuple[int, ...] = ()  # of the observation that show it

    @property
    def is_turned(self) -> bool:
        """Whether the wrong way can be told from the right one."""
        return float(np.sqrt(np.mean(np.square(self.matrices - self.matrices.transpose(0, 2, 1))))) >= LEAST_TURN

    def is_slow(self, episodes: NDArray[np.int_]) -> bool:
        """Say whether it changes little from look to look, as a heading does."""
        changes = np.diff(self.matrices, axis=0)[episodes[1:] == episodes[:-1]]
        return bool(np.sqrt(np.mean(np.square(changes))) < MOST_CHANGE)

    def select(self, looks: NDArray[np.bool_] | NDArray[np.intp]) -> "Turn":
        """Return it in some of the looks."""
        return Turn(self.name, self.matrices[looks], self.columns)

    def reduce(self, size: int) -> Array:
        """Return it, or only the turn about the vertical in a plane. Shape (looks, size, size)."""
        if size == 3:
            return self.matrices
        return turn_plane(np.arctan2(self.matrices[:, 1, 0], self.matrices[:, 0, 0]))


def turn_level(name: str, angles: Array, columns: tuple[int, ...] = ()) -> Turn:
    """Return a turn about the vertical by angles [rad], shape (looks,)."""
    matrices = np.tile(np.eye(3), (len(angles), 1, 1))
    matrices[:, :2, :2] = turn_plane(angles)
    return Turn(name, matrices, columns)


class Misfit(NamedTuple):
    """A place and a velocity that are observed in frames which do not belong together."""

    place: slice  # of the observation
    velocity: slice
    turn: Turn
    power: int
    """How often the velocity has to be turned to be in the frame of the place: -1 where it is in the world and the
    place is not; twice, in either direction, where one of them was turned the wrong way."""


IN_WORLD = -1
RIGHT, WRONG = (0, 1), (IN_WORLD, 2, -2)
"""Powers: of a velocity in the frame of the place, or in that of the body while the place is in the world; and of what
is in no frame that belongs to it."""


def find_misfits(
    observed: Array,
    parts: Sequence[object],
    episodes: NDArray[np.int_],
    turns: Sequence[Turn],
    seconds: float,
    powers: Sequence[int] = WRONG,
) -> Iterator[Misfit]:
    """Yield places and velocities in two frames, those that fit best first.

    Shapes (looks, elements) and (looks,); `parts` says for each element which part of the observation it belongs to,
    `seconds` how long a step takes [s], and `powers` which wrong ones are looked for.
    """
    few = _choose_looks(episodes)
    observed, episodes = observed[few, :MOST_ELEMENTS], episodes[few]
    starts = _list_starts(episodes)
    turned = [turn for turn in (turn.select(few) for turn in turns) if turn.is_turned and turn.is_slow(episodes)]
    turned = turned[:MOST_TURNS]
    if len(starts) < FEWEST_WINDOWS or not turned:
        return
    for size in SIZES:
        found = sorted(_find_of_size(observed, parts, starts, turned, seconds, powers, size), key=lambda pair: pair[0])
        if found:
            yield from (misfit for _, misfit in found)
            return


def fits(observed: Array, episodes: NDArray[np.int_], place: slice, velocity: slice) -> bool:
    """Say whether a place and a velocity are in the same frame."""
    few = _choose_looks(episodes)
    starts, size = _list_starts(episodes[few]), place.stop - place.start
    both = observed[few, place][:, None], observed[few, velocity][:, None]
    rest = _measure(*both, np.tile(np.eye(size), (int(few.sum()), 1, 1)), starts)
    return bool(rest[0, 0] < FITS)


def _choose_looks(episodes: NDArray[np.int_]) -> NDArray[np.bool_]:
    """Return which looks are compared: of all episodes some, whole."""
    names, counts = np.unique(episodes, return_counts=True)
    ends = np.cumsum(np.minimum(counts, LONGEST))
    stride = max(1, int(np.ceil(ends[-1] / MOST_LOOKS)))
    place = np.arange(len(episodes)) - np.searchsorted(episodes, episodes)
    return np.asarray(np.isin(episodes, names[::stride]) & (place < LONGEST))


def _list_starts(episodes: NDArray[np.int_]) -> NDArray[np.intp]:
    """Return the looks at which windows begin."""
    last = max(0, len(episodes) - WINDOW)
    starts = np.flatnonzero(episodes[:last] == episodes[WINDOW:][:last])
    return starts[:: max(1, len(starts) // MOST_WINDOWS)]


def _find_of_size(
    observed: Array,
    parts: Sequence[object],
    starts: NDArray[np.intp],
    turns: Sequence[Turn],
    seconds: float,
    powers: Sequence[int],
    size: int,
) -> Iterator[tuple[float, Misfit]]:
    """Yield what the best wrong turn leaves, and the misfit, of pairs of which no right turn fits."""
    moves = np.ptp(observed, axis=0) > 0
    firsts = [
        first
        for first in range(observed.shape[1] - size + 1)
        if moves[first : first + size].all() and len(set(parts[first : first + size])) == 1
    ]
    if len(firsts) < 2:
        return
    blocks = np.stack([observed[:, first : first + size] for first in firsts], axis=1)
    right = _measure_all(blocks, turns, RIGHT, starts)
    wrong = _measure_all(blocks, turns, powers, starts, seconds)
    for number, turn in enumerate(turns):  # what shows a turn is neither a place nor a velocity
        shows = [any(first <= column < first + size for column in turn.columns) for first in firsts]
        wrong[number, :, shows, :] = 1.0
        wrong[number, :, :, shows] = 1.0
    left, best = wrong.min(axis=(0, 1)), right.min(axis=(0, 1))
    has_none = best.min(axis=1) > FITS  # of the observed velocities, in its frame: joint angles have their own
    is_found = (left < FITS) & (best > np.maximum(MISFITS, CLEARLY * left)) & has_none[:, None]
    for one, two in np.argwhere(is_found).tolist():
        place, velocity = firsts[one], firsts[two]
        number, power = divmod(int(wrong[:, :, one, two].argmin()), wrong.shape[1])
        matrices = np.linalg.matrix_power(turns[number].reduce(size), powers[power])
        vectors = blocks[:, two]
        if abs(place - velocity) >= size and _varies(vectors) and _varies(np.einsum("nij,nj->ni", matrices, vectors)):
            slices = slice(place, place + size), slice(velocity, velocity + size)
            yield float(left[one, two]), Misfit(*slices, turns[number], powers[power])


def _varies(vectors: Array) -> bool:
    """Say whether a velocity points in several directions: a constant one that is turned is a copy of its turn."""
    return bool(np.linalg.norm(vectors.mean(axis=0)) < MOST_MEAN * np.sqrt(np.square(vectors).sum(axis=1).mean()))


def _measure_all(
    blocks: Array, turns: Sequence[Turn], powers: Sequence[int], starts: NDArray[np.intp], seconds: float | None = None
) -> Array:
    """Return what is left by each turn, power, place and velocity. Shape (turns, powers, places, velocities)."""
    size = blocks.shape[2]
    same = np.tile(np.eye(size), (len(blocks), 1, 1))
    not_turned = _measure(blocks, blocks, same, starts) if 0 in powers else None
    return np.array(
        [
            [
                not_turned
                if power == 0
                else _measure(blocks, blocks, np.linalg.matrix_power(turn.reduce(size), power), starts, seconds)
                for power in powers
            ]
            for turn in turns
        ]
    )


def _measure(
    places: Array, velocities: Array, matrices: Array, starts: NDArray[np.intp], seconds: float | None = None
) -> Array:
    """Return what is left of the changes of lengths of places, 0 to 1; with the time of a step, 1 where the velocities
    would be too large or too small. Shapes (looks, places, size), (looks, velocities, size) and (looks, size, size);
    returns (places, velocities)."""
    lengths = np.linalg.norm(places, axis=2)
    directions = places / np.maximum(lengths, 1e-9)[:, :, None]
    along = directions @ matrices @ velocities.transpose(0, 2, 1)
    summed = np.concatenate([np.zeros((1, *along.shape[1:])), np.cumsum((along[1:] + along[:-1]) / 2, axis=0)])
    ways, sums = lengths[starts + WINDOW] - lengths[starts], summed[starts + WINDOW] - summed[starts]
    ways = np.broadcast_to(ways[:, :, None], sums.shape)
    kept = np.ones_like(ways)
    for _ in range(2):
        factors = (kept * ways * sums).sum(axis=0) / np.maximum((kept * sums**2).sum(axis=0), 1e-12)
        errors = np.abs(ways - factors * sums)
        kept = (errors <= np.partition(errors, int(KEPT * len(errors)), axis=0)[int(KEPT * len(errors))]).astype(float)
    size = (kept * ways**2).sum(axis=0)
    rests = (kept * errors**2).sum(axis=0) / np.maximum(size, 1e-12)
    if seconds is not None:
        rests = np.where(np.abs(np.abs(factors) / seconds - 1) < SAME_TIME, rests, 1.0)
    is_moving = np.sqrt(size / kept.sum(axis=0)) > LEAST_WAY
    return np.where(is_moving, np.minimum(rests, 1.0), 1.0)


def list_world_turns(one: ObservedWorld) -> list[Turn]:
    """Return how the bodies and links of a world are turned, each orientation once."""
    world, turns = one.logs[0].world, list[Turn]()
    for link in one.logs[0].poses[0]:
        if not all(link in poses for log in one.logs for poses in log.poses):
            continue
        quaternions = np.array([poses[link][ORIENTATION] for log in one.logs for poses in log.poses])
        turn = Turn(f"the orientation of {world.link_name(link)}", attitudes.compute_matrices(quaternions))
        if turn.is_turned and all(np.abs(turn.matrices - other.matrices).max() > EQUAL for other in turns):
            turns.append(turn)
    return turns


def list_attribute_turns(log: AttributeLog) -> list[Turn]:
    """Return every orientation that attributes may be."""
    return [Turn(name, matrices) for name, matrices in list_turns_of(log.names, log.values)]


def is_world_velocity(log: AttributeLog, vectors: Array) -> bool:
    """Say whether what is observed is that by which attributes change. Shape (looks, 2 or 3)."""
    rates = {rate for _, rate, _ in find_rates(log, log.values)}
    columns = [log.values[:, rate] for rate in sorted(rates)]
    level = vectors.T[:2]  # which a heading turns
    return all(any(_correlate(vector, column) > SAME_VELOCITY for column in columns) for vector in level)


def _correlate(one: Array, two: Array) -> float:
    return float(np.corrcoef(one, two)[0, 1]) if one.std() > 0 and two.std() > 0 else 0.0


def name_elements(built: Built) -> tuple[list[str], list[int]]:
    """Return the names of the elements that rules read, and the array that each belongs to."""
    leaves = find_float_leaves(built.leaves)
    places = [(leaf, i) for leaf in leaves for i in range(int(np.prod(built.leaves[leaf].shape)))]
    return [built.element(leaf, i) for leaf, i in places], [leaf for leaf, _ in places]


def name_observed(env: Any, one: ObservedWorld) -> tuple[list[str], list[str]]:
    """Return the names of the elements of an observation, and the part that each belongs to: an array of it, or what a
    task observes by a name."""
    if is_task(env):
        sizes = dict(env.unwrapped.observation_sizes)
        parts = [name for name, size in sizes.items() for _ in range(size)]
        if len(parts) == one.logs[0].observed[0].size:
            return [f"{name}[{i}]" for name, size in sizes.items() for i in range(size)], parts
    parts = [name for name, size in one.logs[0].parts for _ in range(size)]
    return [one.name_element(i) for i in range(len(parts))], parts


def name_part(names: Sequence[str]) -> str:
    """Name some elements that follow each other."""
    return f"({names[0]} to {names[-1]})"
